"""What the keeper of limits is asked to keep, and by what means it does.

Plain data without any import that costs memory: the keeper is forked for every command.
"""

from __future__ import annotations

from dataclasses import dataclass

#: Means; docs/limits.md says what each can and cannot do.
CGROUP, SAMPLES, NOTHING = "cgroup", "samples", "nothing"
CPUSET, AFFINITY, LANDLOCK = "cpuset", "affinity", "landlock"
SUBREAPER, GROUP = "subreaper", "process group"

#: What a command can use too much of.
WALL, CPU, MEMORY, OUTPUT, SCRATCH = "wall time", "CPU time", "memory", "output", "scratch"


@dataclass(frozen=True)
class Bounds:
    """Bounds for one command; null is no bound.

    wall_s, cpu_s: seconds; memory, output, scratch: bytes; cores: numbers of the cores to run on;
    result: the result file, which ``output`` bounds as well; folder: the scratch folder;
    contain: nothing outside that folder may be written.
    """

    wall_s: float
    cpu_s: float | None = None
    memory: int | None = None
    output: int | None = None
    scratch: int | None = None
    cores: tuple[int, ...] | None = None
    result: str | None = None
    folder: str | None = None
    contain: bool = False


@dataclass(frozen=True)
class Means:
    """By what processes were found, measured and kept in bounds; NOTHING: by no means."""

    processes: str = NOTHING
    cpu: str = NOTHING
    memory: str = NOTHING
    cores: str = NOTHING
    writes: str = NOTHING
    signals: str = NOTHING


@dataclass(frozen=True)
class Outcome:
    """How a command ended.

    exit_code: 128 + the signal's number if a signal ended it; exceeded: what it used too much
    of (WALL, CPU, ...), whether or not it had to be ended for that; wall_s: from before
    its start to its end; cpu_s: user and system time of all of its processes;
    max_memory: bytes, of all of its processes together; survivors: processes that could not
    be killed.
    """

    exit_code: int
    exceeded: str | None
    wall_s: float
    cpu_s: float
    max_memory: int
    survivors: int
    means: Means

    @property
    def timed_out(self) -> bool:
        """Whether it was ended at its limit of wall time."""
        return self.exceeded == WALL
