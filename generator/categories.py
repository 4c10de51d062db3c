"""The categories as data: which questions are asked of which controllers."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Literal

from generator.hybrid.part import Packing
from generator.instances import MOST_RAYS, MOST_WEIGHTS, ControllerFile, Question
from generator.openloop.part import MakePart, open_loop_part
from generator.partition import Partition
from generator.unrolled.part import unrolled_part
from racecar.disturbance import Disturbance, Mirrors
from racecar.experiment import FULL_SCAN_RAYS
from racecar.faultmodels.spec import Segment

LOWER, UPPER = "0.65", "0.85"


@dataclass(frozen=True)
class Category:
    """A folder of instances.

    timeout: seconds that a tool may take for one instance; partitions: of the start range,
    for every controller that has a training record; finer: further ones, for controllers like the
    paper's; asked: further questions to every controller, the controller and the category left
    out of their IDs; listed: questions to one, as (controller, question); packing: how the
    instances are emitted as hybrid automata; most_weights: of controllers for which they are;
    traces: whether the reference traces lie there; make: what makes the networks and VNN-LIB
    specifications of a category that has no JSON instances; scans: of which controllers it asks:
    those of full scans, those of less, or any.
    """

    name: str
    timeout: int
    partitions: tuple[Partition, ...] = ()
    finer: tuple[Partition, ...] = ()
    asked: tuple[Question, ...] = ()
    listed: tuple[tuple[str, Question], ...] = ()
    packing: Packing = Packing.NONE
    most_weights: int = MOST_WEIGHTS
    traces: bool = False
    make: MakePart | None = None
    scans: Literal["full", "less", "any"] = "less"

    def asks(self, rays: int) -> bool:
        """Whether it asks controllers that read so many rays."""
        return self.scans == "any" or (self.scans == "full") == (rays >= FULL_SCAN_RAYS)

    def printed(self, file: ControllerFile) -> bool:
        """Whether a controller's instances are emitted as hybrid automata.

        Those of further seeds of a setup are not: they differ in weights only.
        """
        few = self.scans == "full" or file.controller.rays <= MOST_RAYS
        light = file.weights <= self.most_weights
        return self.packing is not Packing.NONE and few and light and not file.further_seed

    def partitions_of(self, file: ControllerFile) -> tuple[Partition, ...]:
        """Return the partitions whose subsets a controller is asked about."""
        return self.partitions + (self.finer if file.like_the_papers else ())

    def questions(self, file: ControllerFile) -> Iterator[Question]:
        """Yield the questions to ask of a controller."""
        controller = file.name
        prefix = f"{controller}.{self.name}"
        for partition in self.partitions_of(file):
            ids = partition.ids(prefix)
            for subset, names in zip(partition.subsets, ids, strict=True):
                for name, safety in zip(names, partition.properties, strict=True):
                    yield Question(name, self.name, subset, safety=safety)
        for question in self.asked:
            yield replace(question, id=f"{prefix}.{question.id}")
        for wanted, question in self.listed:
            if wanted == controller:
                yield question


def _partition(width: str, *properties: str) -> Partition:
    return Partition(LOWER, UPPER, width, properties)


def _quick(
    controller: str,
    label: str,
    start: tuple[str, str],
    safety: str = "clearance",
    front: str = "9.9",
    speed: str = "0",
    heading: str = "0",
    steps: int = 70,
) -> tuple[str, Question]:
    name = f"{controller}.quick.{label}{steps:02}.{safety}"
    return controller, Question(
        name, "quick", start, front, speed, heading, steps=steps, safety=safety
    )


_TD3, _DDPG = "TD3_L21_64x64_C1", "DDPG_L21_64x64_C1"
_RANGE = (LOWER, UPPER)

# Quick questions were chosen by simulation, so that whatever the answer is, it is clear by more
# than 2 cm. The answers themselves stand in no file of this package.
_QUICK = (
    _quick(_TD3, "straight", _RANGE, steps=5),
    _quick(_DDPG, "straight", _RANGE, steps=5, safety="hscc20"),
    _quick(_TD3, "straight", _RANGE, steps=10),
    _quick(_DDPG, "straight", _RANGE, steps=10),
    _quick(_TD3, "straight", ("0.70", "0.80"), steps=20, safety="hscc20"),
    # At full speed where the turn begins.
    _quick(_DDPG, "turn", ("0.74", "0.76"), front="2", speed="2.4", steps=10),
    _quick(_TD3, "turn", ("0.74", "0.76"), front="2.2", speed="2.4", steps=20, safety="hscc20"),
    # The benchmark's own drive, from 5 mm of its start range.
    _quick(_TD3, "drive", ("0.770", "0.775")),
    _quick(_DDPG, "drive", ("0.650", "0.655")),
    # Some starts are too close to the wall already.
    _quick(_DDPG, "close", ("0.25", "0.35"), steps=5, safety="hscc20"),
    # No steering saves a car that points at the wall, or begins to turn so late.
    _quick(_TD3, "nose", ("0.50", "0.55"), speed="2.4", heading="60", steps=5),
    _quick(_TD3, "late", ("0.74", "0.76"), front="1", speed="2.4", steps=10),
    _quick(_DDPG, "late", ("0.74", "0.76"), front="1.2", speed="2.4", steps=20, safety="hscc20"),
    # Most starts go well and a few do not; in the last, only between control instants.
    _quick(_DDPG, "swerve", _RANGE, speed="2.4", heading="40", steps=20),
    _quick(_TD3, "swerve", _RANGE, front="1.7", speed="2.4", heading="-40"),
)

# Uncertain s, f, v and heading at once, in five sizes, from the benchmark's start and at full
# speed before the turn. docs/categories.md says how far the reference verifier gets.
_SIZES = (
    # s and f (mm), v (mm/s), heading (degrees): the whole widths of the box.
    ("5", "10", "0.2"),
    ("20", "50", "1"),
    ("50", "100", "3"),
    ("100", "200", "6"),
    ("200", "400", "20"),
)
#: What begins the ID; front (m); speed (m/s) in the middle of the box, or 0: it begins there.
_PLACES = (("start", "9.9", "0"), ("turn", "4", "2.4"))


def _around(middle: str, width: str, scale: str = "1") -> tuple[str, str]:
    """Return the bounds of a range of a width, given in ``scale`` of the middle's unit."""
    half = Decimal(width) * Decimal(scale) / 2
    return f"{Decimal(middle) - half:f}", f"{Decimal(middle) + half:f}"


def _box(place: str, front: str, speed: str, size: tuple[str, str, str]) -> Question:
    wide, fast, turned = size
    # No car starts backwards.
    middle = Decimal(speed) or Decimal(fast) / 2000
    return Question(
        f"{place}.s{wide}mm.f{wide}mm.v{fast}mmps.h{turned}deg.clearance",
        "state_box",
        _around("0.75", wide, "0.001"),
        _around(front, wide, "0.001"),
        _around(f"{middle}", fast, "0.001"),
        _around("0", turned),
    )


def _disturbed(
    category: str,
    label: str,
    disturbance: Disturbance | None,
    width: str,
    steps: int,
    safety: str = "clearance",
) -> Question:
    """Ask about starts on a line in s, ``width`` mm wide around its middle."""
    return Question(
        f"{label}s{width}mm.k{steps}.{safety}",
        category,
        _around("0.75", width, "0.001"),
        steps=steps,
        safety=safety,
        disturbance=disturbance,
    )


def _noise(millimetres: int, width: str, steps: int, category: str = "noise") -> Question:
    disturbance = Disturbance(noise=millimetres / 1000, missing=0, turn_only=False, choice="step")
    return _disturbed(category, f"n{millimetres}mm.", disturbance, width, steps)


def _faults(missing: int, choice: Literal["run", "step"], width: str, steps: int) -> Question:
    disturbance = Disturbance(noise=0, missing=missing, turn_only=True, choice=choice)
    return _disturbed("faults", f"m{missing}.{choice}.", disturbance, width, steps)


def _noise_and_faults(millimetres: int, missing: int, width: str, steps: int) -> Question:
    disturbance = Disturbance(
        noise=millimetres / 1000, missing=missing, turn_only=True, choice="run"
    )
    return _disturbed("faults", f"n{millimetres}mm.m{missing}.run.", disturbance, width, steps)


def _stretch(wall: Literal["left", "front"], near: str, far: str) -> Segment:
    """Return a stretch of an outer wall at the first turn: from near to far of the corner, m."""
    ends = (0.0, float(near)), (0.0, float(far))
    if wall == "front":
        ends = (float(near), 0.0), (float(far), 0.0)
    return Segment(hall=0, begin=ends[0], end=ends[1])


#: Beyond this angle (degrees, from its normal) a wall mirrors.
_INCIDENCE = 45
#: Stretches of 1 m, one every 0.5 m, on either outer wall up to 4 m from the first corner.
_STRETCHES = tuple(
    _stretch(wall, f"{Decimal(i) / 2}", f"{Decimal(i) / 2 + 1}")
    for wall in ("left", "front")
    for i in range(7)
)


def _mirrors(label: str, segments: tuple[Segment, ...], width: str) -> Question:
    mirrors = Mirrors(segments=segments, incidence=math.radians(_INCIDENCE))
    disturbance = Disturbance(noise=0, missing=0, turn_only=False, choice="run", mirrors=mirrors)
    return _disturbed("faults", f"mirror{_INCIDENCE}deg.{label}.", disturbance, width, 70)


# The car comes to the turn, where rays may be missing, at about the 37th control instant. So the
# horizon says how many scans are spoiled: one, three, five, eight, or all of the turn. With a ray
# less, simulated runs crash between the 42nd and the 50th instant, if they do.
_FAULTS = tuple(
    _faults(missing, choice, width, steps)
    for missing in (1, 2, 5)
    for choice in ("run", "step")
    for width, steps in (("20", 38), ("20", 40), ("20", 42), ("20", 45), ("200", 70))
)


def _single(wall: Literal["left", "front"], near: str, far: str) -> tuple[str, tuple[Segment]]:
    return f"{wall}{near}to{far}m", (_stretch(wall, near, far),)


# One stretch that mirrors, or any of the list. Single ones are those that rays meet at shallow
# angles: of the front wall not the first two metres, which the car faces.
_MIRRORS = tuple(
    _mirrors(label, segments, width)
    for label, segments in (
        _single("left", "0", "1"),
        _single("left", "1", "2"),
        _single("front", "2", "3"),
        _single("front", "3", "4"),
        ("any1mof0to4m", _STRETCHES),
    )
    for width in ("20", "200")
)
# A missing ray among noisy ones.
_MIXED = tuple(
    _noise_and_faults(millimetres, 1, width, steps)
    for millimetres in (2, 5)
    for width, steps in (("20", 40), ("20", 70), ("200", 70))
)
_NOISE = tuple(
    _noise(millimetres, width, steps)
    for millimetres in (2, 5, 10, 20)
    for width, steps in (("20", 20), ("20", 40), ("20", 70), ("200", 70))
)
#: Control periods of a full lap: four turns.
_LAP = 320
_LAPS = (
    *(_disturbed("lap", "", None, width, _LAP) for width in ("1", "20", "200")),
    _disturbed("lap", "", None, "200", _LAP, "hscc20"),
    # Two laps, and one with noise.
    _disturbed("lap", "", None, "200", 2 * _LAP),
    _noise(2, "20", _LAP, "lap"),
)

CATEGORIES = {
    category.name: category
    for category in (
        Category(
            "closed_loop",
            timeout=60,
            partitions=(_partition("0.005", "clearance"),),
            finer=(_partition("0.002", "clearance"), _partition("0.001", "clearance")),
            packing=Packing.ARCHIVE,
        ),
        Category(
            "full_range",
            timeout=300,
            partitions=(_partition("0.2", "clearance", "hscc20"),),
            packing=Packing.PARTS,
            traces=True,
        ),
        Category(
            "full_scan",
            timeout=300,
            partitions=(
                _partition("0.005", "clearance"),
                _partition("0.2", "clearance", "hscc20"),
            ),
            packing=Packing.SHARED_ARCHIVE,
            most_weights=80_000,  # of 64x64 neurons; the automata take 5 MB
            traces=True,
            scans="full",
        ),
        Category(
            "state_box",
            timeout=120,
            asked=tuple(_box(*place, size) for place in _PLACES for size in _SIZES),
            packing=Packing.ARCHIVE,
        ),
        Category("noise", timeout=120, asked=_NOISE),
        Category("faults", timeout=120, asked=(*_FAULTS, *_MIRRORS, *_MIXED)),
        Category("lap", timeout=300, asked=_LAPS),
        Category("open_loop", timeout=60, make=open_loop_part, scans="any"),
        Category("unrolled", timeout=60, make=unrolled_part),
        Category("quick", timeout=20, listed=_QUICK, packing=Packing.WHOLE),
    )
}
