"""generator emit as a command: what it writes, leaves alone, finds changed, and mends."""

import hashlib
import json
import os
from pathlib import Path

import h5py
import pytest
from click.testing import CliRunner

from generator.categories import CATEGORIES
from generator.cli import main
from generator.emit import build, load_controllers
from generator.tree import check_tree
from racecar.instance import parse_instance


def run(root, *arguments):
    return CliRunner().invoke(main, ["emit", "--root", str(root), *arguments])


def files(root):
    """Everything that was emitted, by path; the controllers lie in onnx itself."""
    return {
        path.relative_to(root).as_posix(): path.read_bytes()
        for folder in ("benchmarks", "vnnlib", "onnx/unrolled")
        for path in (root / folder).rglob("*")
        if path.is_file()
    }


@pytest.fixture
def small(tmp_path, add_controller):
    """A root with one controller, of which only the category full_range is emitted."""
    add_controller(tmp_path)
    assert run(tmp_path, "--category", "full_range").exit_code == 0
    return tmp_path


def one_file_a_line(manifest):
    """The manifest's own layout."""
    text = json.dumps(manifest).replace('"files": {', '"files": {\n').replace("}, ", "},\n")
    return text.replace("}}}", "}\n}}\n").encode()


def check_small(root):
    result = run(root, "--check", "--category", "full_range", "--json")
    return result.exit_code, json.loads(result.stdout)


def test_two_roots_get_the_same_bytes(emitted, tmp_path, add_controller):
    add_controller(tmp_path)
    assert run(tmp_path).exit_code == 0
    assert files(tmp_path) == files(emitted)


def test_what_was_emitted_is_current_and_emitting_again_changes_nothing(emitted):
    result = run(emitted, "--check")
    assert (result.exit_code, result.stdout) == (0, "all emitted files are current\n")
    times = {path: (emitted / path).stat().st_mtime_ns for path in files(emitted)}
    rows = [json.loads(line) for line in run(emitted, "--json").stdout.splitlines()]
    assert [row["category"] for row in rows] == list(CATEGORIES)
    assert [(row["written"], row["removed"]) for row in rows] == [(0, 0)] * len(rows)
    assert {path: (emitted / path).stat().st_mtime_ns for path in files(emitted)} == times


def test_the_manifest_sums_every_file_and_the_controllers_with_their_records(emitted):
    manifest = json.loads((emitted / "benchmarks" / "manifest.json").read_bytes())
    expected = files(emitted)
    del expected["benchmarks/manifest.json"]
    for ending in ("onnx", "json", "curve.csv"):
        name = f"onnx/TD3_L5_8_C1.{ending}"
        expected[name] = (emitted / name).read_bytes()
    assert manifest["files"] == {
        name: {"sha256": hashlib.sha256(content).hexdigest(), "size": len(content)}
        for name, content in expected.items()
    }


@pytest.mark.parametrize(
    "name",
    [
        "full_range/json/TD3_L5_8_C1.full_range.hscc20.json",
        "full_range/instances.csv",
        "full_range/partitions.h5",
        "full_range/traces.h5",
        "instance.schema.json",
        "manifest.json",
    ],
)
def test_check_names_a_file_with_one_changed_byte_and_emit_repairs_it(small, name):
    path = small / "benchmarks" / name
    original = path.read_bytes()
    middle = len(original) // 2
    path.write_bytes(original[:middle] + bytes([original[middle] ^ 1]) + original[middle + 1 :])
    damaged = path.read_bytes()
    status, found = check_small(small)
    assert status == 1
    assert not found["current"]
    # In an HDF5 file the byte may lie where nothing is kept; then only the manifest knows.
    assert {f"benchmarks/{name}", "benchmarks/manifest.json"} & set(found["differ"])
    assert path.read_bytes() == damaged
    assert run(small, "--category", "full_range").exit_code == 0
    assert path.read_bytes() == original


def test_check_names_missing_and_extra_files_and_emit_mends_both(small):
    folder = small / "benchmarks" / "full_range"
    before = files(small)
    (folder / "traces.h5").unlink()
    (folder / "json" / "old.json").write_text("{}")
    (folder / "more" / "deep").mkdir(parents=True)
    (folder / "more" / "deep" / "x").write_text("")
    result = run(small, "--check", "--category", "full_range")
    assert result.exit_code == 1
    assert result.stdout.splitlines() == [
        "missing: benchmarks/full_range/traces.h5",
        "stale: benchmarks/full_range/json/old.json",
        "stale: benchmarks/full_range/more/deep/x",
    ]
    assert run(small, "--category", "full_range").exit_code == 0
    assert files(small) == before
    assert not (folder / "more").exists()


def test_traces_may_differ_in_their_last_bits_but_no_more(small):
    path = small / "benchmarks" / "full_range" / "traces.h5"
    original = path.read_bytes()
    for change, status in ((1e-12, 0), (1e-6, 1)):
        path.write_bytes(original)
        with h5py.File(path, "r+") as file:
            file["TD3_L5_8_C1/s"][3, 3] += change
        manifest = small / "benchmarks" / "manifest.json"
        content = json.loads(manifest.read_bytes())
        entry = content["files"]["benchmarks/full_range/traces.h5"]
        entry["sha256"] = hashlib.sha256(path.read_bytes()).hexdigest()
        entry["size"] = path.stat().st_size
        manifest.write_bytes(one_file_a_line(content))
        assert check_small(small)[0] == status
        # What another machine made alike stays, whatever is emitted anew.
        changed = path.read_bytes()
        assert run(small, "--category", "full_range").exit_code == 0
        assert (path.read_bytes() == changed) == (status == 0)
        assert check_small(small)[0] == 0


def test_results_of_the_reference_verifier_are_left_alone(small):
    folder = small / "benchmarks" / "full_range"
    (folder / "reference.csv").write_text("kept")
    (folder / "reference").mkdir()
    (folder / "reference" / "proof.json").write_text("kept")
    (small / "benchmarks" / "README.md").write_text("kept")
    assert check_small(small) == (
        1,
        {"current": False, "differ": ["benchmarks/manifest.json"], "missing": [], "stale": []},
    )
    assert run(small, "--category", "full_range").exit_code == 0
    assert (folder / "reference.csv").read_text() == "kept"
    assert (folder / "reference" / "proof.json").exists()
    assert check_small(small)[0] == 0
    manifest = json.loads((small / "benchmarks" / "manifest.json").read_bytes())["files"]
    assert manifest["benchmarks/README.md"] == {
        "sha256": hashlib.sha256(b"kept").hexdigest(),
        "size": 4,
    }
    for name in ("reference.csv", "reference/proof.json"):
        assert f"benchmarks/full_range/{name}" in manifest


def test_one_category_can_be_emitted_without_touching_another(emitted, tmp_path, add_controller):
    add_controller(tmp_path)
    for category in reversed(CATEGORIES):
        assert run(tmp_path, "--category", category).exit_code == 0
    assert files(tmp_path) == files(emitted)  # the manifest too
    note = tmp_path / "benchmarks" / "closed_loop" / "note"
    note.write_text("")
    assert check_small(tmp_path)[0] == 0
    assert run(tmp_path, "--category", "full_range").exit_code == 0
    assert note.exists()


def test_a_controller_that_goes_takes_its_files_along(small, add_controller):
    add_controller(small, "DDPG_L5_8_C1", seed=1)
    assert run(small, "--category", "full_range").exit_code == 0
    added = small / "benchmarks" / "full_range" / "json" / "DDPG_L5_8_C1.full_range.hscc20.json"
    assert added.exists()
    (small / "onnx" / "DDPG_L5_8_C1.onnx").unlink()
    (small / "onnx" / "DDPG_L5_8_C1.json").unlink()
    assert check_small(small)[0] == 1
    assert run(small, "--category", "full_range").exit_code == 0
    assert not added.exists()
    assert check_small(small)[0] == 0


def test_bad_roots_and_records_give_one_line_and_write_nothing(tmp_path, add_controller):
    result = run(tmp_path / "nowhere")
    assert result.exit_code == 2
    assert "no controller with a training record" in result.stderr
    path = add_controller(tmp_path)
    record = path.with_suffix(".json").read_text()
    for text in (record[:50], "{}", record.replace('"sha256": "', '"sha256": "0')):
        path.with_suffix(".json").write_text(text)
        result = run(tmp_path)
        assert result.exit_code == 2
        assert result.stderr.startswith(f"error: {path.with_suffix('.json')}: ")
        assert result.stderr.count("\n") == 1
    path.with_suffix(".json").write_text(record)
    path.unlink()
    assert run(tmp_path).exit_code == 2
    assert not (tmp_path / "benchmarks").exists()


def test_an_unknown_category_is_refused(tmp_path):
    result = run(tmp_path, "--category", "fun")
    assert result.exit_code == 2
    assert "fun" in result.stderr


def test_a_file_that_cannot_be_written_gives_one_line(small):
    if os.geteuid() == 0:
        target = small / "benchmarks" / "full_range" / "json"
        for path in target.iterdir():
            path.unlink()
        target.rmdir()
        target.write_text("a file where a folder should be")
    else:
        (small / "benchmarks" / "full_range").chmod(0o500)
    result = run(small, "--category", "full_range")
    assert result.exit_code == 2
    assert result.stderr.count("\n") == 1


def test_instances_do_not_depend_on_where_the_root_lies(
    emitted, tmp_path, monkeypatch, add_controller
):
    add_controller(tmp_path)
    monkeypatch.chdir(tmp_path)
    category = [CATEGORIES["full_range"]]
    relative = build(Path(), category, load_controllers(Path()))
    assert not check_tree(emitted, relative).differ
    for path, content in relative.tree.items():
        if "/json/" in path:
            assert parse_instance(content, path).controller.file.startswith("../../../onnx/")


def test_several_processes_make_the_same_files_as_one(tmp_path, add_controller):
    for number in (1, 2):
        add_controller(tmp_path, f"TD3_L5_8_C{number}", seed=number)
    categories = [CATEGORIES[name] for name in ("full_range", "noise", "open_loop")]
    controllers = load_controllers(tmp_path)
    alone, together = (build(tmp_path, categories, controllers, jobs=jobs) for jobs in (1, 2))
    assert alone == together
    assert len(alone.tree) > 100
