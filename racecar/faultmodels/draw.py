"""What a fault model makes of scans, run by run and step by step."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from racecar.closed_loop import Plant, State
from racecar.faultmodels.numbers import hashed, uniforms
from racecar.faultmodels.reflect import segment_ends
from racecar.faultmodels.spec import (
    Dropout,
    FaultSpec,
    MeasuredNoise,
    MissingBlock,
    MissingRays,
    Noise,
    OneOf,
    Part,
    Reflective,
)
from racecar.faults import in_turn
from racecar.mirrors import lost_rays
from racecar.polygon import Array

#: Of the standard normal distribution: the logarithm of a log-normal size.
_PERCENTILE95_OF_SIZE = 1.6448536269514722

_Missing = MissingRays | MissingBlock | Dropout


@dataclass(frozen=True, eq=False)
class SpecFaults:
    """The faults of numbered runs under a model; called on each scan (closed_loop.Disturb).

    runs: ``[runs]``, their numbers; seed: of all of them. What happens to a run depends on
    these two alone, whatever runs beside it.
    """

    spec: FaultSpec
    plant: Plant
    runs: NDArray[np.uint64]
    seed: int
    _kept: dict[int, NDArray] = field(default_factory=dict, repr=False)

    def __call__(self, step: ArrayLike, state: State, scan: Array) -> Array:
        """Return the scan ``[rays, runs]`` (metres) with noise added and rays missing.

        step: one number, or one for each run.
        """
        noisy, gone = scan, np.zeros(scan.shape, dtype=bool)
        for key, part, chosen in self.drawn_parts():
            if isinstance(part, Noise | MeasuredNoise):
                noise = self.noise_drawn(key, part, step)
                noisy = noisy + (noise if chosen is None else noise * chosen)
            else:
                lost = self._lost(key, part, step, state, scan)
                gone |= lost if chosen is None else lost & chosen
        reach = self.plant.lidar.range
        noisy = scan if noisy is scan else np.clip(noisy, 0.0, reach)
        return np.where(gone, reach, noisy)

    def missing(self, step: ArrayLike, state: State, scan: Array) -> NDArray[np.bool_]:
        """Return which rays are missing, ``[rays, runs]``; scan: undisturbed, metres."""
        gone = np.zeros(scan.shape, dtype=bool)
        for key, part, chosen in self.drawn_parts():
            if not isinstance(part, Noise | MeasuredNoise):
                lost = self._lost(key, part, step, state, scan)
                gone |= lost if chosen is None else lost & chosen
        return gone

    def renewed(self, which: NDArray[np.bool_], fresh: SpecFaults) -> SpecFaults:
        """Return the faults with those of the runs ``which`` (mask) replaced by fresh ones."""
        runs = self.runs.copy()
        runs[which] = fresh.runs
        return replace(self, runs=runs, _kept={})

    def drawn_parts(self) -> Iterator[tuple[int, Part, NDArray[np.bool_] | None]]:
        """Yield each part with its key and the runs that it happens to (None: all)."""
        return self._parts(self.spec.parts, hashed(self.seed)[0], None)

    def ends_drawn(self, key: int, part: Reflective) -> Array:
        """Return the ends of a part's mirrors (reflect.segment_ends)."""
        if key not in self._kept:
            self._kept[key] = segment_ends(part, self.plant, key, self.runs)
        return self._kept[key]

    def _parts(
        self, parts: Sequence[Part], key: np.uint64, chosen: NDArray[np.bool_] | None
    ) -> Iterator[tuple[int, Part, NDArray[np.bool_] | None]]:
        for place, part in enumerate(parts):
            mine = hashed(key, place)[0]
            if not isinstance(part, OneOf):
                yield int(mine), part, chosen
                continue
            weights = np.cumsum([choice.weight for choice in part.choices])
            drawn = np.searchsorted(weights / weights[-1], uniforms(mine, self.runs), "right")
            for number, choice in enumerate(part.choices):
                these = drawn == number
                both = these if chosen is None else these & chosen
                yield from self._parts(choice.parts, hashed(mine, number + 1)[0], both)

    def noise_drawn(self, key: int, part: Noise | MeasuredNoise, step: ArrayLike) -> Array:
        """Return the noise of a part, ``[rays, runs]``, metres."""
        rays = np.arange(self.plant.lidar.rays)[:, None]
        first = uniforms(key, step, self.runs, 2 * rays)
        if isinstance(part, Noise):
            return part.low + (part.high - part.low) * first
        # Box and Muller: a normal number from two uniform ones; its sign is the error's.
        second = uniforms(key, step, self.runs, 2 * rays + 1)
        normal = np.sqrt(-2 * np.log1p(-first)) * np.cos(2 * math.pi * second)
        spread = math.log(part.percentile95 / part.median) / _PERCENTILE95_OF_SIZE
        size = part.median * np.exp(spread * normal)
        sign = np.where(hashed(key, step, self.runs, 2 * rays + 1) & np.uint64(1), 1.0, -1.0)
        return np.asarray(sign * size)

    def _lost(
        self, key: int, part: Part, step: ArrayLike, state: State, scan: Array
    ) -> NDArray[np.bool_]:
        if isinstance(part, Reflective):
            ends = self.ends_drawn(key, part)
            return lost_rays(self.plant, part.incidence, ends, state, scan)
        assert isinstance(part, _Missing)
        gone = self.rays_drawn(key, part, step)
        return gone & in_turn(state, self.plant.track.width) if part.turn_only else gone

    def rays_drawn(self, key: int, part: _Missing, step: ArrayLike) -> NDArray[np.bool_]:
        """Return the rays that a part has drawn, ``[rays, runs]``, wherever they are missing."""
        if part.choice == "step":
            return self._drawn(hashed(key, step), part)
        if key not in self._kept:
            self._kept[key] = self._drawn(np.array([key], dtype=np.uint64), part)
        return self._kept[key]

    def _drawn(self, keys: NDArray[np.uint64], part: _Missing) -> NDArray[np.bool_]:
        """Draw missing rays, ``[rays, runs]``; keys: one for all runs or one for each."""
        rays = self.plant.lidar.rays
        numbers = np.arange(rays)[:, None]
        if isinstance(part, Dropout):
            return np.asarray(uniforms(keys, self.runs, numbers) < part.probability)
        if isinstance(part, MissingBlock):
            size = min(part.rays, rays)
            first = np.floor(uniforms(keys, self.runs) * (rays - size + 1))
            return np.asarray((numbers >= first) & (numbers < first + size))
        gone = np.zeros((rays, len(self.runs)), dtype=bool)
        for number in range(part.rays):
            gone |= numbers == np.floor(uniforms(keys, self.runs, number) * rays)
        return gone


def spec_faults(spec: FaultSpec, plant: Plant, runs: ArrayLike, seed: int) -> SpecFaults:
    """Return the faults of the runs with these numbers (from 0) under a model."""
    return SpecFaults(spec, plant, np.asarray(runs, dtype=np.uint64), seed)
