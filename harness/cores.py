"""Share a machine's cores out among jobs that run at the same time."""

from __future__ import annotations

import os
from collections import defaultdict
from collections.abc import Sequence
from itertools import zip_longest
from pathlib import Path

from racecar.errors import BadInput

_TOPOLOGY = "/sys/devices/system/cpu/cpu{}/topology/{}"


def usable_cores() -> list[tuple[int, ...]]:
    """Return the logical cores that this process may use, those of one physical core together."""
    if not hasattr(os, "sched_getaffinity"):
        return [(number,) for number in range(os.cpu_count() or 1)]
    together: defaultdict[tuple[int, ...], list[int]] = defaultdict(list)
    for number in sorted(os.sched_getaffinity(0)):
        together[_physical(number)].append(number)
    return [tuple(together[place]) for place in sorted(together)]


def _physical(number: int) -> tuple[int, ...]:
    """Return a name for the physical core that a logical core belongs to."""
    try:
        return tuple(
            int(Path(_TOPOLOGY.format(number, what)).read_text())
            for what in ("physical_package_id", "core_id")
        )
    except (OSError, ValueError):
        return (-1, number)


def share_out(
    jobs: int, per_job: int | None, physical: Sequence[tuple[int, ...]]
) -> list[tuple[int, ...]]:
    """Return for each job the logical cores that it is pinned to; no two jobs share one.

    Every job gets equally many, per_job or as many as there are. Where there are enough
    physical cores, no two jobs share one of these either. BadInput if there are too few.
    """
    logical = [core for group in physical for core in group]
    if jobs * (per_job or 1) > len(logical):
        needed = f"{jobs} jobs at a time" + (f" with {per_job} cores each" if per_job else "")
        raise BadInput(f"{needed}: only {len(logical)} cores can be used; ask for less")
    whole = len(physical) // jobs
    if whole:
        places = [_spread(physical[i * whole : (i + 1) * whole]) for i in range(jobs)]
        each = per_job or min(map(len, places))
        if all(len(place) >= each for place in places):
            return [place[:each] for place in places]
    each = per_job or len(logical) // jobs
    return [tuple(logical[i * each : (i + 1) * each]) for i in range(jobs)]


def _spread(physical: Sequence[tuple[int, ...]]) -> tuple[int, ...]:
    """Return the logical cores, first one of each physical core, then the second ones, ..."""
    ranks = zip_longest(*physical)
    return tuple(core for rank in ranks for core in rank if core is not None)
