"""What generator emit writes: files that agree with each other, and who is asked what."""

import csv
import io
import json
import tarfile
from dataclasses import replace
from decimal import Decimal
from itertools import pairwise
from pathlib import Path

import h5py
import jsonschema
import numpy as np
import pytest

from generator.categories import CATEGORIES
from generator.instances import ControllerFile
from generator.piece import make_piece
from racecar.closed_loop import State, simulate
from racecar.controller import Controller
from racecar.instance import load_instance, load_instance_controller


def test_every_instance_obeys_the_published_schema_and_is_named_once(emitted):
    schema = json.loads((emitted / "benchmarks" / "instance.schema.json").read_bytes())
    jsonschema.Draft202012Validator.check_schema(schema)
    validator = jsonschema.Draft202012Validator(schema)
    ids = []
    for path in sorted((emitted / "benchmarks").glob("*/json/*")):
        instance = json.loads(path.read_bytes())
        validator.validate(instance)
        assert path.parent.parent.name == instance["category"]
        assert path.name == f"{instance['id']}.json"
        ids.append(instance["id"])
    assert len(ids) == len(set(ids)) == 40 + 100 + 200 + 2 + 10 + 16 + 46 + 6


def test_the_schema_refuses_what_is_not_an_instance(emitted):
    schema = json.loads((emitted / "benchmarks" / "instance.schema.json").read_bytes())
    path = next((emitted / "benchmarks" / "full_range" / "json").iterdir())
    instance = json.loads(path.read_bytes())
    del instance["initial_set"]["theta"]
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.validate(instance, schema)


def test_instances_csv_names_existing_files_in_vnncomp_columns(emitted):
    counts = {}
    for category in ("closed_loop", "full_range"):
        folder = emitted / "benchmarks" / category
        rows = list(csv.reader((folder / "instances.csv").read_text().splitlines()))
        counts[category] = len(rows)
        for onnx, spec, timeout in rows:
            assert (folder / onnx).samefile(emitted / "onnx" / "TD3_L5_8_C1.onnx")
            assert int(timeout) > 0
            instance = load_instance(folder / spec)
            assert instance.controller.file == "../" + onnx  # the spec lies one folder deeper
            assert load_instance_controller(instance, folder / spec).rays == 5
    assert counts == {"closed_loop": 340, "full_range": 2}


def test_subsets_tile_the_range_in_the_files_themselves(emitted):
    folder = emitted / "benchmarks" / "closed_loop" / "json"
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


def test_partitions_agree_with_the_instances(emitted):
    for category in ("closed_loop", "full_range"):
        folder = emitted / "benchmarks" / category
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


def test_every_hdf5_object_has_units_and_a_description(emitted):
    def has_both(name, item):
        assert item.attrs["description"], name
        assert item.attrs["units"], name

    paths = list((emitted / "benchmarks").rglob("*.h5"))
    assert len(paths) == 3
    for path in paths:
        with h5py.File(path) as file:
            has_both("/", file)
            file.visititems(has_both)


def test_traces_are_a_run_of_the_closed_loop(emitted):
    folder = emitted / "benchmarks" / "full_range"
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
