"""The categories as data: which questions are asked of which controllers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from generator.hybrid.part import Packing
from generator.instances import Question
from generator.openloop.part import MakePart, open_loop_part
from generator.partition import Partition
from generator.unrolled.part import unrolled_part

LOWER, UPPER = "0.65", "0.85"


@dataclass(frozen=True)
class Category:
    """A folder of instances.

    timeout: seconds that a tool may take for one instance; partitions: of the start range,
    for every controller that has a training record; listed: further questions, as (controller,
    question with the controller and category left out of its ID); packing: how the instances
    are emitted as hybrid automata; traces: whether the reference traces lie there; make: what
    makes the networks and VNN-LIB specifications of a category that has no JSON instances.
    """

    name: str
    timeout: int
    partitions: tuple[Partition, ...] = ()
    listed: tuple[tuple[str, Question], ...] = ()
    packing: Packing = Packing.NONE
    traces: bool = False
    make: MakePart | None = None

    def questions(self, controller: str) -> Iterator[Question]:
        """Yield the questions to ask of a controller."""
        prefix = f"{controller}.{self.name}"
        for partition in self.partitions:
            ids = partition.ids(prefix)
            for subset, names in zip(partition.subsets, ids, strict=True):
                for name, safety in zip(names, partition.properties, strict=True):
                    yield Question(name, self.name, subset, safety=safety)
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

CATEGORIES = {
    category.name: category
    for category in (
        Category(
            "closed_loop",
            timeout=60,
            partitions=tuple(
                _partition(width, "clearance") for width in ("0.005", "0.002", "0.001")
            ),
            packing=Packing.ARCHIVE,
        ),
        Category(
            "full_range",
            timeout=300,
            partitions=(_partition("0.2", "clearance", "hscc20"),),
            packing=Packing.PARTS,
            traces=True,
        ),
        Category("open_loop", timeout=60, make=open_loop_part),
        Category("unrolled", timeout=60, make=unrolled_part),
        Category("quick", timeout=20, listed=_QUICK, packing=Packing.WHOLE),
    )
}
