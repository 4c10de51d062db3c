"""What a tool may use, as asked for, and what was kept of it, as a record says it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

from pydantic import Field

from harness.bounds import NOTHING, SAMPLES, Bounds, Means
from harness.records import CoreLimit, Data, Limit, Limits

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]

#: Printed output and the result file may each have this many MiB where nothing else is asked
#: for: far more than is read of them, and less than fills a disk.
DEFAULT_OUTPUT_MIB = 1024.0
MIB = 1 << 20


class Allowance(Data):
    """What a tool may use on one instance, beside wall time; null is the default.

    cpu_s: CPU time of all processes together, default no limit; memory_mib: of all processes
    together, default the machine's; output_mib: of what is printed, and of the result file,
    default DEFAULT_OUTPUT_MIB; scratch_mib: of all files in the scratch folder, default the disk's.
    contain: nothing outside the scratch folder may be written. fresh_home: HOME is an
    empty folder in the scratch folder. cgroups: whether control groups are used where they
    work.
    """

    cpu_s: Positive | None = None
    memory_mib: Positive | None = None
    output_mib: Positive | None = None
    scratch_mib: Positive | None = None
    contain: bool = False
    fresh_home: bool = False
    cgroups: bool = True


#: What holds where nothing is asked for.
DEFAULT = Allowance()


def bounds(
    allowance: Allowance,
    wall_s: float,
    cores: Sequence[int] | None,
    result: str,
    folder: str,
    cpu: bool = True,
) -> Bounds:
    """Return what the keeper is to keep; cpu: whether the limit of CPU time holds here."""
    output = allowance.output_mib or DEFAULT_OUTPUT_MIB
    return Bounds(
        wall_s=wall_s,
        cpu_s=allowance.cpu_s if cpu else None,
        memory=_bytes(allowance.memory_mib),
        output=_bytes(output),
        scratch=_bytes(allowance.scratch_mib),
        cores=None if cores is None else tuple(cores),
        result=result,
        folder=folder,
        contain=allowance.contain,
    )


def limits_kept(
    allowance: Allowance,
    cores: Sequence[int] | None,
    means: Means,
    *,
    wall_s: float,
    wall_end_s: float,
    wall_kill_s: float,
    prepare_wall_s: float,
) -> Limits:
    """Return what a record says: each limit as asked, as kept, and by what."""
    output = allowance.output_mib or DEFAULT_OUTPUT_MIB
    return Limits(
        wall_s=wall_s,
        wall_end_s=wall_end_s,
        wall_kill_s=wall_kill_s,
        prepare_wall_s=prepare_wall_s,
        cpu_s=_limit(allowance.cpu_s, means.cpu),
        memory_mib=_limit(allowance.memory_mib, means.memory),
        output_mib=Limit(asked=allowance.output_mib, kept=output, by=SAMPLES),
        scratch_mib=_limit(allowance.scratch_mib, SAMPLES),
        cores=_core_limit(cores, means.cores),
        writes_by=means.writes,
        signals_by=means.signals,
        home="fresh" if allowance.fresh_home else "own",
        kept_by=means.processes,
    )


def _limit(asked: float | None, by: str) -> Limit:
    if asked is None:
        return Limit()
    return Limit(asked=asked, kept=None if by == NOTHING else asked, by=by)


def _core_limit(cores: Sequence[int] | None, by: str) -> CoreLimit:
    if cores is None:
        return CoreLimit()
    asked = sorted(cores)
    return CoreLimit(asked=asked, kept=None if by == NOTHING else asked, by=by)


def _bytes(mib: float | None) -> int | None:
    return None if mib is None else round(mib * MIB)
