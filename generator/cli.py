"""The command ``generator``."""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

import click
from rich.console import Console
from rich.table import Table

from generator.card.command import card
from generator.categories import CATEGORIES
from generator.command_options import FILE, FOLDER, json_option, root_option
from generator.controllers_command import controllers
from generator.emit import build, category_folders, load_controllers
from generator.export_command import export
from generator.hyperparams import Hyperparameters
from generator.hyperparams.robust import STUDENTS
from generator.instance_command import instance
from generator.instances import benchmark_plant
from generator.progress import progress_bar
from generator.record import SeedRecord
from generator.reference.command import reference
from generator.scenarios import make_scenarios
from generator.seeds import Train, Trained, find_controller, publish, published_seeds
from generator.setups import parse_setup, setup_hyperparameters
from generator.tree import Differences, check_tree, write_tree
from generator.yaml_network import import_yaml
from racecar.command_line import CHECK_FAILED, DONE, Commands, print_json
from racecar.controller import save_controller, write_whole
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view
from racecar.faultmodels.find import find_faults
from racecar.faultmodels.spec import FaultSpec


@click.group(cls=Commands, context_settings={"help_option_names": ["-h", "--help"]})
def main() -> None:
    """Train controllers, import them, and emit the instance sets."""


@main.command()
@click.argument("name")
@click.option("--out", type=FOLDER, default="onnx", show_default=True, help="For the controller.")
@click.option(
    "--work",
    type=FOLDER,
    default="training",
    show_default=True,
    help="For each seed's checkpoint and result; run again to go on where it stopped.",
)
@click.option(
    "--hyperparameters",
    "own",
    type=FILE,
    help="A file of one's own, laid out like generator/hyperparams/*.yml.",
)
@click.option("--timesteps", type=click.IntRange(1), help="Steps to train, instead of the file's.")
@click.option("--max-seeds", type=click.IntRange(1), default=20, show_default=True)
@json_option
def train(
    name: str,
    out: Path,
    work: Path,
    own: Path | None,
    timesteps: int | None,
    max_seeds: int,
    as_json: bool,
) -> int:
    """Train the controller NAME, such as TD3_L21_64x64_C1 or ROBUST_L21_64x64_C1.

    Seeds 1, 2, 3, ... are trained until as many as NAME's index have given a controller that
    finishes the turn in nominal simulation. It is kept whether it is safe or not; its record
    says which. What published controllers in --out tried is not trained again.
    """
    setup = parse_setup(name)
    parameters = setup_hyperparameters(setup, own)
    if timesteps is not None:
        if not isinstance(parameters, Hyperparameters):
            raise click.UsageError(
                f"--timesteps means nothing for {setup.algorithm}; "
                "set rounds with --hyperparameters"
            )
        parameters = parameters.model_copy(update={"n_timesteps": timesteps})

    def tell(record: SeedRecord) -> None:
        drive = record.nominal
        turn = "finishes the turn" if drive.finishes_turn else "does not finish the turn"
        if not as_json:
            click.echo(
                f"seed {record.seed}: {turn}; {drive.safe_fraction:.1%} of the nominal starts "
                f"safe, least margin {drive.margin:.4f} m"
            )

    with progress_bar(as_json) as report:
        train_seed = _trainer(
            setup.algorithm, lambda seed, *done: report(f"{setup.family} seed {seed}", *done)
        )
        known = published_seeds(setup, parameters, out)
        found = find_controller(setup, parameters, work, max_seeds, train_seed, tell, known)
    if found is None:
        click.echo(
            f"{name}: {max_seeds} seeds did not give {setup.index} controllers that finish the "
            "turn; allow more with --max-seeds",
            err=True,
        )
        return CHECK_FAILED
    record, folder = found
    files = publish(record, folder, out)
    if as_json:
        print_json(record.model_dump(mode="json", exclude_none=True))
    else:
        click.echo(f"{name} is seed {record.seed}, {record.label}; wrote {_listed(files)}")
    return DONE


def _trainer(algorithm: str, report: Callable[[int, int, int], None]) -> Train:
    """Return the function that trains a seed; torch is imported here and not before.

    report(seed, done, total) is called as steps are done.
    """
    train_seed: Callable[..., Trained]
    try:
        if algorithm in STUDENTS:
            from generator.robust.train import train as train_seed  # noqa: PLC0415
        else:
            from generator.train import train as train_seed  # noqa: PLC0415
    except ModuleNotFoundError as error:
        if (error.name or "").split(".")[0] not in ("torch", "stable_baselines3"):
            raise
        raise BadInput(
            f"training needs the package {error.name}; install the extra, in the checkout: "
            "pip install -e '.[train]'"
        ) from None

    return lambda setup, seed, parameters, folder: train_seed(
        setup, seed, parameters, folder, partial(report, seed)
    )


@main.command("import-yaml")
@click.argument("file", type=FILE)
@click.option("-o", "--output", type=FILE, required=True, help="ONNX file to write.")
@click.option("--name", help="Kept in the file's metadata  [default: the output file's name]")
@json_option
def import_yaml_command(file: Path, output: Path, name: str | None, as_json: bool) -> None:
    """Import a network FILE in the YAML layout that Verisig reads.

    The network reads (distance - 2.5) / 5 and returns steering / 15 degrees; the ONNX file
    takes metres and returns radians.
    """
    controller = import_yaml(file, name or output.stem)
    save_controller(controller, output)
    neurons = [len(layer.biases) for layer in controller.layers[:-1]]
    if as_json:
        print_json({"file": str(output), "rays": controller.rays, "neurons": neurons})
    else:
        shape = "-".join(str(n) for n in [controller.rays, *neurons])
        click.echo(f"wrote {output}: {shape} network")


@main.command()
@click.argument("faults")
@click.option("-o", "--output", type=FILE, required=True, help="HDF5 file to write.")
@click.option("--runs", type=click.IntRange(1), default=100, show_default=True)
@click.option("--rays", type=click.IntRange(2), default=21, show_default=True)
@click.option("--steps", type=click.IntRange(1), default=70, show_default=True)
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True)
@json_option
def scenarios(
    faults: str, output: Path, runs: int, rays: int, steps: int, seed: int, as_json: bool
) -> None:
    """Write runs with faults drawn from the model FAULTS (a name or a .json file) as HDF5.

    They are the first runs of `racecar simulate --faults FAULTS` with the same seed.
    """
    spec = find_faults(faults)
    if not isinstance(spec, FaultSpec):
        raise BadInput(f"faults {faults!r}: name a model that `racecar faults` lists, or a file")
    plant = benchmark_plant(rays, default_field_of_view(rays))
    content = make_scenarios(spec, plant, runs, steps, seed)
    write_whole(output, content)
    if as_json:
        print_json({"file": str(output), "faults": spec.name, "runs": runs, "seed": seed})
    else:
        click.echo(f"wrote {output}: {runs} runs with faults {spec.name}")


main.add_command(instance)
main.add_command(export)
main.add_command(card)
main.add_command(controllers)
main.add_command(reference)


@main.command()
@click.option("--check", is_flag=True, help="Write nothing; status 1 if a file is not current.")
@click.option(
    "--category",
    "names",
    multiple=True,
    type=click.Choice(list(CATEGORIES)),
    help="May be repeated  [default: all]",
)
@root_option
@click.option(
    "--jobs", type=click.IntRange(1), help="Processes at a time  [default: one for each core]"
)
@json_option
def emit(check: bool, names: tuple[str, ...], root: Path, jobs: int | None, as_json: bool) -> int:
    """Emit the instance sets of the controllers in ROOT/onnx to ROOT/benchmarks."""
    categories = [c for c in CATEGORIES.values() if not names or c.name in names]
    loaded = load_controllers(root)
    with progress_bar(as_json) as report:
        emitted = build(
            root, categories, loaded, partial(report, "controllers by category"), jobs or _cores()
        )
    if check:
        return _show_differences(check_tree(root, emitted), as_json)
    written, removed = write_tree(root, emitted)
    table = Table("category", "instances", "files", "written", "removed")
    for category in categories:
        prefix = tuple(f"{folder}/" for folder in category_folders(category))
        row = {
            "instances": emitted.tree.get(f"{prefix[0]}instances.csv", b"").count(b"\n"),
            "files": sum(x.startswith(prefix) for x in emitted.tree),
            "written": sum(x.startswith(prefix) for x in written),
            "removed": sum(x.startswith(prefix) for x in removed),
        }
        if as_json:
            print_json({"category": category.name} | row)
        else:
            table.add_row(category.name, *map(str, row.values()))
    if not as_json:
        Console().print(table)
    return DONE


def _cores() -> int:
    """Return how many cores this process may use."""
    usable = getattr(os, "sched_getaffinity", None)
    return len(usable(0)) if usable else os.cpu_count() or 1


def _show_differences(found: Differences, as_json: bool) -> int:
    kinds = {"differ": found.differ, "missing": found.missing, "stale": found.stale}
    if as_json:
        print_json({"current": not found, **kinds})
    elif not found:
        click.echo("all emitted files are current")
    else:
        for kind, paths in kinds.items():
            for path in paths:
                click.echo(f"{kind}: {path}")
        click.echo("run `generator emit` to bring them up to date", err=True)
    return CHECK_FAILED if found else DONE


def _listed(files: list[Path]) -> str:
    return ", ".join(str(file) for file in files)
