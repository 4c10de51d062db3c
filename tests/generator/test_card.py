"""The data card says what is in the files, and knows when it no longer does."""

import csv
import hashlib
import json
import math
import os
from collections import defaultdict
from pathlib import Path

import numpy as np
import onnx
import pytest
from click.testing import CliRunner

from generator.card.claims import BOTH, WIDER, claims
from generator.card.facts import Asked, CategoryFacts, Dataset, Known, read_dataset
from generator.categories import CATEGORIES
from generator.cli import main
from generator.reference.rows import COLUMNS, Row, write_category
from generator.seeds import file_sha256
from racecar.controller import Controller, save_controller
from racecar.layers import Convolution, Layer

CHECKOUT = Path(__file__).parents[2]
HEAD = ",".join(COLUMNS) + "\n"
ID = "TD3_L5_8_C1.full_range"


def results(root, *rows):
    """Write reference results of full_range: rest of the ID, verdict, bracket, seconds."""
    write_category(
        root / "benchmarks" / "full_range",
        [
            Row(f"{ID}.{rest}", verdict, *bracket, "m", f"{ID}.{rest}", "e", time, "", "x")
            for rest, verdict, *bracket, time in rows
        ],
        defaultdict(str),
    )


def run(command, root, *arguments):
    return CliRunner().invoke(main, [command, "--root", str(root), *arguments])


def card(root, *arguments):
    result = run("card", root, *arguments, "--json")
    return result.exit_code, json.loads(result.stdout)


@pytest.fixture
def root(tmp_path, add_controller):
    """A root with one controller and two categories, one of them with reference results."""
    add_controller(tmp_path)
    names = ["--category", "full_range", "--category", "lap"]
    assert run("emit", tmp_path, *names).exit_code == 0
    results(
        tmp_path,
        ("clearance", "unsat", "0.0123", "0.02", "1.5"),
        ("hscc20", "sat", "", "-0.25", "40"),
    )
    assert run("controllers", tmp_path, "--write", "--runs", "40").exit_code == 0
    assert run("card", tmp_path).exit_code == 0
    return tmp_path


def table(root, heading):
    """The cells of a table of the card: the one whose head begins with ``heading``."""
    lines = (root / "benchmarks" / "README.md").read_text().splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith(f"| {heading} |"))
    rows = []
    for line in lines[at + 2 :]:
        if not line.startswith("|"):
            break
        rows.append([cell.strip().strip("`") for cell in line.strip("|").split("|")])
    return {row[0]: row[1:] for row in rows}


def test_the_card_counts_what_is_there(root):
    held = table(root, "category | instances")
    formats = "JSON, Flow*, SpaceEx, Verisig"
    assert held["full_range"][:4] == ["2", "1", "300", formats]
    assert held["lap"][:4] == ["6", "1", "300", "JSON"]
    folder = root / "benchmarks" / "lap"
    size = sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
    assert held["lap"][4] == f"{size / 1e6:.1f}"
    assert table(root, "controller | `full_range`")["TD3_L5_8_C1"] == ["2", "6"]


def test_the_card_says_how_the_controllers_came_out(root):
    with (root / "benchmarks" / "controllers.csv").open() as file:
        (row,) = csv.DictReader(file)
    # Weights and biases of 8 neurons on 5 rays, of the output, and of the scaling to radians.
    parameters = 8 * 5 + 8 + 8 + 1 + 2
    low, high = (f"{100 * float(row[f'paper_safe_{end}']):.2f}" for end in ("low", "high"))
    safe = f"{100 * int(row['paper_safe']) / 40:.2f} ({low} to {high})"
    margin, smooth = float(row["nominal_margin"]), float(row["smoothness"])
    # It drives into the wall, so its only seed has not finished the turn.
    assert table(root, "controller | rays")["TD3_L5_8_C1"] == [
        "5", "8 tanh", str(parameters), "(1)", "900", "1", f"{margin:.4f}", f"{1000 * smooth:.1f}",
        safe,
    ]  # fmt: skip
    assert "of 40 runs" in (root / "benchmarks" / "README.md").read_text()


def add_conv(root, add_controller):
    """Add a controller with two convolutions, of a record that says no return."""
    path = add_controller(root, "TD3_L5_conv_C1")
    random = np.random.default_rng(0)
    layers = [
        Convolution(
            random.normal(size=shape).astype(np.float32), np.zeros(shape[0], np.float32), 1, length
        ).layer("tanh")
        for shape, length in (((3, 1, 3), 5), ((2, 3, 2), 3))
    ]
    dense = Layer(np.zeros((1, 4), np.float32), np.zeros(1, np.float32), "tanh")
    save_controller(Controller((*layers, dense)), path)
    record = path.with_suffix(".json")
    data = json.loads(record.read_text()) | {"sha256": file_sha256(path)}
    record.write_text(json.dumps(data))
    path.with_suffix(".curve.csv").write_text("rounds,seconds\n5,60.0\n")
    return path


def test_convolutions_count_as_the_file_holds_them(root, add_controller):
    path = add_conv(root, add_controller)
    held = sum(
        math.prod(x.dims)
        for x in onnx.load(path).graph.initializer
        if x.data_type == onnx.TensorProto.FLOAT
    )
    assert held == 3 * 3 + 3 + 2 * 3 * 2 + 2 + 4 + 1
    assert run("controllers", root, "--write", "--runs", "40").exit_code == 0
    assert run("card", root).exit_code == 0
    cells = table(root, "controller | rays")["TD3_L5_conv_C1"]
    assert cells[:5] == ["5", "conv 3, conv 2 tanh", str(held), "(1)", ""]


def test_a_table_of_other_controllers_is_refused(root, add_controller):
    path = root / "benchmarks" / "controllers.csv"
    written = path.read_text()

    def refused(message):
        result = run("card", root, "--check")
        assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
        assert result.stderr.startswith(f"error: {path}")
        assert message in result.stderr
        assert "generator controllers --write" in result.stderr

    add_controller(root, "TD3_L5_8_C2", seed=1)
    refused("there is no row of TD3_L5_8_C2")
    for file in (root / "onnx").glob("*_C2*"):
        file.unlink()
    add_controller(root, seed=1)
    refused("the row of TD3_L5_8_C1 is of another network")
    add_controller(root)
    assert run("card", root, "--check").exit_code == 0
    path.write_text(written.replace("900.25", "950.25"))
    refused("line 2: not what records and learning curves say")
    path.write_text(written + "\n".join(written.splitlines()[1:]).replace("C1", "C7") + "\n")
    refused("line 3: not what records and learning curves say")
    path.write_text("name,sha256\na,b\n")
    refused("line 2: no row of the table")
    path.unlink()
    refused("there is no row of TD3_L5_8_C1")


def test_card_and_emit_agree_about_the_manifest_in_either_order(root):
    names = ["--category", "full_range", "--category", "lap"]
    manifest, path = (root / "benchmarks" / x for x in ("manifest.json", "controllers.csv"))
    assert run("controllers", root, "--write", "--runs", "30").exit_code == 0
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    listed = json.loads(manifest.read_bytes())["files"]["benchmarks/controllers.csv"]
    assert listed == {"sha256": digest, "size": path.stat().st_size}
    for order in (("emit", "card"), ("card", "emit")):
        manifest.unlink()
        for command in order:
            assert run(command, root, *(names if command == "emit" else [])).exit_code == 0
        assert run("emit", root, *names, "--check").exit_code == 0
        assert run("card", root, "--check").exit_code == 0


def test_the_card_says_what_is_known(root):
    assert table(root, "category | sat") == {
        "full_range": [
            "1", "1", "0", "0", "0.0123 to 0.0123", "-0.2500 to -0.2500", "21 / 40",
        ]
    }  # fmt: skip
    text = (root / "benchmarks" / "README.md").read_text()
    assert "no reference results for `lap`: every" in text
    said = table(root, "claim")
    assert said["Both verdicts occur in `full_range`."] == ["yes", "1 sat, 1 unsat"]
    assert said["Both verdicts occur in `closed_loop`."][0] == "not known"
    for figure in ("traces.png", "margins.svg", "categories.svg", "difficulty.svg"):
        assert f"(figures/{figure})" in text
        assert (root / "benchmarks" / "figures" / figure).stat().st_size > 1000


def test_a_current_card_stays_as_it_is(root):
    assert card(root, "--check") == (0, {"current": True, "differ": []})
    files = {path: path.read_bytes() for path in root.rglob("*") if path.is_file()}
    assert card(root) == (0, {"written": [], "removed": []})
    assert {path: path.read_bytes() for path in root.rglob("*") if path.is_file()} == files
    names = ["--category", "full_range", "--category", "lap"]
    assert run("emit", root, *names, "--check").exit_code == 0


def test_new_results_make_the_card_and_the_figures_stale(root):
    results(root, ("clearance", "unknown", "", "0.02", "60"))
    status, found = card(root, "--check")
    assert status == 1
    assert found["differ"] == [
        "benchmarks/README.md",
        "benchmarks/figures/shown.json",
        "benchmarks/figures/categories.svg",  # there are no margins left to draw
        "benchmarks/manifest.json",
    ]
    status, done = card(root)
    assert "benchmarks/figures/difficulty.svg" in done["written"]
    assert "benchmarks/figures/traces.png" not in done["written"]  # shows the same numbers
    assert done["removed"] == ["benchmarks/figures/categories.svg"]
    assert card(root, "--check")[0] == 0
    assert table(root, "category | sat")["full_range"][:4] == ["0", "0", "1", "1"]


@pytest.mark.parametrize("name", ["README.md", "figures/margins.svg", "figures/shown.json"])
def test_what_was_changed_or_lost_is_named_and_mended(root, name):
    path = root / "benchmarks" / name
    original = path.read_bytes()
    for damage in (lambda: path.write_bytes(b"x"), path.unlink):
        damage()
        status, found = card(root, "--check")
        assert status == 1
        assert "benchmarks/manifest.json" in found["differ"]
        assert card(root)[0] == 0
        assert path.read_bytes() == original
        assert card(root, "--check")[0] == 0


def test_figures_of_another_matplotlib_are_taken_for_what_they_show(root):
    path = root / "benchmarks" / "figures" / "margins.svg"
    path.write_bytes(path.read_bytes() + b"<!-- -->\n")
    names = ["--category", "full_range", "--category", "lap"]
    assert run("emit", root, *names).exit_code == 0  # now the manifest has it so
    assert card(root, "--check")[0] == 0
    assert card(root)[1]["written"] == []


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("instance,verdict\n", "line 1: the header must be instance,verdict,margin_lower"),
        (f"{HEAD}{ID}.clearance,maybe,,,,,,1,,\n", "line 2: verdict is 'maybe'"),
        (f"{HEAD}{ID}.clearance,sat,,x,,,,1,,\n", "line 2: margin_upper is 'x', not a number"),
        (f"{HEAD}{ID}.clearance,sat,,,,,,inf,,\n", "line 2: time_s is 'inf', not a number"),
        (f"{HEAD}a,sat,,,,,,1,,\na,sat,,,,,,1,,\n", "line 3: a second row of a"),
        (f"{HEAD}other,sat,,,,,,1,,\n", "other is no instance of full_range"),
    ],
)
def test_broken_results_give_one_line_and_change_nothing(root, text, message):
    before = (root / "benchmarks" / "README.md").read_bytes()
    path = root / "benchmarks" / "full_range" / "reference.csv"
    path.write_text(text)
    result = run("card", root)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert f"error: {path}" in result.stderr
    assert message in result.stderr
    assert (root / "benchmarks" / "README.md").read_bytes() == before


def test_without_instances_there_is_no_card(tmp_path, add_controller):
    add_controller(tmp_path)
    result = run("card", tmp_path)
    assert (result.exit_code, result.stderr.count("\n")) == (2, 1)
    assert "run `generator emit` first" in result.stderr


def dataset(**verdicts):
    """A dataset with so many results: category=(sat, unsat, unknown)."""
    categories = []
    for name, counts in verdicts.items():
        every = [
            verdict
            for verdict, count in zip(("sat", "unsat", "unknown"), counts, strict=True)
            for _ in range(count)
        ]
        asked = tuple(
            Asked(f"{name}{i}", "a", 1, math.nan, Known(verdict, None, None, None))
            for i, verdict in enumerate(every)
        )
        categories.append(CategoryFacts(name, asked, 10))
    return Dataset((), (), tuple(categories), 10)


def test_claims_hold_or_not_or_are_not_known():
    full = dict.fromkeys(BOTH, (1, 1, 0)) | dict.fromkeys(WIDER, (9, 9, 2))
    assert all(claim.holds for claim in claims(dataset(**full)))
    for name in BOTH:
        for counts in ((0, 3, 9), (3, 0, 9)):
            held = {claim.text: claim.holds for claim in claims(dataset(**full | {name: counts}))}
            assert held.pop(f"Both verdicts occur in `{name}`.") is False
            assert all(held.values())
    few = full | dict.fromkeys(WIDER, (9, 9, 1))  # 1 of 19 each
    assert [claim.holds for claim in claims(dataset(**few))] == [True] * 5 + [False, True]
    some = {name: counts for name, counts in full.items() if name != "lap"}
    assert [claim.holds for claim in claims(dataset(**some))] == [True] * 5 + [None, True]
    assert [claim.holds for claim in claims(dataset())] == [None] * 6 + [True]


def test_the_committed_dataset_is_what_it_is_meant_to_be():
    found = claims(read_dataset(CHECKOUT, list(CATEGORIES)))
    assert [claim.text for claim in found if claim.holds is False] == []
    assert found[-1].holds


def test_the_committed_manifest_lists_every_file():
    listed = json.loads((CHECKOUT / "benchmarks" / "manifest.json").read_bytes())["files"]
    there = {
        path.relative_to(CHECKOUT).as_posix()
        for folder in ("benchmarks", "onnx", "vnnlib")
        for path in (CHECKOUT / folder).rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert there == set(listed) | {"benchmarks/manifest.json"}
    for table in sorted((CHECKOUT / "benchmarks").glob("*/instances.csv")):
        folder = table.parent.relative_to(CHECKOUT)
        for row in csv.reader(table.read_text().splitlines()):
            for path in row[:2]:
                name = Path(os.path.normpath(folder / path)).as_posix()
                assert {name, f"{name}.gz"} & set(listed)
