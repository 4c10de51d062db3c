"""Instances: written and read back without loss, and refused with one clear line."""

from __future__ import annotations

import copy
import hashlib
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from global_geometry import TRACKS
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State, simulate
from racecar.controller import Controller, Layer, save_controller
from racecar.disturbance import Disturbance, Mirrors
from racecar.errors import BadInput
from racecar.faultmodels.spec import Segment
from racecar.instance import (
    ControllerReference,
    InitialSet,
    Instance,
    format_instance,
    instance_schema,
    load_instance,
    load_instance_controller,
    parse_instance,
    plant_data,
    property_data,
    save_instance,
)
from racecar.lidar import Lidar
from racecar.safety import PROPERTIES, named_property
from racecar.track import Hall, Track, square_track


def make_instance(
    track: Track | None = None,
    safety: str = "clearance",
    s: tuple[float, float] = (0.65, 0.655),
    steps: int = 70,
    sha256: str = "0" * 64,
    disturbance: Disturbance | None = None,
    **car: Any,
) -> Instance:
    plant = Plant(track or square_track(), Bicycle(**car), Lidar())
    return Instance(
        id="TD3_L21_64x64_C1.closed_loop.w5mm.000.clearance",
        category="closed_loop",
        controller=ControllerReference(name="C", file="../onnx/C.onnx", sha256=sha256),
        plant=plant_data(plant),
        initial_set=InitialSet(s=s, f=(2.9, 2.9), v=(0.0, 0.0), theta=(0.0, 0.0)),
        disturbance=disturbance,
        steps=steps,
        property=property_data(named_property(safety, plant.track)),
    )


DISTURBANCES = st.builds(
    Disturbance,
    noise=st.floats(1e-9, 1),
    missing=st.integers(0, 21),
    turn_only=st.booleans(),
    choice=st.sampled_from(["run", "step"]),
    mirrors=st.none()
    | st.builds(
        Mirrors,
        # On the wall in front of the first hall, which every track here has.
        segments=st.lists(
            st.builds(
                lambda s, width: Segment(hall=0, begin=(s, 0.0), end=(s + width, 0.0)),
                st.floats(0, 0.5),
                st.floats(1e-6, 0.5),
            ),
            min_size=1,
            max_size=3,
        ).map(tuple),
        incidence=st.floats(0, 1.5),
    ),
)
PLACES = st.tuples(st.floats(0.01, 0.9), st.floats(0.01, 0.9)).map(sorted).map(tuple)


@settings(max_examples=50)
@given(
    track=TRACKS.filter(lambda track: track.halls[0].length > 3),
    safety=st.sampled_from(sorted(PROPERTIES)),
    s=PLACES,
    steps=st.integers(1, 100_000),
    slip=st.booleans(),
    throttle=st.floats(4, 100),
    disturbance=st.none() | DISTURBANCES,
)
def test_reading_gives_back_what_was_written(track, safety, s, steps, slip, throttle, disturbance):
    instance = make_instance(
        track, safety, s, steps, disturbance=disturbance, slip=slip, throttle=throttle
    )
    text = format_instance(instance)
    again = parse_instance(text, "test")
    assert again == instance
    assert format_instance(again) == text
    assert again.make_plant() == Plant(track, Bicycle(slip=slip, throttle=throttle), Lidar())
    ours, theirs = named_property(safety, track), again.make_property()
    for one, other in zip(ours.unsafe, theirs.unsafe, strict=True):
        for a, b in zip(one, other, strict=True):
            assert (a.normals == b.normals).all()
            assert (a.offsets == b.offsets).all()
    jsonschema.validate(json.loads(text), instance_schema())


def test_a_file_is_read_back(tmp_path: Path):
    instance, path = make_instance(), tmp_path / "deep" / "i.json"
    save_instance(instance, path)
    assert load_instance(path) == instance
    assert path.read_bytes() == format_instance(instance).encode()


def test_the_schema_is_a_sound_2020_12_schema():
    schema = instance_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    assert schema["$schema"] == "https://json-schema.org/draft/2020-12/schema"


def test_an_instance_simulates_like_the_plant_that_it_states():
    instance = make_instance(slip=True)
    plant = Plant(square_track(), Bicycle(slip=True), Lidar())

    def steer(scan: np.ndarray) -> np.ndarray:
        return 0.1 * np.tanh(scan[15] - scan[5])

    start = State.start(np.linspace(0.65, 0.655, 4), 2.9)
    one = simulate(instance.make_plant(), steer, instance.make_property(), start, 30)
    other = simulate(plant, steer, named_property("clearance", plant.track), start, 30)
    assert (one.margin == other.margin).all()


# --- Bad instances -----------------------------------------------------------------------

GOOD = json.loads(format_instance(make_instance()))


def put(*path: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change: put the last of ``path`` where the others lead."""
    *keys, last, value = path

    def change(data: dict[str, Any]) -> None:
        place: Any = data
        for key in keys:
            place = place[key]
        place[last] = value

    return change


def drop(*path: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        place: Any = data
        for key in path[:-1]:
            place = place[key]
        del place[path[-1]]

    return change


def mirrors(hall: int, *ends: list[float]) -> Callable[[dict[str, Any]], None]:
    """Return a change: a stretch of wall that mirrors after one that is good."""
    good = {"hall": 0, "begin": [0.0, 0.0], "end": [0.0, 1.0]}
    bad = dict(zip(("begin", "end"), ends, strict=True), hall=hall)
    return put("disturbance", "mirrors", {"segments": [good, bad], "incidence": 0.7})


SECOND = "disturbance.mirrors.segments.1: "
CLOSE = "the last hall does not lead back to the first"
FRAMES = "plant.frames: they do not follow from plant.halls"

BAD_INSTANCES: dict[str, tuple[Callable[[dict[str, Any]], None], str]] = {
    "lower above upper": (put("initial_set", "s", [0.7, 0.65]), "s: lower bound 0.7 is above"),
    "start in a wall": (put("initial_set", "s", [-0.1, 0.65]), "it reaches into a wall"),
    "start on a wall": (put("initial_set", "s", [0.0, 0.65]), "it reaches into a wall"),
    "start in the block": (put("initial_set", "s", [1.0, 1.6]), "it reaches into a wall"),
    "start behind the front": (put("initial_set", "f", [-2.0, -1.0]), "it reaches into a wall"),
    "backwards": (put("initial_set", "v", [-1.0, 0.0]), "does not drive backwards"),
    "NaN": (put("initial_set", "s", [float("nan"), 0.65]), "initial_set.s.0"),
    "infinite": (put("initial_set", "f", [1.0, float("inf")]), "initial_set.f.1"),
    "three bounds": (put("initial_set", "s", [0.1, 0.2, 0.3]), "initial_set.s"),
    "no steps": (put("steps", 0), "steps: "),
    "half a step": (put("steps", 70.5), "steps: "),
    "missing field": (drop("steps"), "steps: Field required"),
    "missing bound": (drop("initial_set", "theta"), "initial_set.theta: Field required"),
    "unknown field": (put("comment", "hello"), "comment: "),
    "other format": (put("format", "vnnlib"), "format: "),
    "other version": (put("version", "9.0"), "version: "),
    "identifier": (put("id", "../escape"), "id: "),
    "sha256": (put("controller", "sha256", "abc"), "controller.sha256: "),
    "one ray": (put("plant", "lidar", "rays", 1), "plant.lidar.rays: "),
    "field of view": (put("plant", "lidar", "field_of_view", 7.0), "plant.lidar.field_of_view: "),
    "period": (put("plant", "period", 0), "plant.period: "),
    "width": (put("plant", "width", -1.5), "plant.width: "),
    "throttle": (put("plant", "bicycle", "throttle", 3.0), "throttle is below hysteresis"),
    "wheelbase": (put("plant", "bicycle", "front", 0.0), "plant.bicycle.front: "),
    "turn": (put("plant", "halls", 0, "turn", "up"), "plant.halls.0.turn: "),
    "open square": (drop("plant", "halls", 3), CLOSE),
    "short hall": (put("plant", "halls", 0, "length", 1.0), "it must be at least two widths"),
    "no halls": (put("plant", "halls", []), "plant.halls: "),
    "moved wall": (put("plant", "frames", 1, "obstacles", 0, 0, [1.0, 0.0, 0.1]), FRAMES),
    "missing frame": (drop("plant", "frames", 3), FRAMES),
    "other advance": (put("plant", "frames", 0, "advance", "rotation", 0.0), FRAMES),
    "false clearance": (
        put("property", "unsafe", 0, 0, 0, [1.0, 0.0, 0.2]),
        "it is not the property clearance on this track",
    ),
    "missing unsafe set": (drop("property", "unsafe", 3), "one list per frame is needed"),
    "empty unsafe set": (put("property", "unsafe", 0, []), "property.unsafe.0: "),
    "no disturbance in a disturbance": (
        put("disturbance", "noise", 0),
        "no noise, missing rays or mirrors",
    ),
    "negative noise": (put("disturbance", "noise", -0.005), "disturbance.noise: "),
    "infinite noise": (put("disturbance", "noise", float("inf")), "disturbance.noise: "),
    "noise as text": (put("disturbance", "noise", "0.005"), "disturbance.noise: "),
    "half a ray": (put("disturbance", "missing", 0.5), "disturbance.missing: "),
    "negative rays": (put("disturbance", "missing", -1), "disturbance.missing: "),
    "more rays than there are": (
        put("disturbance", "missing", 22),
        "disturbance.missing: 22 of 21 rays cannot be missing",
    ),
    "other choice": (put("disturbance", "choice", "turn"), "disturbance.choice: "),
    "turn only by number": (put("disturbance", "turn_only", 1), "disturbance.turn_only: "),
    "a disturbance without a choice": (
        drop("disturbance", "choice"),
        "disturbance.choice: Field required",
    ),
    "no mirrors": (put("disturbance", "mirrors", {"segments": [], "incidence": 0.7}), "segments: "),
    "a mirror in no hall": (mirrors(4, [0, 0], [0, 1]), SECOND + "it is in hall 4; the track"),
    "a mirror in the air": (mirrors(0, [0.5, 1], [0.5, 2]), SECOND + "from (0.5, 1.0) to"),
    "a mirror in the wall": (mirrors(0, [-0.1, 1], [-0.1, 2]), "not lie on one straight wall"),
    "a mirror across the hall": (mirrors(0, [0, 2], [1.5, 2]), "not lie on one straight wall"),
    "a mirror beyond the corner": (mirrors(0, [0, -0.1], [0, 1]), "not lie on one straight wall"),
    "a mirror over an opening": (mirrors(0, [1.5, 1.4], [1.5, 3]), "not lie on one straight wall"),
    "a mirror round the corner": (mirrors(0, [0, 1], [1, 0]), "not lie on one straight wall"),
    "a mirror near the wall": (mirrors(0, [3e-9, 1], [0, 2]), "not lie on one straight wall"),
    "a mirror without a length": (mirrors(0, [0, 1], [0, 1]), "the same point"),
    "an unknown disturbance": (put("disturbance", "bias", 0.1), "disturbance.bias: "),
    "empty polygon": (put("property", "unsafe", 0, 0, []), "property.unsafe.0.0: "),
}


@pytest.mark.parametrize("name", BAD_INSTANCES)
def test_a_bad_instance_is_refused_in_one_line(name: str, tmp_path: Path):
    change, message = BAD_INSTANCES[name]
    data = copy.deepcopy(GOOD)
    data["disturbance"] = {"noise": 0.005, "missing": 0, "turn_only": True, "choice": "run"}
    change(data)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(BadInput) as caught:
        load_instance(path)
    assert message in str(caught.value)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "text", ["", "{", "[]", "null", "{}", format_instance(make_instance())[:900]]
)
def test_text_that_is_no_instance_is_refused(text: str):
    with pytest.raises(BadInput, match=r"^here: .") as caught:
        parse_instance(text, "here")
    assert "\n" not in str(caught.value)


def test_an_undisturbed_instance_says_nothing_of_disturbances():
    data = json.loads(format_instance(make_instance()))
    assert "disturbance" not in data
    data["disturbance"] = None
    assert parse_instance(json.dumps(data), "here") == make_instance()


def test_a_disturbance_is_written_in_full():
    disturbance = Disturbance(noise=0.005, missing=1, turn_only=True, choice="run")
    data = json.loads(format_instance(make_instance(disturbance=disturbance)))
    assert data["disturbance"] == {
        "noise": 0.005,
        "missing": 1,
        "turn_only": True,
        "choice": "run",
    }


@pytest.mark.parametrize(
    ("once", "twice", "key"),
    [
        ('"steps": 70', '"steps": 70, "steps": 70', "steps"),
        ('"steps": 70', '"steps": 70, "\\u0073teps": 5', "steps"),
        ('"width": 1.5', '"width": 1.4, "width": 1.5', "width"),
        ('"turn": "right"', '"turn": "left", "turn": "right"', "turn"),
    ],
)
def test_a_key_that_is_given_twice_is_refused(once, twice, key):
    text = format_instance(make_instance())
    assert once in text
    parse_instance(text, "here")
    with pytest.raises(BadInput, match=f'^here: the key "{key}" is given twice') as caught:
        parse_instance(text.replace(once, twice), "here")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_refused(tmp_path: Path):
    with pytest.raises(BadInput, match="No such file"):
        load_instance(tmp_path / "missing.json")


def test_a_property_of_ones_own_may_be_anything():
    data = copy.deepcopy(GOOD)
    data["property"]["name"] = "left_wall_only"
    data["property"]["unsafe"] = [[[[1.0, 0.0, 0.2]]]] * 4
    instance = parse_instance(json.dumps(data), "here")
    assert instance.make_property().name == "left_wall_only"


def test_an_open_track_of_left_turns_is_an_instance():
    track = Track(1.0, (Hall(12.0, "left"), Hall(5.0, None)), closed=False)
    instance = make_instance(track)
    assert instance.plant.frames[1].advance is None
    assert parse_instance(format_instance(instance), "here") == instance


# --- The controller of an instance -------------------------------------------------------


def write_controller(path: Path, rays: int = 21) -> str:
    layer = Layer(np.zeros((1, rays), np.float32), np.zeros(1, np.float32), "tanh")
    save_controller(Controller((layer,)), path)
    return hashlib.sha256(path.read_bytes()).hexdigest()


def test_the_controller_is_found_and_checked(tmp_path: Path):
    sha256 = write_controller(tmp_path / "onnx" / "C.onnx")
    path = tmp_path / "specs" / "i.json"
    save_instance(make_instance(sha256=sha256), path)
    assert load_instance_controller(load_instance(path), path).rays == 21

    write_controller(tmp_path / "onnx" / "C.onnx", rays=22)
    with pytest.raises(BadInput, match="its sha256 is not the one"):
        load_instance_controller(load_instance(path), path)
    other = make_instance(sha256=write_controller(tmp_path / "onnx" / "C.onnx", rays=41))
    with pytest.raises(BadInput, match=r"it reads 41 rays, but .* has 21"):
        load_instance_controller(other, path)
    (tmp_path / "onnx" / "C.onnx").unlink()
    with pytest.raises(BadInput, match="No such file"):
        load_instance_controller(load_instance(path), path)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        (("steps",), "steps"),
        (("initial_set", "s", 0), "initial_set.s.0"),
        (("plant", "lidar", "rays"), "plant.lidar.rays"),
    ],
)
def test_numbers_written_as_strings_are_refused(change, complaint):
    data = json.loads(format_instance(make_instance()))
    place = data
    for key in change[:-1]:
        place = place[key]
    place[change[-1]] = str(place[change[-1]])
    with pytest.raises(BadInput, match=complaint):
        parse_instance(json.dumps(data), "i.json")


def test_a_constraint_without_a_direction_is_refused():
    data = json.loads(format_instance(make_instance()))
    data["property"]["name"] = "mine"
    data["property"]["unsafe"][0].append([[0.0, 0.0, 1.0]])
    with pytest.raises(BadInput, match="normal"):
        parse_instance(json.dumps(data), "i.json")
