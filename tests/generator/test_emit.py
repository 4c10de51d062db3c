import csv
import hashlib
import io
import json
import os
import tarfile
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import h5py
import jsonschema
import numpy as np
import pytest
from click.testing import CliRunner

from generator.categories import CATEGORIES
from generator.cli import main
from generator.emit import build, load_controllers
from generator.instances import ControllerFile
from generator.piece import make_piece
from generator.tree import check_tree
from racecar.closed_loop import State, simulate
from racecar.controller import Controller
from racecar.instance import load_instance, load_instance_controller, parse_instance


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


@pytest.fixture(scope="module")
def root(tmp_path_factory, add_controller):
    """A root with one controller, emitted."""
    root = tmp_path_factory.mktemp("root")
    add_controller(root)
    assert run(root).exit_code == 0
    return root


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


def test_two_roots_get_the_same_bytes(root, tmp_path, add_controller):
    add_controller(tmp_path)
    assert run(tmp_path).exit_code == 0
    assert files(tmp_path) == files(root)


def test_what_was_emitted_is_current_and_emitting_again_changes_nothing(root):
    result = run(root, "--check")
    assert (result.exit_code, result.stdout) == (0, "all emitted files are current\n")
    times = {path: (root / path).stat().st_mtime_ns for path in files(root)}
    rows = [json.loads(line) for line in run(root, "--json").stdout.splitlines()]
    assert [row["category"] for row in rows] == list(CATEGORIES)
    assert [(row["written"], row["removed"]) for row in rows] == [(0, 0)] * len(rows)
    assert {path: (root / path).stat().st_mtime_ns for path in files(root)} == times


def test_every_instance_obeys_the_published_schema_and_is_named_once(root):
    schema = json.loads((root / "benchmarks" / "instance.schema.json").read_bytes())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    ids = []
    for name, content in files(root).items():
        if "/json/" in name:
            instance = json.loads(content)
            validator.validate(instance)
            assert name == f"benchmarks/{instance['category']}/json/{instance['id']}.json"
            ids.append(instance["id"])
    assert len(ids) == len(set(ids)) == 40 + 100 + 200 + 2 + 10 + 16 + 46 + 6


def test_the_schema_refuses_what_is_not_an_instance(root):
    schema = json.loads((root / "benchmarks" / "instance.schema.json").read_bytes())
    path = next((root / "benchmarks" / "full_range" / "json").iterdir())
    instance = json.loads(path.read_bytes())
    del instance["initial_set"]["theta"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(instance, schema)


def test_instances_csv_names_existing_files_in_vnncomp_columns(root):
    counts = {}
    for category in ("closed_loop", "full_range"):
        folder = root / "benchmarks" / category
        rows = list(csv.reader((folder / "instances.csv").read_text().splitlines()))
        counts[category] = len(rows)
        for onnx, spec, timeout in rows:
            assert (folder / onnx).samefile(root / "onnx" / "TD3_L5_8_C1.onnx")
            assert int(timeout) > 0
            instance = load_instance(folder / spec)
            assert instance.controller.file == "../" + onnx  # the spec lies one folder deeper
            assert load_instance_controller(instance, folder / spec).rays == 5
    assert counts == {"closed_loop": 340, "full_range": 2}


def test_subsets_tile_the_range_in_the_files_themselves(root):
    folder = root / "benchmarks" / "closed_loop" / "json"
    for width, count in (("5", 40), ("2", 100), ("1", 200)):
        paths = sorted(folder.glob(f"*.closed_loop.w{width}mm.*.clearance.json"))
        assert len(paths) == count
        sets = [
            json.loads(path.read_text(), parse_float=Decimal)["initial_set"]["s"] for path in paths
        ]
        assert (sets[0][0], sets[-1][1]) == (Decimal("0.65"), Decimal("0.85"))
        for (_, right), (left, _) in pairwise(sets):
            assert right == left
            assert float(right) == float(left)
        assert {b - a for a, b in sets} == {Decimal(width) / 1000}


def test_partitions_agree_with_the_instances(root):
    for category in ("closed_loop", "full_range"):
        folder = root / "benchmarks" / category
        seen = 0
        with h5py.File(folder / "partitions.h5") as file:
            for partition in file.values():
                literals = partition["literals"].asstr()[()]
                np.testing.assert_array_equal(partition["bounds"][()], literals.astype(float))
                ids = partition["ids/TD3_L5_8_C1"].asstr()[()]
                properties = partition["properties"].asstr()[()]
                for bounds, names in zip(partition["bounds"][()], ids, strict=True):
                    for name, safety in zip(names, properties, strict=True):
                        instance = load_instance(folder / "json" / f"{name}.json")
                        assert instance.initial_set.s == tuple(bounds)
                        assert instance.property.name == safety
                        seen += 1
        assert seen == len(list((folder / "json").iterdir()))


def test_every_hdf5_object_has_units_and_a_description(root):
    def has_both(name, item):
        assert item.attrs["description"], name
        assert item.attrs["units"], name

    paths = list((root / "benchmarks").rglob("*.h5"))
    assert len(paths) == 3
    for path in paths:
        with h5py.File(path) as file:
            has_both("/", file)
            file.visititems(has_both)


def test_traces_are_a_run_of_the_closed_loop(root):
    folder = root / "benchmarks" / "full_range"
    path = folder / "json" / "TD3_L5_8_C1.full_range.clearance.json"
    instance = load_instance(path)
    controller = load_instance_controller(instance, path)
    plant = instance.make_plant()
    with h5py.File(folder / "traces.h5") as file:
        group = file["TD3_L5_8_C1"]
        data = {name: x[()] for name, x in group.items() if isinstance(x, h5py.Dataset)}
        margins = {name: x[()] for name, x in group["clearance"].items()}
        hscc20 = group["hscc20/run"][()]
    np.testing.assert_allclose(data["s"][:, 0], np.linspace(0.65, 0.85, 21))
    np.testing.assert_allclose(data["time"], np.arange(71) / 10)
    start = State.start(data["s"][:, 0])
    runs = simulate(plant, controller.steering_rows, instance.make_property(), start, 70)
    assert (runs.crash_step > 0).all()  # this controller drives into the front wall
    np.testing.assert_allclose(margins["run"], runs.margin, atol=1e-12)
    np.testing.assert_allclose(np.nanmin(margins["instant"], 1), runs.margin_sampled, atol=1e-12)
    assert (hscc20 >= margins["run"]).all()
    for step in range(70):  # step by step, one car at a time: no batch, no simulate()
        for car in (0, 7, 20):
            if step >= runs.crash_step[car]:
                assert np.isnan(data["scan"][car, step]).all()
                assert np.isnan(data["steering"][car, step])
                assert np.isnan(margins["period"][car, step])
                continue
            state = State(
                data["frame"][[car], step],
                *(data[name][[car], step] for name in ("s", "f", "v", "theta")),
            )
            scan = plant.scan_rows(state)
            np.testing.assert_allclose(scan[:, 0], data["scan"][car, step], atol=1e-9)
            steering = controller.steering_rows(scan)
            np.testing.assert_allclose(steering[0], data["steering"][car, step], atol=1e-9)
            after = plant.advance(plant.drive(state, steering)[0])
            for name in ("frame", "s", "f", "v", "theta"):
                np.testing.assert_allclose(
                    getattr(after, name)[0], data[name][car, step + 1], atol=1e-9
                )


def test_the_manifest_sums_every_file_and_the_controllers_with_their_records(root):
    manifest = json.loads((root / "benchmarks" / "manifest.json").read_bytes())
    expected = files(root)
    del expected["benchmarks/manifest.json"]
    for ending in ("onnx", "json"):
        name = f"onnx/TD3_L5_8_C1.{ending}"
        expected[name] = (root / name).read_bytes()
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


def test_one_category_can_be_emitted_without_touching_another(root, tmp_path, add_controller):
    add_controller(tmp_path)
    for category in reversed(CATEGORIES):
        assert run(tmp_path, "--category", category).exit_code == 0
    assert files(tmp_path) == files(root)  # the manifest too
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
    root, tmp_path, monkeypatch, add_controller
):
    add_controller(tmp_path)
    monkeypatch.chdir(tmp_path)
    category = [CATEGORIES["full_range"]]
    relative = build(Path(), category, load_controllers(Path()))
    assert not check_tree(root, relative).differ
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


@pytest.fixture(scope="module")
def full_scan(tmp_path_factory, add_controller):
    """What a controller of 1081 rays adds to the category full_scan."""
    root = tmp_path_factory.mktemp("root")
    file = ControllerFile.load(add_controller(root, "TD3_L1081_8_C1", rays=1081))
    return make_piece(root, "full_scan", file)


def test_full_scans_are_asked_in_a_category_of_their_own(full_scan):
    asked = {name for name, category in CATEGORIES.items() if category.asks(1081)}
    assert asked == {"full_scan", "open_loop"}
    assert {name for name, category in CATEGORIES.items() if not category.asks(271)} == {
        "full_scan"
    }
    ids = [Path(spec).stem for _, spec, _ in full_scan.rows]
    assert ids == [
        *(f"TD3_L1081_8_C1.full_scan.w5mm.{i:03}.clearance" for i in range(40)),
        "TD3_L1081_8_C1.full_scan.clearance",
        "TD3_L1081_8_C1.full_scan.hscc20",
    ]
    name = "benchmarks/full_scan/json/TD3_L1081_8_C1.full_scan.clearance.json"
    instance = json.loads(full_scan.files[name])
    assert instance["plant"]["lidar"]["field_of_view"] == np.radians(270)
    assert instance["initial_set"]["s"] == [0.65, 0.85]
    assert "scan" not in full_scan.traces.members


@pytest.mark.parametrize(
    ("name", "rays", "count"),
    [("TD3_L61_8_C1", 61, 340), ("TD3_L121_8_C1", 121, 40), ("TD3_L1081_8_C1", 1081, 0)],
)
def test_controllers_larger_than_the_papers_have_no_finer_subsets(
    tmp_path, add_controller, name, rays, count
):
    file = ControllerFile.load(add_controller(tmp_path, name, rays=rays))
    assert len(make_piece(tmp_path, "closed_loop", file).rows) == count


def test_further_seeds_have_every_instance_but_no_automata_and_scans(tmp_path, add_controller):
    rows, members, files = {}, {}, {}
    for name in ("TD3_L5_8_C1", "TD3_L5_8_C2"):
        file = ControllerFile.load(add_controller(tmp_path, name))
        piece = make_piece(tmp_path, "full_range", file)
        rows[name], members[name] = len(piece.rows), set(piece.traces.members)
        files[name] = {path.split("/")[2] for path in piece.files}
    first, second = "TD3_L5_8_C1", "TD3_L5_8_C2"
    assert rows[first] == rows[second] == 2
    assert members[first] - members[second] == {"scan"}
    assert files[second] == {"json"} < files[first]


def test_only_controllers_like_the_papers_have_finer_subsets(tmp_path, add_controller):
    file = ControllerFile.load(add_controller(tmp_path))
    first, *last = file.controller.layers
    assert file.like_the_papers
    deep = replace(first, weights=np.eye(8, dtype=np.float32), biases=np.zeros(8, np.float32))
    for layers, finer in (
        ((first, deep, *last), True),
        ((first, deep, deep, *last), False),
        ((replace(first, activation="relu"), *last), False),
    ):
        other = replace(file, controller=Controller(layers))
        assert other.like_the_papers == finer
        assert len(list(CATEGORIES["closed_loop"].questions(other))) == (340 if finer else 40)


def test_full_scans_are_printed_as_automata_once_with_an_archive(full_scan):
    files = full_scan.files
    for form in ("automaton", "flowstar", "spaceex", "verisig"):
        base = f"benchmarks/full_scan/{form}/TD3_L1081_8_C1"
        named = {path.removeprefix(base) for path in files if path.startswith(base)}
        assert ".tar.gz" in named
        assert all(name.startswith(".k70.") for name in named - {".tar.gz"})
        with tarfile.open(fileobj=io.BytesIO(files[f"{base}.tar.gz"])) as archive:
            assert len({name.partition(".clearance")[0] for name in archive.getnames()}) >= 41
