"""``harness replay``: judge one witness by hand."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import click

from harness.command_options import as_path, benchmarks_option, json_option
from racecar.command_line import CHECK_FAILED, DONE, print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from harness.catalogue import Entry


@click.command("replay")
@click.argument("instance", type=as_path)
@click.argument("witness", type=as_path)
@click.option("--onnx", type=as_path, help="The network of a VNN-LIB file; default: as listed.")
@benchmarks_option
@json_option
def replay_command(
    instance: Path, witness: Path, onnx: Path | None, benchmarks: Path | None, as_json: bool
) -> int:
    """Check a witness independently of every tool.

    INSTANCE is an instance's file, JSON or VNN-LIB, or its ID. WITNESS is a file with the witness
    that the instance asks for, or a result file: sat, then the witness. Ends with status 0 if a
    tool is credited for it, 1 if not.
    """
    from harness import report
    from harness.answer import read_witness
    from harness.catalogue import is_query
    from harness.checks import judge_entry

    if not is_query(instance) and onnx is not None:
        raise BadInput(f"--onnx: {instance} names its controller itself; leave it out")
    entry = _entry(instance, onnx, benchmarks)
    check = judge_entry(entry, read_witness(witness))
    if as_json:
        data = check.model_dump(mode="json")
        flags = {"credited": check.credited, "establishes_sat": check.establishes_sat}
        print_json({**data, **flags})
    else:
        report.print_check(check)
    return DONE if check.credited else CHECK_FAILED


def _entry(instance: Path, onnx: Path | None, benchmarks: Path | None) -> Entry:
    from harness.catalogue import Entry, find_root, instance_id, is_query, load_file, select

    if instance.is_file() and not is_query(instance):
        return load_file(instance)
    if onnx is not None:
        return Entry(instance_id(instance), "", onnx, instance, 1.0)
    return select(find_root(benchmarks), [], [str(instance)])[0]
