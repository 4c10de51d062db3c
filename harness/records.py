"""What a run leaves behind, as typed data: results, witness checks, the run itself.

Result codes are VNN-COMP 2026's, exactly.
"""

from __future__ import annotations

import re
from enum import StrEnum
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Sha256 = Annotated[str, Field(pattern=r"^[0-9a-f]{64}$")]
#: One file name: no folder, nothing hidden.
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", max_length=200)]
Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]


class Data(BaseModel):
    """Base of all that the harness stores: unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Verdict(StrEnum):
    """What a result counts as."""

    SAT = "sat"
    UNSAT = "unsat"
    UNKNOWN = "unknown"
    TIMEOUT = "timeout"
    ERROR = "error"


RUN_TIMEOUT = "run_instance_timeout"
PREPARE_TIMEOUT = "prepare_instance_timeout"
PREPARE_ERROR = "prepare_instance_error_"
RUN_ERROR = "error_exit_code_"
NO_RESULT = "no_result_in_file"

_CODES = {
    **{str(verdict): verdict for verdict in Verdict},
    RUN_TIMEOUT: Verdict.TIMEOUT,
    PREPARE_TIMEOUT: Verdict.TIMEOUT,
    NO_RESULT: Verdict.UNKNOWN,
}
_PREFIXES = {PREPARE_ERROR: Verdict.UNKNOWN, RUN_ERROR: Verdict.ERROR}


def verdict_of(result: str) -> Verdict:
    """Return what a result code counts as, by VNN-COMP's rules; ValueError for other text."""
    if result in _CODES:
        return _CODES[result]
    for prefix, verdict in _PREFIXES.items():
        if re.fullmatch(prefix + r"\d+", result):
            return verdict
    raise ValueError(f"{result!r} is not a result code")


class WitnessOutcome(StrEnum):
    """What the independent check of a witness found."""

    CORRECT = "correct"
    CORRECT_WITH_TOLERANCE = "correct_with_tolerance"
    WRONG = "wrong"
    OUT_OF_BOX = "out_of_box"
    MALFORMED = "malformed"
    MISSING = "missing"
    UNSUPPORTED = "unsupported"

    @property
    def sentence(self) -> str:
        """What the outcome means."""
        return _SENTENCES[self]

    @property
    def credited(self) -> bool:
        """Whether the tool earns the points of its ``sat``."""
        return self in (WitnessOutcome.CORRECT, WitnessOutcome.CORRECT_WITH_TOLERANCE)

    @property
    def establishes_sat(self) -> bool:
        """Whether the instance is thereby known to be sat."""
        return self is WitnessOutcome.CORRECT


_SENTENCES = {
    WitnessOutcome.CORRECT: (
        "The instance allows what the witness gives, and it leads into the unsafe set."
    ),
    WitnessOutcome.CORRECT_WITH_TOLERANCE: (
        "It leads into the unsafe set only up to the tolerance: "
        "the tool is credited, the instance is not thereby known to be sat."
    ),
    WitnessOutcome.WRONG: "What the witness gives does not lead into the unsafe set.",
    WitnessOutcome.OUT_OF_BOX: (
        "The witness gives what the instance does not allow: a number is off by more than the "
        "tolerance, or rays are missing, or a wall mirrors, that may not."
    ),
    WitnessOutcome.MALFORMED: "The witness has not the form that the instance asks for.",
    WitnessOutcome.MISSING: "There is no witness.",
    WitnessOutcome.UNSUPPORTED: (
        "The harness cannot judge witnesses of this instance: the answer earns and costs nothing."
    ),
}


class WitnessCheck(Data):
    """The independent check of one witness.

    Closed loops: margin (m) is the replayed run's least margin in continuous time. VNN-LIB
    queries: violation is by how much the network's outputs meet the condition that the query
    asserts of them (negative: by how much they miss it), in the outputs' own unit. outside is the
    largest distance of a number from what the instance allows, in its own unit (0: allowed); null
    where no distance tells, as with rays that may not be missing, or a mirror that is none. Where
    there was nothing to replay, or nothing that has such a number, it is null.
    """

    format: Literal["closedlap-witness-check"] = "closedlap-witness-check"
    version: Literal["1.0"] = "1.0"
    instance: Name
    outcome: WitnessOutcome
    message: str
    margin: float | None = Field(default=None, description="closed loops; m")
    violation: float | None = Field(default=None, description="VNN-LIB; unit of the outputs")
    outside: float | None = None
    witness_sha256: Sha256
    spec_sha256: Sha256
    onnx_sha256: Sha256
    checked_with: dict[str, str] = Field(description="versions of the programs that judged")

    @property
    def credited(self) -> bool:
        """Whether the tool earns the points of its ``sat``."""
        return self.outcome.credited

    @property
    def establishes_sat(self) -> bool:
        """Whether the instance is thereby known to be sat."""
        return self.outcome.establishes_sat


class Allowance(Data):
    """What a tool may use on one instance, beside wall time; null is the default.

    cpu_s: CPU time of all processes together, default no limit; memory_mib: of all processes
    together, default the machine's; output_mib: of what is printed, and of the result file,
    default 1 GiB; scratch_mib: of all files in the scratch folder, default the disk's.
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


class Limit(Data):
    """One limit: as asked (null: not asked for), as kept (null: none), and by what means."""

    asked: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    kept: float | None = Field(default=None, gt=0, allow_inf_nan=False)
    by: str = "nothing"


class CoreLimit(Data):
    """The cores that a tool was pinned to; null: all that the harness may use."""

    asked: list[int] | None = None
    kept: list[int] | None = None
    by: str = "nothing"


class Limits(Data):
    """Which limits were asked for, which were kept, and by what means (docs/limits.md)."""

    wall_s: Seconds = Field(description="asked: the instance's timeout, given to the tool")
    wall_end_s: Seconds = Field(description="kept: the tool is told to end then")
    wall_kill_s: Seconds = Field(description="kept: whatever is alive then is killed")
    prepare_wall_s: Seconds
    cpu_s: Limit = Field(default=Limit(), description="of run_instance.sh and all it started, s")
    memory_mib: Limit = Field(default=Limit(), description="of all processes together, MiB")
    output_mib: Limit = Field(
        default=Limit(), description="of what is printed, and of the result file, each, MiB"
    )
    scratch_mib: Limit = Field(default=Limit(), description="of the scratch folder's files, MiB")
    cores: CoreLimit = Field(default=CoreLimit(), description="numbers of the cores")
    writes_by: str = Field(default="nothing", description="what forbids writing outside scratch")
    signals_by: str = Field(default="nothing", description="what forbids signals to others")
    home: Literal["fresh", "own"] = "own"
    kept_by: str = Field(description="means by which descendants are found")


class Measured(Data):
    """By what means a record's CPU time and memory were measured (docs/limits.md)."""

    cpu_time: str
    max_memory: str


class Record(Data):
    """What one tool did on one instance."""

    format: Literal["closedlap-result"] = "closedlap-result"
    version: Literal["1.0"] = "1.0"
    instance: Name
    category: Name
    onnx: str = Field(description="relative to the benchmarks folder")
    spec: str = Field(description="relative to the benchmarks folder")
    onnx_sha256: Sha256
    spec_sha256: Sha256
    tool: Name
    tool_version: str | None
    command: list[str]
    started_at: str = Field(description="UTC, ISO 8601")
    prepare_time: Seconds = Field(description="wall, s")
    run_time: Seconds = Field(description="wall, s")
    cpu_time: Seconds = Field(description="of run_instance.sh and all it started, s")
    max_memory_mib: float = Field(description="the largest of run_instance.sh's tree, MiB")
    measured_by: Measured | None = None
    result: str
    verdict: Verdict
    detail: str | None = Field(default=None, description="why, where the code does not say it")
    limits: Limits
    witness: Name | None = Field(default=None, description="its name in the run's database")
    log: Name = Field(description="its name in the run's database")
    host: str | None = Field(default=None, description="name of the machine that it ran on")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if verdict_of(self.result) is not self.verdict:
            raise ValueError(f"verdict is {self.verdict}, but result is {self.result}")
        if self.run_time > self.limits.wall_s and self.verdict in (Verdict.SAT, Verdict.UNSAT):
            raise ValueError(f"result is {self.result}, but run_time is above the limit")
        return self


#: A description of a machine: what timings depend on, by name.
Machine = dict[str, str | int | float | None]


class ToolInfo(Data):
    """Which tool ran."""

    name: Name
    version: str | None
    folder: str
    scripts_sha256: Sha256 = Field(description="of the tool's scripts together")


class RunInfo(Data):
    """What a whole run shares."""

    format: Literal["closedlap-run"] = "closedlap-run"
    version: Literal["1.0"] = "1.0"
    tool: ToolInfo
    benchmarks: str | None
    timeout_s: Seconds | None = Field(description="of every instance, where one was asked for")
    limits: Allowance = Field(default=Allowance(), description="that were asked for beside it")
    created_at: str = Field(description="UTC, ISO 8601")
    harness_version: str
    machine: Machine = Field(description="where the harness ran")
    workers: dict[str, Machine] = Field(
        default={}, description="other machines that instances were run on, by their host names"
    )
