"""Simulated runs beside the proof: is every state in the enclosure of its step?"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from members import inside

from racecar.closed_loop import Disturb, Runs, State, simulate
from racecar.controller import Controller, Layer
from racecar.faults import GivenFaults
from racecar.lidar import Lidar
from verifier.models import error_spread
from verifier.problem import Box, Problem
from verifier.proof import Prover
from verifier.rows import Rows, join

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


def tame_controller(lidar: Lidar, gain: float, most: float) -> Controller:
    """Steer to where it is wider, by at most ``most`` rad: runs come together, and turn corners."""
    side = -np.sign(np.round(lidar.angles, 9)) * np.abs(np.sin(lidar.angles))
    weights = (gain * side / np.abs(side).sum())[None].astype(np.float32)
    return Controller(
        (
            Layer(-weights, np.zeros(1, np.float32), "tanh"),
            Layer(np.array([[most]], np.float32), np.zeros(1, np.float32), "linear"),
        )
    )


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


def simulated(problem: Problem, starts: np.ndarray, disturb: Disturb | None = None) -> Runs:
    """Run the real-valued network (float64) from starts ``[batch, 4]``."""
    return simulate(
        problem.plant,
        problem.controller.steering_rows,
        problem.safety,
        State.start(*starts.T),
        problem.steps,
        disturb,
        record=True,
    )


@dataclass
class Seen:
    """What the comparison saw: runs found in rows, and how full the enclosures were.

    found: runs times steps; filled: the largest deviation from a row's polynomial in the start
    position over the claimed error; least: the proved margin; margin: of the runs that were not
    given up; given_up: share of the starts; rows: at the end; gathered: rows that contain others;
    divided: how often a row was divided along a symbol, at most; frames: that runs were in.
    """

    found: int = 0
    filled: float = 0.0
    least: float = np.inf
    margin: float = np.inf
    given_up: float = 0.0
    rows: int = 0
    gathered: int = 0
    divided: int = 0
    frames: set[int] = field(default_factory=set)


class Watched(Prover):
    """A prover that keeps its rows: after each step, gathered, and given up (after which step)."""

    def __init__(self, *args, **options) -> None:
        super().__init__(*args, **options)
        self.after: dict[int, list[Rows]] = {}
        self.together: dict[int, list[Rows]] = {}
        self.given_up: list[tuple[int, Rows]] = []
        give_up = self._divider.give_up

        def watch(rows: Rows) -> None:
            self.given_up.append((self._divider.step, rows))
            give_up(rows)

        self._divider.give_up = watch

    def _step(self, rows: Rows, tolerance: float) -> Rows:
        done = super()._step(rows, tolerance)
        self.after.setdefault(self._divider.step + 1, []).append(done)
        return done

    def _gather(self, step: int, rows: Rows) -> Rows:
        done = super()._gather(step, rows)
        self.together.setdefault(step, []).append(done)
        return done


def compare(
    problem: Problem,
    starts: np.ndarray,
    tolerance: float,
    case: int = 0,
    disturb: Disturb | None = None,
) -> Seen:
    """Prove, simulate, and assert that every state of every run lies in a row of its step."""
    runs = simulated(problem, starts, disturb)
    trace = runs.trace
    assert trace is not None
    box = Box(problem.lower, problem.upper, int(np.argmax(problem.upper - problem.lower)))
    middle, half = (problem.upper + problem.lower) / 2, (problem.upper - problem.lower) / 2
    lead = box.lead
    x = (starts[:, lead] - middle[lead]) / half[lead] if half[lead] else np.zeros(len(starts))
    prover, ends = Watched(problem, 0.0), (np.array([-1.0]), np.array([1.0]))
    proof = prover.prove(box, *ends, tolerance, case)
    seen = Seen(least=proof.least, rows=proof.leaves)
    for step in range(1, problem.steps + 1):
        excused = np.zeros(len(x), dtype=bool)
        for when, part in prover.given_up:
            if when < step:
                for low, high in zip(part.low, part.high, strict=True):
                    excused |= (x >= low) & (x <= high)
        going = (runs.crash_step < 0) | (runs.crash_step > step)
        states = np.stack([trace[name][:, step] for name in NAMES])
        for rows in (prover.after.get(step, []), prover.together.get(step)):
            if rows is None:
                continue
            found = _found(seen, rows, x, states, trace["frame"][:, step])
            missing = going & ~found & ~excused
            assert not missing.any(), (step, starts[missing][:3], states[:, missing][:, :3])
        seen.found += int(found.sum())
        seen.frames |= set(trace["frame"][found, step].tolist())
    open_now = np.zeros(len(x), dtype=bool)
    for low, high in zip(proof.low, proof.high, strict=True):
        open_now |= (x >= low) & (x <= high)
    seen.given_up = float(open_now.mean())
    if not open_now.all():
        seen.margin = float(runs.margin[~open_now].min())
    return seen


def _found(
    seen: Seen, parts: list[Rows], x: np.ndarray, states: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """Tell which states ``[4, runs]`` lie in a row; x: ``[runs]``, their start positions."""
    found = np.zeros(len(x), dtype=bool)
    if not any(map(len, parts)):
        return found
    rows = join(parts)
    seen.gathered = max(seen.gathered, int(rows.gathered.sum()))
    seen.divided = max(seen.divided, int(rows.splits.max()))
    for row in range(len(rows)):
        state, gathered = rows.state[:, row], bool(rows.gathered[row])
        width, centre = rows.high[row] - rows.low[row], rows.high[row] + rows.low[row]
        places = (2 * x - centre) / max(width, 1e-300)
        mine = ~found & (np.abs(places) <= 1 + 1e-9) & (frames == rows.frame[row])
        some = np.flatnonzero(mine)
        if not some.size:
            continue
        hints = None if gathered else np.clip(places[some], -1, 1)
        held, off = inside(state, states[:, some], hints, EVALUATION)
        found[some[held]] = True
        if held.any() and not gathered:
            claimed = error_spread(state)[:, None]
            filled = (off[:, held] - EVALUATION) / np.maximum(claimed, 1e-300)
            seen.filled = max(seen.filled, float(filled.max()))
    return found


@dataclass(frozen=True)
class Disturbances:
    """Noise ``[steps, rays, runs]`` and missing rays ``[(steps,) rays, runs]`` of runs."""

    noise: np.ndarray | None
    gone: np.ndarray | None

    def of(self, problem: Problem) -> GivenFaults:
        """Return them as the simulation takes them."""
        assert problem.disturbance is not None
        return GivenFaults(
            problem.plant.track.width,
            problem.plant.lidar.range,
            self.gone,
            problem.disturbance.turn_only,
            self.noise,
        )


def disturbances(
    random: np.random.Generator, problem: Problem, count: int, mask: np.ndarray | None = None
) -> Disturbances:
    """Return members of the problem's set: at random, all to one side, and changing sides.

    mask: the rays that are missing, ``[rays]``, if the choice is made once for a run.
    """
    given, rays, steps = problem.disturbance, problem.plant.lidar.rays, problem.steps
    assert given is not None
    noise = random.uniform(-1, 1, (steps, rays, count))
    # All readings of a side of the car too long or too short, for several steps at once: that
    # pushes hardest.
    side = np.sign(problem.plant.lidar.angles)[:, None]
    for run in range(count):
        kind = run % 4
        if kind == 1:
            noise[..., run] = random.choice([-1.0, 1.0], (steps, rays))
        elif kind > 1:
            change = np.repeat(random.choice([-1.0, 1.0], steps), 6)[:steps]
            pushed = np.ones(steps) * random.choice([-1.0, 1.0]) if kind == 2 else change
            noise[..., run] = pushed[:, None] * side[:, 0]
    gone = None
    if given.missing and given.choice == "run":
        assert mask is not None
        gone = np.repeat(mask[:, None], count, axis=1)
    elif given.missing:
        gone = np.zeros((steps, rays, count), dtype=bool)
        for step in range(steps):
            for run in range(count):
                how_many = random.integers(given.missing + 1) if run % 2 else given.missing
                gone[step, random.choice(rays, how_many, replace=False), run] = True
    return Disturbances(given.noise * noise if given.noise else None, gone)
