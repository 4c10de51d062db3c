import hashlib
import json
import math
from decimal import Decimal

import pytest
from click.testing import CliRunner

from generator.cli import main
from racecar.controller import save_controller
from racecar.instance import load_instance, load_instance_controller


@pytest.fixture
def onnx(tmp_path, make_controller):
    path = tmp_path / "nets" / "mine.onnx"
    save_controller(make_controller(), path)
    return path


def run(onnx, output, *arguments, start=("0.65", "0.655")):
    command = ["instance", "--onnx", onnx, "--start", *start, *arguments, "-o", output]
    return CliRunner().invoke(main, [str(x) for x in command])


def test_the_defaults_are_the_benchmark(onnx, tmp_path):
    output = tmp_path / "specs" / "first.json"
    assert run(onnx, output).exit_code == 0
    made = load_instance(output)
    assert (made.id, made.category, made.steps) == ("first", "custom", 70)
    assert made.property.name == "clearance"
    lower, upper = made.initial_set.bounds()
    assert lower.tolist() == [0.65, 9.9, 0, 0]
    assert upper.tolist() == [0.655, 9.9, 0, 0]
    assert made.plant.lidar.rays == 5
    assert math.degrees(made.plant.lidar.field_of_view) == pytest.approx(230, abs=1e-12)


def test_the_instance_finds_its_controller_from_any_folder(onnx, tmp_path, monkeypatch):
    output = tmp_path / "a" / "b" / "i.json"
    monkeypatch.chdir(tmp_path)
    assert run("nets/mine.onnx", "a/b/i.json").exit_code == 0
    made = load_instance(output)
    assert made.controller.file == "../../nets/mine.onnx"
    assert made.controller.name == "mine"
    assert made.controller.sha256 == hashlib.sha256(onnx.read_bytes()).hexdigest()
    monkeypatch.chdir("/")
    assert load_instance_controller(made, output).rays == 5


def test_a_link_in_the_way_does_not_mislead_the_relative_path(onnx, tmp_path):
    (tmp_path / "deep" / "er").mkdir(parents=True)
    (tmp_path / "link").symlink_to(tmp_path / "deep" / "er")
    output = tmp_path / "link" / "i.json"
    assert run(onnx, output).exit_code == 0
    assert load_instance_controller(load_instance(output), output).rays == 5


def test_every_option_reaches_the_file(onnx, tmp_path):
    output = tmp_path / "i.json"
    options = (
        "--property hscc20 --steps 12 --front 3.25 --speed 2.4 --heading -10.5 --fov 180 "
        "--id mine.odd --category odd"
    )
    assert run(onnx, output, *options.split()).exit_code == 0
    made = load_instance(output)
    assert (made.id, made.category, made.steps) == ("mine.odd", "odd", 12)
    assert made.property.name == "hscc20"
    assert made.initial_set.f == (3.25, 3.25)
    assert made.initial_set.v == (2.4, 2.4)
    assert made.initial_set.theta == (math.radians(-10.5),) * 2
    assert made.plant.lidar.field_of_view == math.pi


def test_1081_rays_see_270_degrees(tmp_path, make_controller):
    save_controller(make_controller(rays=1081), tmp_path / "scan.onnx")
    assert run(tmp_path / "scan.onnx", tmp_path / "i.json").exit_code == 0
    view = load_instance(tmp_path / "i.json").plant.lidar.field_of_view
    assert math.degrees(view) == pytest.approx(270, abs=1e-12)


@pytest.mark.parametrize("bounds", [("0.7", "0.705"), ("0.650", "6.55e-1"), ("1", "1.0000000001")])
def test_bounds_are_kept_as_decimals(onnx, tmp_path, bounds):
    output = tmp_path / "i.json"
    assert run(onnx, output, start=bounds).exit_code == 0
    s = json.loads(output.read_text(), parse_float=Decimal)["initial_set"]["s"]
    assert s == [Decimal(bounds[0]), Decimal(bounds[1])]


def test_json_names_the_result(onnx, tmp_path):
    result = run(onnx, tmp_path / "i.json", "--json")
    assert json.loads(result.stdout)["id"] == "i"


def test_ranges_make_a_state_box(onnx, tmp_path):
    output = tmp_path / "i.json"
    options = "--front 9.88 9.9 --speed=0 0.05 --heading -1.5 -.5"
    assert run(onnx, output, *options.split()).exit_code == 0
    made = load_instance(output)
    assert made.initial_set.s == (0.65, 0.655)
    assert made.initial_set.f == (9.88, 9.9)
    assert made.initial_set.v == (0.0, 0.05)
    assert made.initial_set.theta == (math.radians(-1.5), math.radians(-0.5))
    assert made.disturbance is None


def test_one_start_is_a_point(onnx, tmp_path):
    output = tmp_path / "i.json"
    assert run(onnx, output, start=("0.7",)).exit_code == 0
    assert load_instance(output).initial_set.s == (0.7, 0.7)


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ("--noise 0.005", (0.005, 0, True, "run")),
        ("--missing 2", (0.0, 2, True, "run")),
        ("--missing 5 --missing-choice step", (0.0, 5, True, "step")),
        ("--noise 1e-3 --missing 1 --missing-everywhere", (0.001, 1, False, "run")),
    ],
)
def test_disturbances_reach_the_file(onnx, tmp_path, options, expected):
    output = tmp_path / "i.json"
    assert run(onnx, output, *options.split()).exit_code == 0
    found = json.loads(output.read_text())["disturbance"]
    assert tuple(found.values()) == expected
    assert list(found) == ["noise", "missing", "turn_only", "choice"]


def test_mirrors_reach_the_file(onnx, tmp_path):
    output = tmp_path / "i.json"
    options = "--mirror 0 1 0 2.5 --mirror 0.1 0 1 0 --mirror-incidence 30 --missing 1"
    assert run(onnx, output, *options.split()).exit_code == 0
    found = json.loads(output.read_text())["disturbance"]
    assert found["missing"] == 1
    assert found["mirrors"] == {
        "segments": [
            {"hall": 0, "begin": [0.0, 1.0], "end": [0.0, 2.5]},
            {"hall": 0, "begin": [0.1, 0.0], "end": [1.0, 0.0]},
        ],
        "incidence": math.radians(30),
    }
    assert run(onnx, output, "--mirror", "0", "1", "0", "2").exit_code == 0
    alone = load_instance(output).disturbance
    assert (alone.noise, alone.missing) == (0, 0)
    assert alone.mirrors.incidence == math.radians(45)


def test_no_noise_and_no_missing_rays_are_no_disturbance(onnx, tmp_path):
    output = tmp_path / "i.json"
    assert run(onnx, output, "--noise", "0", "--missing", "0").exit_code == 0
    assert "disturbance" not in json.loads(output.read_text())


BAD = {
    "three values of a range": ({"more": ("--front", "9", "9.1", "9.2")}, "9.2"),
    "a front range upside down": ({"more": ("--front", "9.9", "9.8")}, "f: lower bound 9.9"),
    "a speed range below 0": ({"more": ("--speed", "-0.1", "0.1")}, "backwards"),
    "a heading that is no number": ({"more": ("--heading", "left")}, "'left' is not"),
    "negative noise": ({"more": ("--noise", "-0.005")}, "--noise"),
    "noise that is no number": ({"more": ("--noise", "5mm")}, "'5mm' is not a decimal number"),
    "infinite noise": ({"more": ("--noise", "inf")}, "exactly"),
    "negative missing rays": ({"more": ("--missing", "-1")}, "--missing"),
    "more missing rays than rays": ({"more": ("--missing", "6")}, "6 of 5 rays"),
    "another choice": ({"more": ("--missing", "1", "--missing-choice", "lap")}, "lap"),
    "a choice of no rays": ({"more": ("--missing-choice", "step")}, "give --missing K"),
    "no rays everywhere": ({"more": ("--missing-everywhere",)}, "give --missing K"),
    "a mirror in the air": ({"more": ("--mirror", "0", "1", "0.1", "2")}, "mirrors.segments.0: "),
    "a mirror of words": ({"more": ("--mirror", "0", "1", "0", "x")}, "'x' is not a decimal"),
    "an angle of no mirror": ({"more": ("--mirror-incidence", "30")}, "give --mirror as well"),
    "too large an angle": (
        {"more": ("--mirror", "0", "1", "0", "2", "--mirror-incidence", "90")},
        "give 0 or more, below 90",
    ),
    "LO above HI": ({"start": ("0.7", "0.6")}, "lower bound 0.7 is above upper bound 0.6"),
    "a bound that is no number": ({"start": ("a", "0.6")}, "'a' is not a decimal number"),
    "a bound of NaN": ({"start": ("nan", "0.6")}, "exactly"),
    "more digits than a double": ({"start": ("0.65", "0.6500000000000000001")}, "exactly"),
    "a start inside a wall": ({"start": ("-0.1", "0.7")}, "reaches into a wall"),
    "a front inside a wall": ({"more": ("--front", "-1")}, "reaches into a wall"),
    "backwards": ({"more": ("--speed", "-1")}, "backwards"),
    "no steps": ({"more": ("--steps", "0")}, "steps"),
    "an unknown property": ({"more": ("--property", "nice")}, "nice"),
    "an ID with spaces": ({"more": ("--id", "a b")}, "id"),
    "no field of view": ({"more": ("--fov", "0")}, "--fov"),
    "too wide a field of view": ({"more": ("--fov", "361")}, "--fov"),
    "a field of view of NaN": ({"more": ("--fov", "nan")}, "field of view"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_input_gives_one_line_and_no_file(onnx, tmp_path, case):
    settings, message = BAD[case]
    output = tmp_path / "i.json"
    result = run(
        onnx, output, *settings.get("more", ()), start=settings.get("start", ("0.7", "0.71"))
    )
    assert result.exit_code == 2
    assert result.stderr.startswith("error: ")
    assert result.stderr.count("\n") == 1
    assert message in result.stderr
    assert list(tmp_path.glob("*.json")) + list(tmp_path.glob(".*")) == []


def test_a_missing_or_truncated_controller_gives_one_line_and_no_file(onnx, tmp_path):
    result = run(tmp_path / "no.onnx", tmp_path / "i.json")
    assert (result.exit_code, "no.onnx" in result.stderr) == (2, True)
    onnx.write_bytes(onnx.read_bytes()[:100])
    result = run(onnx, tmp_path / "i.json")
    assert (result.exit_code, "not a complete ONNX file" in result.stderr) == (2, True)
    assert not (tmp_path / "i.json").exists()
