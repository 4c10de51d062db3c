"""Simulated runs beside the proof: is every state in the enclosure of its step?"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from racecar.closed_loop import Runs, State, simulate
from racecar.controller import Controller, Layer
from verifier.models import TERMS, error_spread
from verifier.problem import Box, Problem, start_rows
from verifier.proof import Prover, uncovered
from verifier.rows import Rows

#: Simulation rounds, and so does a start's place in its row.
EVALUATION = 1e-10

NAMES = ("s", "f", "v", "theta")


def random_controller(
    random: np.random.Generator, rays: int, activation: str, size: float = 1.0
) -> Controller:
    """Return a small network of two hidden layers; the last layer keeps to +-15 degrees."""
    layers, width = [], rays
    for out in (8, 8):
        weights = size * random.normal(size=(out, width)) / np.sqrt(width)
        # Readings are around 2.5 m: centred like the benchmark's.
        biases = -2.0 * weights.sum(axis=1) if width == rays else 0.1 * random.normal(size=out)
        layers.append(Layer(weights.astype(np.float32), biases.astype(np.float32), activation))
        width = out
    last = (0.5 * random.normal(size=(1, width))).astype(np.float32)
    layers.append(Layer(last, np.zeros(1, np.float32), "tanh"))
    layers.append(Layer(np.array([[0.26]], np.float32), np.zeros(1, np.float32), "linear"))
    return Controller(tuple(layers))


def shifted(controller: Controller, by: float) -> Controller:
    """Return a controller whose last bias before the output's activation is shifted."""
    layers = list(controller.layers)
    place = max(i for i, layer in enumerate(layers) if layer.activation != "linear")
    biases = (layers[place].biases + np.float32(by)).astype(np.float32)
    layers[place] = Layer(layers[place].weights, biases, layers[place].activation)
    return Controller(tuple(layers))


def random_starts(random: np.random.Generator, problem: Problem, count: int) -> np.ndarray:
    """Return starts ``[count, 4]`` in the box, some at its corners."""
    share = random.random((count, 4))
    share[: count // 8] = np.round(share[: count // 8])
    return problem.lower + share * (problem.upper - problem.lower)


def simulated(problem: Problem, starts: np.ndarray) -> Runs:
    """Run the real-valued network (float64) from starts ``[batch, 4]``."""
    return simulate(
        problem.plant,
        problem.controller.steering_rows,
        problem.safety,
        State.start(*starts.T),
        problem.steps,
        record=True,
    )


@dataclass
class Seen:
    """What the comparison saw: runs found in rows, and how full the enclosures were.

    filled: the largest deviation from a row's polynomial over the claimed error; least: the
    proved margin; margin: of the runs that were not given up; given_up: share of the starts.
    """

    found: int = 0
    filled: float = 0.0
    least: float = np.inf
    margin: float = np.inf
    given_up: float = 0.0
    rows: int = 0


def steps(problem: Problem, prover: Prover, tolerance: float, failed: list[Rows]) -> Iterator[Rows]:
    """Yield the rows after each step, as Prover.prove treats them."""
    widths = problem.upper - problem.lower
    box = Box(problem.lower, problem.upper, int(np.argmax(widths)))
    ends = np.array([-1.0]), np.array([1.0])
    rows = start_rows(box, problem.active, *ends)
    for _ in range(problem.steps):
        if not len(rows):
            return
        rows = prover._step(rows, tolerance, failed)
        yield rows
    low = np.concatenate([rows.low, *(r.low for r in failed)])
    high = np.concatenate([rows.high, *(r.high for r in failed)])
    assert not len(uncovered(*ends, low, high)[0])


def compare(problem: Problem, starts: np.ndarray, tolerance: float) -> Seen:
    """Prove, simulate, and assert that every state of every run lies in a row of its step."""
    runs = simulated(problem, starts)
    trace = runs.trace
    assert trace is not None
    lead = int(np.argmax(problem.upper - problem.lower))
    middle, half = (problem.upper + problem.lower) / 2, (problem.upper - problem.lower) / 2
    x = (starts[:, lead] - middle[lead]) / half[lead] if half[lead] else np.zeros(len(starts))
    failed: list[Rows] = []
    seen, rows = Seen(), None
    for step, rows in enumerate(steps(problem, Prover(problem, 0.0), tolerance, failed), start=1):
        going = (runs.crash_step < 0) | (runs.crash_step > step)
        given_up = np.zeros(len(x), dtype=bool)
        for part in failed:
            for low, high in zip(part.low, part.high, strict=True):
                given_up |= (x >= low - 1e-9) & (x <= high + 1e-9)
        states = np.stack([trace[name][:, step] for name in NAMES])
        found = np.zeros(len(x), dtype=bool)
        for row in range(len(rows)):
            width, centre = rows.high[row] - rows.low[row], rows.high[row] + rows.low[row]
            place = (2 * x - centre) / max(width, 1e-300)
            mine = (np.abs(place) <= 1 + 1e-9) & (trace["frame"][:, step] == rows.frame[row])
            if not mine.any():
                continue
            powers = np.clip(place[mine], -1, 1) ** np.arange(TERMS)[:, None]
            claimed = error_spread(rows.state[:, row])[:, None]
            off = np.abs(states[:, mine] - rows.state.c[:TERMS, :, row].T @ powers)
            held = (off <= claimed + EVALUATION).all(axis=0)
            found[np.flatnonzero(mine)[held]] = True
            if held.any():
                filled = (off[:, held] - EVALUATION) / np.maximum(claimed, 1e-300)
                seen.filled = max(seen.filled, float(filled.max()))
        missing = going & ~found & ~given_up
        assert not missing.any(), (step, starts[missing][:3], states[:, missing][:, :3])
        seen.found += int(found.sum())
        seen.given_up = float(given_up.mean())
    if rows is not None and len(rows):
        proved = ~given_up
        seen.rows, seen.least = len(rows), float(rows.least.min())
        if proved.any():
            seen.margin = float(runs.margin[proved].min())
    return seen
