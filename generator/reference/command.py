"""The command ``generator reference``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import click
from rich.console import Console
from rich.table import Table

from generator.command_options import FOLDER, root_option
from racecar.command_line import CHECK_FAILED, DONE, print_json
from racecar.errors import BadInput

if TYPE_CHECKING:
    from generator.reference.make import Question
    from generator.reference.rows import Row
    from generator.reference.runs import Work
    from harness.catalogue import Entry

#: Its certificates settle most of the second one.
_WHOLE, _PARTS = "full_range", "closed_loop"


@dataclass(frozen=True)
class Selection:
    """Names of categories, controllers and instances; empty: all."""

    categories: tuple[str, ...]
    controllers: tuple[str, ...]
    instances: tuple[str, ...]


@click.command()
@click.option("--verify", "verifying", is_flag=True, help="Verify the results that are there.")
@click.option("--category", "categories", multiple=True, help="May be repeated.")
@click.option("--controller", "controllers", multiple=True, help="A name; may be repeated.")
@click.option("--instance", "instances", multiple=True, help="An ID; may be repeated.")
@click.option("--sample", type=click.IntRange(1), metavar="N", help="Verify N rows only.")
@click.option("--seed", type=int, default=0, show_default=True, help="Of the sample.")
@click.option(
    "--same-bytes", is_flag=True,
    help="With --verify: a certificate with another hash fails, even if it proves the row.",
)  # fmt: skip
@click.option(
    "--work", type=FOLDER, default="reference", show_default=True,
    help="For the runs and the certificates; run again to go on where it stopped.",
)  # fmt: skip
@click.option(
    "--timeout", type=click.FloatRange(0, min_open=True), metavar="S",
    help="Seconds for every instance, instead of its own timeout.",
)  # fmt: skip
@click.option(
    "--check-timeout", type=click.FloatRange(0, min_open=True), default=600.0, show_default=True,
    metavar="S", help="Seconds for the check of a certificate; what takes longer stays unknown.",
)  # fmt: skip
@click.option("--jobs", type=click.IntRange(1), help="Instances at a time.  [default: 1]")
@click.option("--scheduler", metavar="ADDRESS", help="Run on the workers of a Dask scheduler.")
@root_option
@click.option("--json", "as_json", is_flag=True, help="Print one JSON object per result.")
def reference(
    verifying: bool, categories: tuple[str, ...], controllers: tuple[str, ...],
    instances: tuple[str, ...], sample: int | None, seed: int, same_bytes: bool, work: Path,
    timeout: float | None, check_timeout: float, jobs: int | None, scheduler: str | None,
    root: Path, as_json: bool,
) -> int:  # fmt: skip
    """Settle instances and write ROOT/benchmarks/CATEGORY/reference.csv.

    unsat: the reference verifier's certificate is accepted by the checker, in full; sat: a
    witness holds in the harness's replay, or on the network that a VNN-LIB question is about;
    anything else is unknown. With --verify the rows that are there are verified anew; status 1 if
    one fails.
    """
    from generator.reference.runs import Work  # noqa: PLC0415 (slow to import)

    if sample is not None and not verifying:
        raise click.UsageError("--sample: it goes with --verify")
    if jobs is not None and scheduler is not None:
        raise click.UsageError("--jobs: with --scheduler the workers say how many run at a time")
    options = [f"--jobs={jobs}"] if jobs else []
    options += [f"--scheduler={scheduler}"] if scheduler else []
    benchmarks = root.resolve() / "benchmarks"
    place = Work(work.resolve(), benchmarks, timeout, check_timeout, tuple(options), as_json)
    chosen = Selection(categories, controllers, instances)
    if verifying:
        return _verify(benchmarks, chosen, place, (sample, seed), same_bytes, as_json)
    return _make(benchmarks, chosen, place, as_json)


def _make(benchmarks: Path, chosen: Selection, work: Work, as_json: bool) -> int:
    from generator.reference.make import Contradiction, load_questions, make  # noqa: PLC0415
    from generator.reference.queries import make_queries  # noqa: PLC0415
    from generator.reference.rows import (  # noqa: PLC0415
        read_rows,
        read_witnesses,
        write_category,
    )

    entries = _select(benchmarks, chosen)
    wanted = {entry.id for entry in entries}
    names = {entry.category for entry in entries}
    if _PARTS in names and not chosen.instances:
        whole = _select(benchmarks, Selection((_WHOLE,), chosen.controllers, ()), strict=False)
        entries = list({entry.id: entry for entry in [*entries, *whole]}.values())

    def report(done: int, total: int) -> None:
        if not as_json:
            click.echo(f"{done} of {total} instances settled or given up", err=True)

    loops, queries = _apart(entries)
    try:
        results = make(load_questions(loops), work, report)
    except Contradiction as error:
        click.echo(f"error: {error}", err=True)
        return CHECK_FAILED
    if queries:
        more = make_queries(queries, work, report)
        results.rows |= more.rows
        results.witnesses |= more.witnesses
    for name in sorted(names):
        folder = benchmarks / name
        rows, witnesses = read_rows(folder), read_witnesses(folder)
        rows |= {id: row for id, row in results.rows.items() if id in wanted}
        listed = [rows[entry.id] for entry in _load(benchmarks, name) if entry.id in rows]
        write_category(folder, listed, witnesses | results.witnesses)
    _show_counts(benchmarks, names, results.rows, entries, as_json)
    return DONE


def _show_counts(
    benchmarks: Path,
    names: set[str],
    rows: Mapping[str, Row],
    entries: Sequence[Entry],
    as_json: bool,
) -> None:
    table = Table("category", "sat", "unsat", "unknown")
    for name in sorted(names):
        mine = [rows[entry.id] for entry in entries if entry.category == name]
        counts = Counter(row.verdict for row in mine)
        shown = {verdict: counts[verdict] for verdict in ("sat", "unsat", "unknown")}
        if as_json:
            print_json({"category": name, **shown})
        else:
            table.add_row(name, *map(str, shown.values()))
    if not as_json:
        Console().print(table)
        click.echo(f"written below {benchmarks}")


def _verify(
    benchmarks: Path,
    chosen: Selection,
    work: Work,
    drawn: tuple[int | None, int],
    same_bytes: bool,
    as_json: bool,
) -> int:
    from generator.reference.make import load_questions  # noqa: PLC0415
    from generator.reference.queries import verify_queries  # noqa: PLC0415
    from generator.reference.rows import read_rows, read_witnesses  # noqa: PLC0415
    from generator.reference.verify import sample, verify  # noqa: PLC0415
    from harness.catalogue import category_names  # noqa: PLC0415

    entries = _select(benchmarks, chosen)
    wanted = {entry.id for entry in entries}
    names = list(dict.fromkeys(entry.category for entry in entries))
    listed = [row for name in names for row in read_rows(benchmarks / name).values()]
    everything = not (chosen.instances or chosen.controllers)
    rows = sample((row for row in listed if everything or row.instance in wanted), *drawn)
    if not rows:
        raise BadInput(f"{benchmarks}: there is no reference result to verify")
    ids = {row.instance for row in rows} | {row.source for row in rows if row.source}
    known = {e.id: e for n in category_names(benchmarks) for e in _load(benchmarks, n)}
    loops, queries = _apart(known[id] for id in sorted(ids & known.keys()))
    witnesses = {
        id: text
        for name in category_names(benchmarks)
        for id, text in read_witnesses(benchmarks / name).items()
    }
    asked = {entry.id: entry for entry in queries}
    of_queries = [row for row in rows if row.instance in asked]
    of_loops = [row for row in rows if row.instance not in asked]
    found = verify(of_loops, _by_id(load_questions(loops)), witnesses, work, same_bytes)
    if of_queries:
        found += verify_queries(of_queries, asked, witnesses, work, same_bytes)
    failed = [row for row in found if row.fault]
    for row in found if as_json else []:
        print_json({"instance": row.instance, "verdict": row.verdict, "fault": row.fault or None})
    if not as_json:
        for row in failed:
            click.echo(f"{row.instance}: {row.verdict} does not hold: {row.fault}")
        counts = Counter(row.verdict for row in found)
        shown = ", ".join(f"{n} {verdict}" for verdict, n in sorted(counts.items()))
        click.echo(f"{len(found)} rows ({shown}); {len(failed)} failed")
    return CHECK_FAILED if failed else DONE


def _by_id(questions: Iterable[Question]) -> dict[str, Question]:
    return {question.id: question for question in questions}


def _apart(entries: Iterable[Entry]) -> tuple[list[Entry], list[Entry]]:
    """Return closed loops, and questions about networks."""
    from harness.catalogue import is_query  # noqa: PLC0415

    found: tuple[list[Entry], list[Entry]] = ([], [])
    for entry in entries:
        found[is_query(entry.spec)].append(entry)
    return found


def _load(benchmarks: Path, name: str) -> list[Entry]:
    from harness.catalogue import load_category  # noqa: PLC0415

    return load_category(benchmarks, name)


def _select(benchmarks: Path, chosen: Selection, strict: bool = True) -> list[Entry]:
    """Return the instances that are asked for; BadInput if there are none."""
    from harness.catalogue import category_names  # noqa: PLC0415

    there = category_names(benchmarks)
    unknown = [name for name in chosen.categories if name not in there]
    if unknown and strict:
        raise BadInput(f"--category {unknown[0]}: there is no such one; choose {', '.join(there)}")
    names = [name for name in chosen.categories or there if name in there]
    entries = [entry for name in names for entry in _load(benchmarks, name)]
    for option, asked, have in (
        ("--controller", chosen.controllers, {_controller(entry) for entry in entries}),
        ("--instance", chosen.instances, {entry.id for entry in entries}),
    ):
        missing = [name for name in asked if name not in have]
        if missing and strict:
            raise BadInput(f"{option} {missing[0]}: there is no such one in {', '.join(names)}")
    return [
        entry
        for entry in entries
        if (not chosen.controllers or _controller(entry) in chosen.controllers)
        and (not chosen.instances or entry.id in chosen.instances)
    ]


def _controller(entry: Entry) -> str:
    """Return the controller's name; a graph of unrolled steps has more after it."""
    name = entry.onnx.name.removesuffix(".gz").removesuffix(".onnx")
    return name.partition(".")[0]
