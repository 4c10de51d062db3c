"""The parts of a control step as tensor operations: reading, steering, driving, margin.

The formulas are those of racecar.lidar, racecar.bicycle and racecar.safety. What is divided by is
a computed tensor, and so is what is divided: not every tool takes a constant there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from generator.openloop.extremes import steering_limit
from generator.unrolled.tape import Tape
from racecar.closed_loop import Plant
from racecar.controller import Controller
from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.polygon import Array, Polygon

#: The series of sin(x) / x is cut off where a step's error is less than this (metres).
SERIES_ERROR = 1e-14
_OPERATORS = {"tanh": "Tanh", "sigmoid": "Sigmoid", "relu": "Relu"}


@dataclass(frozen=True)
class Pose:
    """Names of tensors ``[batch, 1]``: s, f (m) and heading (rad), its sine and its cosine."""

    s: str
    f: str
    theta: str
    sine: str
    cosine: str


@dataclass(frozen=True)
class Series:
    """``sin(x) / x`` as a polynomial in the square of x.

    coefficients: of 1, x^2, x^4, ...; error: bound on the difference for ``|x| <= limit``.
    """

    coefficients: tuple[float, ...]
    error: float
    limit: float


def sinc_series(limit: float, tolerance: float) -> Series:
    """Return the shortest series of sin(x) / x that is good to ``tolerance`` for |x| <= limit.

    The terms alternate and shrink (limit^2 < 6), so the first one left out bounds the error.
    """
    if not limit**2 < 6:
        raise BadInput(f"the car may turn by {2 * limit:.2f} rad in a step; that is too much")
    terms = 2
    while limit ** (2 * terms) / math.factorial(2 * terms + 1) > tolerance:
        terms += 1
    coefficients = tuple((-1) ** i / math.factorial(2 * i + 1) for i in range(terms))
    return Series(coefficients, limit ** (2 * terms) / math.factorial(2 * terms + 1), limit)


def plant_series(plant: Plant, controller: Controller, longest: float) -> Series:
    """Return the series that serves a car whose steps are at most ``longest`` metres long."""
    steering = steering_limit(controller)
    if plant.bicycle.slip:
        raise BadInput("an unrolled network is made for the car without slip only")
    if not steering < math.pi / 2:
        raise BadInput("the controller's steering is not bounded below 90 degrees")
    wheelbase = plant.bicycle.front + plant.bicycle.rear
    return sinc_series(math.tan(steering) * longest / wheelbase / 2, SERIES_ERROR / longest)


def pose(tape: Tape, s: str, f: str, theta: str) -> Pose:
    """Return a pose with its sine and cosine."""
    return Pose(
        s, f, theta, tape.apply("Sin", theta, name="sin"), tape.apply("Cos", theta, name="cos")
    )


def miss(tape: Tape, at: Pose, normal: Array, offset: float, name: str) -> str:
    """Return ``normal @ (s, f) - offset``, by how much a constraint is missed."""
    parts = [(x, float(a)) for x, a in ((at.s, normal[0]), (at.f, normal[1])) if a != 0.0]
    if len(parts) == 1:
        return tape.affine(*parts[0], -float(offset), name)
    first, second = (tape.affine(x, a, 0.0, f"{name}.{i}") for i, (x, a) in enumerate(parts))
    both = tape.apply("Add", first, second, name=f"{name}.sum")
    return tape.affine(both, 1.0, -float(offset), name)


def approach(lidar: Lidar, normal: Array) -> Array:
    """Return how fast rays approach a constraint, as factors of sine and cosine: ``[2, rays]``.

    Along a ray the miss ``g`` changes as ``g - h t``; h = (sine, cosine) of the heading @ this.
    """
    cosines, sines = np.cos(lidar.angles), np.sin(lidar.angles)
    a_s, a_f = normal
    return np.stack([a_s * cosines - a_f * sines, a_s * sines + a_f * cosines])


def inverse_distance(
    tape: Tape,
    at: Pose,
    lidar: Lidar,
    normal: Array,
    gap: str,
    name: str,
    kept: float = 0.0,
    mask: NDArray[np.bool_] | None = None,
) -> str:
    """Return ``h / g`` of a constraint, ``[batch, rays]``.

    gap: the miss g, not 0; kept: g is at least this as long as the car is safe, and the
    formula is right then only, so that it divides by no less; mask: where it is false, the answer
    is 0.
    """
    if kept > 0:
        gap = tape.apply("Max", gap, tape.scalar(kept), name=f"{name}.kept")
    factors = [
        tape.apply("Div", part, gap, name=f"{name}.{label}")
        for label, part in (("s", at.sine), ("c", at.cosine))
    ]
    both = tape.apply("Concat", *factors, name=f"{name}.sc", axis=1)
    factor = approach(lidar, normal) * (1 if mask is None else mask)
    matrix = tape.constant(factor, f"approach{normal[0]:+g}{normal[1]:+g}")
    return tape.apply("MatMul", both, matrix, name=name)


def readings(tape: Tape, lidar: Lidar, hits: Sequence[str], ones: str) -> str:
    """Return the scan ``[batch, rays]`` (m) from inverse distances to walls.

    ones: 1 everywhere, ``[batch, rays]``.
    """
    nearest = tape.scalar(1 / lidar.range)
    inverse = tape.fold("Max", [*hits, nearest], "inverse")
    return tape.apply("Div", ones, inverse, name="scan")


def steering(tape: Tape, controller: Controller, scan: str) -> str:
    """Return the controller's answer ``[batch, 1]`` (rad); its weights are shared by all steps."""
    x = scan
    for i, layer in enumerate(controller.layers):
        weights = tape.constant(layer.weights, f"layer{i}.weight")
        biases = tape.constant(layer.biases, f"layer{i}.bias")
        x = tape.apply("Gemm", x, weights, biases, name=f"layer{i}", transB=1)
        if layer.activation != "linear":
            x = tape.apply(_OPERATORS[layer.activation], x, name=f"layer{i}.out")
    return x


def drive(tape: Tape, plant: Plant, at: Pose, delta: str, distance: str, series: Series) -> Pose:
    """Return the pose after a step with steering ``delta`` (rad) over ``distance`` (m).

    The path is the exact arc of racecar.bicycle but for the series.
    """
    wheelbase = plant.bicycle.front + plant.bicycle.rear
    slope = tape.apply(
        "Div",
        tape.apply("Sin", delta, name="sin_delta"),
        tape.apply("Cos", delta, name="cos_delta"),
        name="tan_delta",
    )
    turned = tape.apply("Mul", slope, distance, name="turned")
    half = tape.affine(turned, 0.5 / wheelbase, 0.0, "half")
    square = tape.apply("Mul", half, half, name="square")
    value = tape.affine(square, series.coefficients[-1], 0.0, "series")
    for i, coefficient in enumerate(reversed(series.coefficients[1:-1])):
        value = tape.apply("Add", value, tape.scalar(coefficient), name=f"series{i}+")
        value = tape.apply("Mul", value, square, name=f"series{i}*")
    sinc = tape.affine(value, 1.0, series.coefficients[0], "sinc")
    chord = tape.apply("Mul", distance, sinc, name="chord")
    along = tape.apply("Add", at.theta, half, name="along")
    sideways = tape.apply("Mul", chord, tape.apply("Sin", along, name="sin_along"), name="ds")
    forward = tape.apply("Mul", chord, tape.apply("Cos", along, name="cos_along"), name="df")
    return pose(
        tape,
        tape.apply("Sub", at.s, sideways, name="s"),
        tape.apply("Sub", at.f, forward, name="f"),
        tape.apply("Add", along, half, name="theta"),
    )


def margin(tape: Tape, at: Pose, unsafe: Sequence[Polygon]) -> str:
    """Return the margin ``[batch, 1]`` (m): the least, over polygons, of the largest miss."""
    separations = []
    for k, polygon in enumerate(unsafe):
        misses = [
            miss(tape, at, normal, offset, f"m{k}.{j}")
            for j, (normal, offset) in enumerate(zip(polygon.normals, polygon.offsets, strict=True))
        ]
        separations.append(tape.fold("Max", misses, f"m{k}"))
    return tape.fold("Min", separations, "margin")
