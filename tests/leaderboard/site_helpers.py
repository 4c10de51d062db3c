"""Runs written through the store, over real instances, and the sites made of them."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path

from click.testing import CliRunner

from harness.catalogue import load_category, relative, sha256
from harness.checks import check_entry
from harness.machine import describe_machine
from harness.records import Limits, Record, RunInfo, ToolInfo, verdict_of
from harness.store import RunFolder
from leaderboard.cli import main

ROOT = Path(__file__).parents[2] / "benchmarks"
#: Real instances. Starts of the first lie in the unsafe set; of the others nothing is near.
CLOSE = "DDPG_L21_64x64_C1.quick.close05.hscc20"
STRAIGHT = "TD3_L21_64x64_C1.quick.straight05.clearance"
DRIVE = "TD3_L21_64x64_C1.quick.drive70.clearance"
#: s <= 0.3 is unsafe there: such a start is a witness, the other is none.
WITNESS = {"s": 0.28, "f": 9.9, "v": 0.0, "theta": 0.0}
NO_WITNESS = {"s": 0.32, "f": 9.9, "v": 0.0, "theta": 0.0}


@dataclass(frozen=True)
class Answer:
    """What a tool is made to have answered; time in seconds."""

    result: str
    time: float = 1.0
    witness: dict | None = None
    log: str = "done\n"


def write_run(path, tool, answers, created="2026-03-04T05:06:07+00:00"):
    """Write a run of a tool with answers by instance; witnesses are really replayed."""
    entries = {entry.id: entry for entry in load_category(ROOT, "quick")}
    folder = RunFolder.create(path)
    lock = folder.lock()
    info = ToolInfo(name=tool, version="1.2", folder="somewhere", scripts_sha256="ab" * 32)
    folder.write_info(
        RunInfo(
            tool=info,
            benchmarks=None,
            timeout_s=None,
            created_at=created,
            harness_version="0.1.0",
            machine=describe_machine(),
        )
    )
    for instance, answer in answers.items():
        entry = entries[instance]
        record = Record(
            instance=instance,
            category=entry.category,
            onnx=relative(entry.onnx, ROOT),
            spec=relative(entry.spec, ROOT),
            onnx_sha256=sha256(entry.onnx),
            spec_sha256=sha256(entry.spec),
            tool=tool,
            tool_version="1.2",
            command=["bash", "run_instance.sh"],
            started_at=created,
            prepare_time=0.01,
            run_time=answer.time,
            cpu_time=0.5,
            max_memory_mib=12.5,
            result=answer.result,
            verdict=verdict_of(answer.result),
            limits=Limits(
                wall_s=20, wall_end_s=20.1, wall_kill_s=20.25, prepare_wall_s=600, kept_by="test"
            ),
            log=f"{instance}.log",
        )
        witness = check = None
        if answer.result == "sat":
            witness = json.dumps(answer.witness).encode() if answer.witness else b""
            check = check_entry(entry, record, witness)
        folder.add(record, log=answer.log.encode(), witness=witness, check=check)
    folder.finish()
    folder.close()
    os.close(lock)
    return path


def write_contest(folder):
    """Write three tools' runs: alpha is right, beta is refuted by it, gamma solves little."""
    write_run(
        folder / "alpha",
        "alpha",
        {
            CLOSE: Answer("sat", 0.5, WITNESS),
            STRAIGHT: Answer("unsat", 2.0, log="alpha says <b>unsat</b>\n"),
            DRIVE: Answer("unsat", 9.0),
        },
    )
    write_run(
        folder / "beta",
        "beta",
        {
            CLOSE: Answer("unsat", 0.7),
            STRAIGHT: Answer("unsat", 1.0),
            DRIVE: Answer("run_instance_timeout", 20.1),
        },
    )
    write_run(
        folder / "gamma",
        "gamma",
        {CLOSE: Answer("sat", 0.2, NO_WITNESS), STRAIGHT: Answer("unknown", 3.0)},
    )
    return folder


@dataclass(frozen=True)
class Done:
    """How a command line ended."""

    returncode: int
    stdout: str
    stderr: str


def leaderboard(*arguments):
    """Run the command line within this process."""
    result = CliRunner().invoke(main, [str(x) for x in arguments], prog_name="leaderboard")
    if result.exception and not isinstance(result.exception, SystemExit):
        raise result.exception
    return Done(result.exit_code, result.stdout, result.stderr)


def build(*arguments):
    """Build a site; return what the command said of it."""
    done = leaderboard("build", *arguments, "--benchmarks", ROOT, "--json")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def contents(site):
    """Return every file of a site with its content and when it was written."""
    return {
        path.relative_to(site).as_posix(): (path.read_bytes(), path.stat().st_mtime_ns)
        for path in site.rglob("*")
        if path.is_file()
    }
