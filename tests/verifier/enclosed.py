"""Rows made by hand, cars inside them, and where a car is to be found after cuts."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, Layer
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.safety import named_property
from racecar.track import Hall, Track, square_track, track_from_turns
from verifier.models import TERMS, Models
from verifier.problem import Problem
from verifier.proof import Prover
from verifier.rows import THETA, F, Rows, S, join

#: Doubles are evaluated here, and a row's place in its parent is rounded.
EVALUATION = 1e-9

TRACKS = {
    "square": square_track(),
    "left": track_from_turns(["left"]),
    "mixed": track_from_turns(["right", "left", "left"], length=7.0, width=1.1),
    "small block": square_track(4.0),
    "thin block": square_track(3.05),
    "uneven": Track(1.3, (Hall(6.0, "left"), Hall(4.5, "right"), Hall(9.0, None)), closed=False),
}


def zero_controller(rays: int) -> Controller:
    """Steer straight ahead, whatever is seen."""
    weights = np.zeros((1, rays), np.float32)
    return Controller((Layer(weights, np.zeros(1, np.float32), "linear"),))


def problem_of(
    track: Track, lidar: Lidar, controller: Controller | None = None, slip: bool = False, **extra
) -> Problem:
    """Return a problem on a track; the defaults are the benchmark's."""
    given = {
        "plant": Plant(track, Bicycle(slip=slip), lidar),
        "controller": controller or zero_controller(lidar.rays),
        "safety": named_property("clearance", track),
        "steps": 70,
        "lower": np.array([0.65, 9.9, 0.0, 0.0]),
        "upper": np.array([0.85, 9.9, 0.0, 0.0]),
    }
    return Problem(**(given | extra))


@dataclass(frozen=True)
class Car:
    """A member of a row: x, error symbols, and its state (s, f, v, theta)."""

    x: float
    e: np.ndarray
    state: np.ndarray


def one_row(pose: np.ndarray, slopes: np.ndarray, errors: np.ndarray, radius: float) -> Rows:
    """Return a row around a pose (s, f, v, theta).

    slopes: ``[5, 4]``, coefficients of x to x^5; errors: ``[2 m, 4]``, of the symbols.
    """
    c = np.concatenate([pose[None], slopes, errors])[..., None]
    return rows_of(Models(c, np.full((4, 1), radius)))


def rows_of(state: Models) -> Rows:
    """Return rows on whole pieces, nothing known of them but their state ``[4, rows]``."""
    count = state.radius.shape[-1]
    return Rows(
        state=state,
        frame=np.zeros(count, dtype=np.intp),
        low=np.full(count, -1.0),
        high=np.ones(count),
        least=np.full(count, np.inf),
        decisions=((),) * count,
        kink=np.zeros(count),
        tried=np.full(count, np.inf),
        borne=np.zeros(count),
        case=np.zeros(count, dtype=np.intp),
        splits=np.zeros(count, dtype=np.intp),
        gathered=np.zeros(count, dtype=bool),
        node=np.full(count, -1),
    )


def cars(random: np.random.Generator, rows: Rows, count: int) -> list[Car]:
    """Return members of the only row, errors at extreme signs for most."""
    models, found = rows.state, []
    for i in range(count):
        x = float(random.uniform(-1, 1)) if i else 1.0
        e = random.choice([-1.0, 1.0], models.symbols) * random.choice([1.0, 0.5])
        rest = random.choice([-1.0, 1.0], 4) * models.radius[:, 0]
        powers = x ** np.arange(TERMS)
        values = np.concatenate([powers, np.ravel(np.stack([e, e * x], axis=1))])
        found.append(Car(x, e, values @ models.c[:, :, 0] + rest))
    return found


def places_in(rows: Rows, x: float) -> np.ndarray:
    """Return where, in [-1, 1], a start lies in each row (beyond it for the other rows)."""
    middle, half = (rows.low + rows.high) / 2, (rows.high - rows.low) / 2
    return (x - middle) / np.maximum(half, 1e-300)


def value_at(models: Models, row: int, x: float, e: np.ndarray) -> np.ndarray:
    """Return polynomial and symbols of a batch of models of one row: ``[...]``."""
    values = np.concatenate([x ** np.arange(TERMS), np.ravel(np.stack([e, e * x], axis=1))])
    return np.tensordot(values, models.c[..., row], axes=1)


def crossing(polygon: Polygon, front: int, back: int, course: float, state: np.ndarray) -> float:
    """Return the cross product X of two faces along a ray with this course."""
    miss = polygon.normals @ state[[S, F]] - polygon.offsets
    rate = polygon.normals @ np.array([math.sin(course), math.cos(course)])
    return float(rate[back] * miss[front] - rate[front] * miss[back])


def settle(prover: Prover, rows: Rows, kink: float, most: int = 400):
    """Cut rows until no guard is left: the settled rows, their scans, and rows given up.

    Rows that are still open after ``most`` rounds count as given up.
    """
    todo, settled, scans = [rows], [], []
    divider = prover._divider
    divider.failed = []
    for _ in range(most):
        if not todo:
            break
        batch = todo.pop()
        scan = prover._scanners[int(batch.frame[0])].measure(batch, kink)
        blocked = scan.unclear.copy()
        blocked[scan.guards.row] = True
        todo += [r for r in divider.cut(batch, scan.guards, scan.unclear) if len(r)]
        clear = np.flatnonzero(~blocked)
        if clear.size:
            settled.append(batch.take(clear))
            scans.append(scan.distance[:, clear])
    failed = divider.failed + todo
    empty = rows.take(np.zeros(len(rows), dtype=bool))
    return settled, scans, join(failed) if failed else empty


def belongs(rows: Rows, row: int, prover: Prover, car: Car) -> bool | None:
    """Tell whether the assumptions of a row hold for a car; None where rounding decides."""
    lidar = prover._problem.plant.lidar
    obstacles = prover._problem.plant.track.frames[int(rows.frame[row])].obstacles
    for d in rows.decisions[row]:
        course = car.state[THETA] + lidar.angles[d.ray]
        cross = crossing(obstacles[d.polygon], d.front, d.back, course, car.state)
        if abs(cross) < EVALUATION:
            return None
        if (cross > 0) != d.positive:
            return False
    return True
