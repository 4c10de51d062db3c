"""``harness submit`` and ``harness verify-submission``."""

# ruff: noqa: PLC0415 (imported when the command runs, so that no other command waits)

from __future__ import annotations

from pathlib import Path

import click

from harness.command_options import as_path, benchmarks_option, json_option
from racecar.command_line import CHECK_FAILED, DONE, print_json
from racecar.errors import BadInput


def _print_schema(context: click.Context, _: click.Parameter, wanted: bool) -> None:
    if wanted and not context.resilient_parsing:
        from harness.submission.model import schema_text

        click.echo(schema_text(), nl=False)
        context.exit()


@click.command("submit")
@click.argument("runs", nargs=-1, required=True, type=as_path, metavar="RUN...")
@click.option("-o", "--output", required=True, type=as_path, metavar="FILE", help="A .tar.gz.")
@click.option("--author", "authors", multiple=True, required=True, help="May be repeated.")
@click.option("--contact", required=True, metavar="MAIL", help="E-mail address for questions.")
@click.option("--tool-version", help="Where the tool's folder has no VERSION file.")
@click.option("--url", help="Where the tool is described or found.")
@click.option("--description", help="What it is, in a few sentences.")
@click.option(
    "--schema",
    is_flag=True,
    is_eager=True,
    expose_value=False,
    callback=_print_schema,
    help="Print the JSON Schema of a submission's files.",
)
@benchmarks_option
@json_option
def submit_command(
    runs: tuple[Path, ...],
    output: Path,
    authors: tuple[str, ...],
    contact: str,
    tool_version: str | None,
    url: str | None,
    description: str | None,
    benchmarks: Path | None,
    as_json: bool,
) -> int:
    """Pack runs of one tool into a submission, with all that is needed to judge them again."""
    from pydantic import ValidationError

    from harness.catalogue import find_root
    from harness.checks import witness_check
    from harness.store import RunFolder
    from harness.submission.model import About
    from harness.submission.pack import pack

    if output.is_dir() or not output.name.endswith((".tar.gz", ".tgz")):
        raise BadInput(f"-o {output}: give a file that ends in .tar.gz")
    folders = [RunFolder.open(path) for path in dict.fromkeys(path.resolve() for path in runs)]
    tool = folders[0].info().tool
    version = tool_version or tool.version
    if version is None:
        raise BadInput(f"tool {tool.name} has no version; give one with --tool-version")
    try:
        about = About(
            tool=tool.name,
            version=version,
            authors=authors,
            contact=contact,
            url=url,
            description=description,
        )
    except ValidationError as error:
        first = error.errors()[0]
        place = ".".join(map(str, first["loc"]))
        raise BadInput(f"{place}: {first['msg'].removeprefix('Value error, ')}") from None
    root = find_root(benchmarks)
    checked = [
        [(record, witness_check(folder, record, root)) for record in folder.records()]
        for folder in folders
    ]
    submission = pack(folders, checked, about, output)
    results = sum(map(len, checked))
    if as_json:
        data = {"file": str(output), "results": results, "runs": submission.runs}
        print_json({**about.model_dump(mode="json"), **data})
    else:
        click.echo(
            f"{output}: {about.tool} {about.version}, {results} results of {len(folders)} run(s); "
            f"check it with: harness verify-submission {output}"
        )
    return DONE


@click.command("verify-submission")
@click.argument("file", type=as_path)
@benchmarks_option
@json_option
def verify_command(file: Path, benchmarks: Path | None, as_json: bool) -> int:
    """Judge a submission again from its own files and the benchmarks.

    Every hash is compared, every witness replayed, every record held against its instance, the
    results counted again. Ends with status 1 if something is wrong.
    """
    from harness import report
    from harness.catalogue import load_references, require_root
    from harness.evidence import claim_of
    from harness.scoring import score
    from harness.submission.verify import group, verify_submission

    root = require_root(benchmarks)
    found = verify_submission(file, root)
    claims = [claim_of(record, check) for record, check in found.checked]
    scores = score(claims, load_references(root)) if claims else None
    if as_json:
        about = found.about.model_dump(mode="json") if found.about else None
        problems = [{"where": p.where, "what": p.what} for p in found.problems]
        rows = [report.row_data(row, scores) for row in scores.rows] if scores else []
        data = {"file": str(file), "valid": not problems, "about": about, "problems": problems}
        print_json({**data, "witnesses": found.witnesses, "rows": rows})
        return CHECK_FAILED if found.problems else DONE
    if found.about:
        click.echo(f"{found.about.tool} {found.about.version}, by {', '.join(found.about.authors)}")
    for info in found.infos:
        report.print_machine(info)
    if scores:
        report.print_scores(scores)
    for what, places in group(found.problems):
        shown = ", ".join(places[:5]) + (f" and {len(places) - 5} more" if len(places) > 5 else "")
        click.echo(f"problem: {shown}: {what}")
    if found.problems:
        click.echo(f"NOT VALID: {len(found.problems)} problem(s)")
        return CHECK_FAILED
    click.echo(f"valid: {len(found.checked)} results, {found.witnesses} witnesses replayed")
    return DONE
