"""Building the site: runs in, files out."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from leaderboard.board import Board, Result
from leaderboard.collect import collect, make_slugs
from leaderboard.downloads import downloads
from leaderboard.output import Output
from leaderboard.pages import Pages, assets
from leaderboard.pictures import draw, orders
from leaderboard.runs import JudgedRun
from leaderboard.scene import key_line
from leaderboard.tables import tables
from leaderboard.tube import certificate_files


@dataclass(frozen=True)
class Built:
    """What a build did: the board, how many files were touched, and what a reader should know."""

    board: Board
    written: int
    kept: int
    removed: int
    notes: Sequence[str]


@dataclass(frozen=True)
class Options:
    """root: the benchmarks folder; certificates: a folder; longest_log: bytes shown of each log."""

    root: Path | None
    certificates: Path | None = None
    longest_log: int = 4096


def build(runs: Sequence[JudgedRun], folder: Path, options: Options) -> Built:
    """Build the site of some runs in a folder; BadInput for what cannot be used."""
    with _all_kept():
        return _build(runs, folder, options)


@contextmanager
def _all_kept() -> Iterator[None]:
    """Stop looking for garbage: nearly all that is read is kept to the end.

    With hundreds of thousands of records the looking takes a good part of the time.
    """
    was_on = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def _build(runs: Sequence[JudgedRun], folder: Path, options: Options) -> Built:
    files = certificate_files(options.certificates)
    board = collect(runs, options.root, options.longest_log)
    slugs = make_slugs(question.id for question in board.instances)
    output = Output(folder)
    notes = list(board.notes)
    pictured = _pictures(board, runs, files, slugs, output, notes.append)
    for name, content in assets():
        output.write(name, content)
    pages = Pages(board, slugs, pictured)
    for produce in (tables(board, slugs), downloads(board), pages.all()):
        for name, content in produce:
            output.write(name, content)
    output.finish()
    return Built(board, output.written, output.kept, output.removed, notes)


def _pictures(
    board: Board,
    runs: Sequence[JudgedRun],
    certificates: Mapping[str, Path],
    slugs: Mapping[str, str],
    output: Output,
    note: Callable[[str], None],
) -> set[str]:
    """Make the pictures that are not there yet; return the instances that have one."""
    folders = {run.sha256: run for run in runs}  # equal runs have equal witnesses

    def witness(result: Result) -> bytes:
        return folders[result.run.sha256].witness(result.record)

    pictured, todo = set(), []
    for order in orders(board, witness, certificates):
        name = picture_name(slugs[order.question.id])
        if output.keep_if_made_from(name, key_line(order.key)):
            pictured.add(order.question.id)
        else:
            todo.append(order)
    for order, content in draw(todo, note):
        output.write(picture_name(slugs[order.question.id]), content)
        pictured.add(order.question.id)
    return pictured


def picture_name(slug: str) -> str:
    """Return where the picture's data of an instance stands in the site."""
    return f"instances/{slug}.js"
