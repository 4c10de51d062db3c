"""The command ``generator export``: instances in the languages of hybrid-system tools."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from generator.command_options import CHECKOUT, FILE, FOLDER
from generator.progress import progress_bar
from racecar.command_line import print_json
from racecar.controller import write_whole
from racecar.errors import BadInput
from racecar.instance import Instance, load_instance, load_instance_controller

#: Kept here as well as in generator.hybrid.export, so that ``--help`` imports nothing heavy.
FORMATS = ("flowstar", "spaceex", "json", "verisig")


def hybrid_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """Add the arguments of ``export_hybrid`` to a click command."""
    for add in (
        click.option("--json", "as_json", is_flag=True, help="Print one JSON object per file set."),
        click.option("--plain", is_flag=True, help="Do not compress the files."),
        click.option("-o", "--output", type=FOLDER, default="export", show_default=True),
        click.option(
            "--format",
            "forms",
            multiple=True,
            type=click.Choice(FORMATS),
            help="May be repeated  [default: all]",
        ),
        click.argument("instances", nargs=-1, type=FILE),
    ):
        function = add(function)
    return function


def export_hybrid(
    instances: Sequence[Path], forms: Sequence[str], output: Path, plain: bool, as_json: bool
) -> None:
    """Write each instance in each format to OUTPUT/FORMAT, files named by the instance's ID.

    Beside the JSON files lies their schema. Raises BadInput, before anything is written, if an
    instance is bad, stands there twice, or is beyond what a format can say.
    """
    # Both are slow to import.
    from generator.hybrid.export import Exporter  # noqa: PLC0415
    from generator.hybrid.json_form import automaton_schema  # noqa: PLC0415

    if not instances:
        raise BadInput("export: name at least one instance file")
    forms, exporter = forms or FORMATS, Exporter()
    loaded: dict[str, tuple[Path, Instance]] = {}
    for path in instances:
        instance = load_instance(path)
        controller = load_instance_controller(instance, path)
        if instance.id in loaded:
            raise BadInput(f"{path}: its ID, {instance.id}, is that of {loaded[instance.id][0]}")
        loaded[instance.id] = path, instance
        for form in forms:
            exporter.prepare(instance, controller, form)
    if "json" in forms:
        schema = json.dumps(automaton_schema(), indent=2) + "\n"
        write_whole(output / "json" / "automaton.schema.json", schema.encode())
    with progress_bar(as_json or len(loaded) * len(forms) == 1) as report:
        done = 0
        for path, instance in loaded.values():
            controller = load_instance_controller(instance, path)
            for form in forms:
                written = []
                files = exporter.files(instance, controller, form, zipped=not plain)
                for ending, content in files.items():
                    target = output / form / f"{instance.id}{ending}"
                    write_whole(target, content)
                    written.append(target)
                done += 1
                report("export", done, len(loaded) * len(forms))
                _tell(instance.id, form, written, as_json)


def _tell(name: str, form: str, written: Sequence[Path], as_json: bool) -> None:
    if as_json:
        print_json({"id": name, "format": form, "files": [str(path) for path in written]})
    else:
        click.echo(f"wrote {', '.join(str(path) for path in written)}")


def export_layout(
    instances: Sequence[Path], forms: Sequence[str], names: Sequence[str], root: Path, output: Path,
    as_json: bool,
) -> None:  # fmt: skip
    """Write the emitted VNN-LIB categories in the layout that VNN-COMP publishes.

    Raises BadInput if something is missing or in the way, or instances or formats are named.
    """
    # Slow to import.
    from generator.emit import load_controllers  # noqa: PLC0415
    from generator.vnncomp import export_vnncomp  # noqa: PLC0415

    if instances or forms:
        raise BadInput("export: --layout writes whole categories; name no instance and no format")
    with progress_bar(as_json) as report:
        done = export_vnncomp(
            root, output, load_controllers(root), names,
            lambda count, total: report("export", count, total),
        )  # fmt: skip
    for each in done:
        folder, hours = str(each.folder), each.seconds / 3600
        if as_json:
            print_json(
                {
                    "category": each.category,
                    "folder": folder,
                    "instances": each.instances,
                    "seconds": each.seconds,
                }
            )
        else:
            click.echo(f"wrote {folder}: {each.instances} instances, {hours:.1f} h of timeouts")


@click.command()
@click.option("--layout", type=click.Choice(["vnncomp"]), help="Whole categories, as published.")
@click.option("--category", "names", multiple=True, help="With --layout; may be repeated.")
@click.option("--root", type=FOLDER, default=CHECKOUT, help="With --layout  [default: checkout]")
@hybrid_options
def export(
    layout: str | None, names: tuple[str, ...], root: Path, instances: tuple[Path, ...],
    forms: tuple[str, ...], output: Path, plain: bool, as_json: bool,
) -> None:  # fmt: skip
    """Write INSTANCES as hybrid automata for Flow*, SpaceEx, Verisig, or as JSON.

    With --layout vnncomp: the VNN-LIB categories, networks and all, as VNN-COMP lays them out.
    docs/hybrid.md and docs/vnnlib.md say how to run tools on the files and what answers mean.
    """
    if layout:
        export_layout(instances, forms, names, root, output, as_json)
    elif names:
        raise BadInput("export: --category goes with --layout; or name instance files")
    else:
        export_hybrid(instances, forms, output, plain, as_json)
