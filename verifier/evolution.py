"""Covariance matrix adaptation: evolution that learns the shape of the function it minimises.

The (mu/mu_w, lambda)-CMA-ES as in Hansen, The CMA Evolution Strategy: A Tutorial
(arXiv:1604.00772), with its default parameters, on the unit cube; points outside are moved to
the cube before they are evaluated.
"""

from __future__ import annotations

import math

import numpy as np

from verifier.models import Array


class Evolution:
    """One evolution: ask for points, tell their values, again and again.

    size: points a generation; step: standard deviation at first, of the cube's edge.
    """

    def __init__(self, mean: Array, step: float, size: int, random: np.random.Generator) -> None:
        n = len(mean)
        self._random, self._size, self._mean, self._step = random, size, mean, step
        weights = np.log((size + 1) / 2) - np.log(np.arange(1, size // 2 + 1))
        self._weights = weights / weights.sum()
        mass = 1 / (self._weights**2).sum()
        self._mass = mass
        self._c_step = (mass + 2) / (n + mass + 5)
        self._damp = 1 + 2 * max(0.0, math.sqrt((mass - 1) / (n + 1)) - 1) + self._c_step
        self._c_path = (4 + mass / n) / (n + 4 + 2 * mass / n)
        self._c_one = 2 / ((n + 1.3) ** 2 + mass)
        rank = 2 * (mass - 2 + 1 / mass) / ((n + 2) ** 2 + mass)
        self._c_rank = min(1 - self._c_one, rank)
        self._expected = math.sqrt(n) * (1 - 1 / (4 * n) + 1 / (21 * n * n))
        self._covariance = np.eye(n)
        self._step_path, self._path = np.zeros(n), np.zeros(n)
        self._told = 0

    @property
    def spread(self) -> float:
        """The largest standard deviation of the next points, of the cube's edge."""
        return self._step * math.sqrt(np.linalg.eigvalsh(self._covariance)[-1])

    def ask(self) -> Array:
        """Return the points of a generation, ``[size, dimensions]``, within the cube."""
        values, vectors = np.linalg.eigh(self._covariance)
        drawn = self._random.normal(size=(self._size, len(self._mean)))
        steps = drawn * np.sqrt(np.maximum(values, 0.0)) @ vectors.T
        return np.clip(self._mean + self._step * steps, 0.0, 1.0)

    def tell(self, points: Array, values: Array) -> None:
        """Learn from the values of a generation's points."""
        self._told += 1
        best = np.argsort(values, kind="stable")[: len(self._weights)]
        steps = (points[best] - self._mean) / self._step
        move = self._weights @ steps
        self._mean = self._mean + self._step * move
        values, vectors = np.linalg.eigh(self._covariance)
        inverse = vectors / np.sqrt(np.maximum(values, 1e-20)) @ vectors.T
        c = self._c_step
        self._step_path = (1 - c) * self._step_path + math.sqrt(c * (2 - c) * self._mass) * (
            inverse @ move
        )
        length = float(np.linalg.norm(self._step_path))
        usual = math.sqrt(1 - (1 - c) ** (2 * self._told)) * self._expected
        going = length / usual < 1.4 + 2 / (len(self._mean) + 1)
        p = self._c_path
        self._path = (1 - p) * self._path + going * math.sqrt(p * (2 - p) * self._mass) * move
        kept = 1 - self._c_one - self._c_rank + (not going) * self._c_one * p * (2 - p)
        self._covariance = (
            kept * self._covariance
            + self._c_one * np.outer(self._path, self._path)
            + self._c_rank * (steps.T * self._weights) @ steps
        )
        self._step *= math.exp(min(1.0, c / self._damp * (length / self._expected - 1)))
