"""Which questions are asked of a controller alone, and where their thresholds lie.

All but the turn commitment ask whether the steering stays in an interval around what the
controller answers to the scan itself. A search (generator.openloop.extremes) says how far the
steering can be pushed at least; the interval reaches a share of that far to either side. The
share goes round: below 1 the answer is sat by construction (unless the deviation is less than
LEAST); a little above 1 it is close, and open; well above 1 it is likely to be unsat. An interval
never reaches more than half of the way from what was found to the largest steering there is.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from generator.openloop.extremes import influence, steering_extremes, steering_limit
from generator.openloop.numbers import nearest
from generator.openloop.sets import (
    BASE_NOISE,
    free,
    hull,
    noisy,
    subsets,
    too_far,
    windows,
)
from generator.openloop.spec import Box, OutputBound, Spec
from generator.openloop.views import FRONTS, MIDDLE, UNIT, View, nominal_views
from racecar.closed_loop import Plant
from racecar.controller import Controller

#: Noise in mm, and how many rays are missing.
NOISE, MISSING = (10, 20, 50, 100), (1, 2, 5)
#: How far the interval reaches, as a share of the deviation found; at least LEAST degrees.
SHARES, LEAST = (0.9, 1.1, 1.5), 0.5
#: Where any rays may be missing, where any two, and where the car is to turn right.
MANY_AT, PAIRS_AT, COMMIT_AT = ("3", "2"), ("2",), ("2.5", "2")
#: The car is turning where its steering (degrees) is at most this.
TURNING = -2.0
#: Files with more bounds than this in their disjunctions are not made (scans of many rays).
MOST_BOUNDS = 5000
#: Full scans, with more rays than this, are asked about at fewer places.
MANY_RAYS, MANY_RAYS_AT = 200, ("3", "2")


@dataclass(frozen=True)
class OpenLoopQuestion:
    """One specification of a controller; id: CONTROLLER.open_loop.PLACE.LABEL."""

    id: str
    spec: Spec


@dataclass(frozen=True)
class _Asked:
    """A set of scans: the label in the ID, what it is in words, and its boxes."""

    label: str
    words: str
    boxes: tuple[Box, ...]


def open_loop_questions(
    name: str, controller: Controller, plant: Plant, start: Fraction = MIDDLE, tag: str = ""
) -> Iterator[OpenLoopQuestion]:
    """Yield the questions about a controller: the same network gives the same questions.

    start: of the drive (s, m); tag: begins the place in the IDs.
    """
    fronts = FRONTS if controller.rays <= MANY_RAYS else MANY_RAYS_AT
    for place, view in enumerate(nominal_views(controller, plant, fronts, start)):
        prefix = f"{name}.open_loop.{tag}{view.label}"
        for i, asked in enumerate(_sets(controller, view)):
            share = SHARES[(place + i) % len(SHARES)]
            yield OpenLoopQuestion(
                f"{prefix}.{asked.label}", _interval(name, controller, view, asked, share)
            )
        for asked in _commitments(controller, view):
            yield OpenLoopQuestion(f"{prefix}.{asked.label}", _turns_right(name, view, asked))


def _sets(controller: Controller, view: View) -> Iterator[_Asked]:
    """Yield the sets of scans for which the steering is to stay in an interval."""
    rays = controller.rays
    yield _Asked("steer", "any scan between those met from all over the start range", (hull(view),))
    for noise in NOISE:
        box = noisy(view, Fraction(noise, 1000))
        yield _Asked(f"noise{noise}mm", f"every ray is off by up to {noise} mm", (box,))
    room = (view.reach - view.scan) * float(UNIT)
    effect = np.abs(influence(controller, view.metres)) * room
    ranking = np.argsort(-effect, kind="stable")
    for count in MISSING:
        if count <= rays:
            chosen = sorted(ranking[:count].tolist())
            listed = ", ".join(map(str, chosen))
            words = f"rays {listed} read anything from the distance up to the range"
            yield _Asked(f"range{count}", words, (too_far(view, chosen),))
    if view.front in MANY_AT:
        for label, words, sets in _ray_sets("missing", rays, view.front in PAIRS_AT):
            if len(sets) * rays <= MOST_BOUNDS:
                boxes = tuple(too_far(view, chosen) for chosen in sets)
                yield _Asked(label, f"{words} anything from the distance up to the range", boxes)


def _commitments(controller: Controller, view: View) -> Iterator[_Asked]:
    """Yield the sets of scans for which the car is to steer right."""
    if view.front not in COMMIT_AT or math.degrees(view.steering) > TURNING:
        return
    for label, words, sets in _ray_sets("commit", controller.rays, False):
        if 2 * len(sets) * controller.rays <= MOST_BOUNDS:
            yield _Asked(label, f"{words} anything", tuple(free(view, chosen) for chosen in sets))


def _ray_sets(
    label: str, rays: int, pairs: bool
) -> Iterator[tuple[str, str, list[tuple[int, ...]]]]:
    """Yield label, words and the sets of rays: any one, any two if wanted, else adjacent ones."""
    yield f"{label}1", "any one ray reads", subsets(rays, 1)
    for count in MISSING[1:]:
        if count < rays:
            yield f"{label}{count}adjacent", f"any {count} adjacent rays read", windows(rays, count)
    if pairs and rays > 2 and math.comb(rays, 2) * rays <= MOST_BOUNDS:
        yield f"{label}2", "any two rays read", subsets(rays, 2)


def _interval(name: str, controller: Controller, view: View, asked: _Asked, share: float) -> Spec:
    least, most = (math.degrees(x) for x in steering_extremes(controller, asked.boxes))
    middle = math.degrees(view.steering)
    limit = math.degrees(steering_limit(controller))
    low = round(middle - _reach(share, middle - least, limit + least), 2)
    high = round(middle + _reach(share, most - middle, limit - most), 2)
    title = (
        *_title(name, view, asked),
        f"unsafe: the steering is at most {low:.2f} or at least {high:.2f} degrees "
        f"(without all that: {middle:.2f})",
    )
    return Spec(title, asked.boxes, 1, ((_steering("<=", low),), (_steering(">=", high),)))


def _reach(share: float, found: float, beyond: float) -> float:
    """Return how far (degrees) the interval reaches where a deviation was found.

    beyond: from there to the largest steering that there is.
    """
    return max(min(share * found, found + max(beyond, 0.0) / 2), LEAST)


def _turns_right(name: str, view: View, asked: _Asked) -> Spec:
    title = (
        *_title(name, view, asked),
        "unsafe: the car does not steer right "
        f"(without all that it does, by {-math.degrees(view.steering):.2f} degrees)",
    )
    return Spec(title, asked.boxes, 1, ((_steering(">=", 0.0),),))


def _title(name: str, view: View, asked: _Asked) -> tuple[str, ...]:
    noise = f"; the other rays are off by up to {1000 * float(BASE_NOISE * UNIT)} mm"
    whole = asked.label == "steer" or asked.label.startswith("noise")
    return (
        f"{name}, {view.front} m before the front wall "
        f"(control instant {view.step} of the nominal drive from s = {float(view.start)} m)",
        f"scans: {asked.words}{'' if whole else noise}",
    )


def _steering(relation: str, degrees: float) -> OutputBound:
    bound = nearest(math.radians(degrees))
    return OutputBound(0, "<=" if relation == "<=" else ">=", bound)
