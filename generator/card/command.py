"""The command ``generator card``."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import click

from generator.card.facts import read_dataset
from generator.card.text import card_text
from generator.categories import CATEGORIES
from generator.command_options import json_option, root_option
from generator.emit import MANIFEST, all_folders
from generator.piece import FOLDER
from generator.tree import (
    file_content,
    format_json,
    is_as_listed,
    refresh_manifest,
    update_file,
)
from racecar.command_line import CHECK_FAILED, DONE, print_json

if TYPE_CHECKING:
    from generator.card.figures import Picture

CARD, FIGURES = f"{FOLDER}/README.md", f"{FOLDER}/figures"
#: The sha256 of the numbers that each figure shows.
SHOWN = f"{FIGURES}/shown.json"


@click.command()
@click.option("--check", is_flag=True, help="Write nothing; status 1 if a file is not current.")
@root_option
@json_option
def card(check: bool, root: Path, as_json: bool) -> int:
    """Make the data card, ROOT/benchmarks/README.md, and its figures from the dataset.

    Figures are compared by the numbers that they show: their bytes depend on the version of
    matplotlib. The manifest is brought up to date, too.
    """
    # Slow to import.
    from generator.card.figures import pictures  # noqa: PLC0415
    from racecar.figure import save_figure  # noqa: PLC0415

    dataset = read_dataset(root, list(CATEGORIES))
    drawn = pictures(root, dataset)
    shown = format_json({picture.name: picture.digest for picture in drawn})
    text = card_text(root, dataset, [picture.name for picture in drawn]).encode()
    old = _stale_figures(root, drawn)
    if check:
        return _check(root, {CARD: text, SHOWN: shown}, drawn, old, as_json)
    written = []
    known = _shown(root)
    for picture in drawn:
        path = root / FIGURES / picture.name
        name = f"{FIGURES}/{picture.name}"
        if known.get(picture.name) != picture.digest or not is_as_listed(root, MANIFEST, name):
            save_figure(picture.draw(picture.data), path)
            written.append(name)
    for path in old:
        path.unlink()
    written += [
        path for path, new in ((CARD, text), (SHOWN, shown)) if update_file(root / path, new)
    ]
    manifest = refresh_manifest(root, MANIFEST, all_folders())
    written += [MANIFEST] if update_file(root / MANIFEST, manifest) else []
    removed = [path.relative_to(root).as_posix() for path in old]
    if as_json:
        print_json({"written": written, "removed": removed})
    else:
        click.echo(f"wrote {', '.join(written)}" if written else "the data card is current")
    return DONE


def _check(
    root: Path, files: dict[str, bytes], drawn: Sequence[Picture], old: list[Path], as_json: bool
) -> int:
    """Say what is not current; the manifest last, since it covers the rest."""
    wrong = [path for path, content in files.items() if file_content(root / path) != content]
    names = [f"{FIGURES}/{picture.name}" for picture in drawn]
    wrong += [name for name in names if not (root / name).is_file()]
    wrong += [path.relative_to(root).as_posix() for path in old]
    if file_content(root / MANIFEST) != refresh_manifest(root, MANIFEST, all_folders()):
        wrong.append(MANIFEST)
    if as_json:
        print_json({"current": not wrong, "differ": wrong})
    elif not wrong:
        click.echo("the data card is current")
    else:
        for path in wrong:
            click.echo(f"not current: {path}")
        click.echo("run `generator card` to bring them up to date", err=True)
    return CHECK_FAILED if wrong else DONE


def _shown(root: Path) -> dict[str, str]:
    try:
        return dict(json.loads(file_content(root / SHOWN) or b"{}"))
    except (ValueError, TypeError):
        return {}


def _stale_figures(root: Path, drawn: Sequence[Picture]) -> list[Path]:
    kept = {root / SHOWN, *(root / FIGURES / picture.name for picture in drawn)}
    return [path for path in sorted((root / FIGURES).glob("*")) if path not in kept]
