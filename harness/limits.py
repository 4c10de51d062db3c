"""What a tool may use, as asked for, and what was kept of it, as a record says it."""

from __future__ import annotations

from collections.abc import Sequence

from harness.bounds import NOTHING, SAMPLES, Bounds, Means
from harness.records import Allowance, CoreLimit, Limit, Limits

#: Printed output and the result file may each have this many MiB where nothing else is asked
#: for: far more than is read of them, and less than fills a disk.
DEFAULT_OUTPUT_MIB = 1024.0
MIB = 1 << 20


#: What holds where nothing is asked for.
DEFAULT = Allowance()


#: The options that ask for limits.
OPTIONS = {
    "cpu_s": "--cpu-limit (s)",
    "memory_mib": "--memory-limit (MiB)",
    "output_mib": "--output-limit (MiB)",
    "scratch_mib": "--scratch-limit (MiB)",
    "contain": "--contain",
    "fresh_home": "--fresh-home",
    "cgroups": "use of control groups",
}


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
