"""IDs say what an instance asks: every part of one is found again in the instance."""

import math
import re
from collections import Counter
from decimal import Decimal

import pytest

from generator.categories import CATEGORIES
from generator.instances import ControllerFile, make_instance
from racecar.closed_loop import State

WIDER = ("state_box", "noise", "faults", "lap")


@pytest.fixture(scope="module")
def instances(tmp_path_factory, add_controller):
    """Instances of the categories with uncertainty, by category and the rest of the ID."""
    root = tmp_path_factory.mktemp("root")
    file = ControllerFile.load(add_controller(root))
    return {
        (name, question.id.removeprefix(f"{file.name}.{name}.")): make_instance(
            question, file, 4.0, root / "x.json"
        )
        for name in WIDER
        for question in CATEGORIES[name].questions(file)
    }


def width(bounds):
    return Decimal(repr(bounds[1])) - Decimal(repr(bounds[0]))


def test_every_number_of_an_id_is_the_instances(instances):
    for (category, label), instance in instances.items():
        assert instance.category == category
        box, disturbance = instance.initial_set, instance.disturbance
        assert label.endswith(f".{instance.property.name}")
        said = dict(re.findall(r"(?<![a-z])(s|f|v|n|k|m)(\d+)(?:mm|mmps)?(?=\.|$)", label))
        assert width(box.s) * 1000 == Decimal(said["s"])
        assert sum(box.s) / 2 == pytest.approx(0.75)
        assert instance.steps == int(said.get("k", 70))
        assert (disturbance.noise if disturbance else 0) == float(said.get("n", 0)) / 1000
        assert (disturbance.missing if disturbance else 0) == int(said.get("m", 0))
        mirrors = disturbance is not None and disturbance.mirrors is not None
        assert mirrors == label.startswith("mirror")
        if disturbance and disturbance.missing:
            assert f".{disturbance.choice}." in label
            assert disturbance.turn_only
        if category == "state_box":
            assert width(box.f) * 1000 == Decimal(said["f"])
            assert width(box.v) * 1000 == Decimal(said["v"])
            turned = float(re.search(r"\.h([\d.]+)deg\.", label)[1])
            assert math.degrees(box.theta[1] - box.theta[0]) == pytest.approx(turned)
            front, speed = (9.9, box.v[1] / 2) if label.startswith("start.") else (4.0, 2.4)
            assert sum(box.f) / 2 == pytest.approx(front)
            assert sum(box.v) / 2 == pytest.approx(speed)
        else:
            assert (box.f, box.v, box.theta) == ((9.9, 9.9), (0.0, 0.0), (0.0, 0.0))


def test_every_start_is_safe_itself(instances):
    for instance in instances.values():
        lower, upper = instance.initial_set.bounds()
        corners = State.start([lower[0], upper[0]] * 2, [lower[1]] * 2 + [upper[1]] * 2)
        assert instance.make_plant().margin(instance.make_property(), corners).min() > 0


def test_each_category_goes_from_little_to_much(instances):
    counts = Counter(category for category, _ in instances)
    assert counts == {"state_box": 10, "noise": 16, "faults": 46, "lap": 6}
    noise = {i.disturbance.noise for (category, _), i in instances.items() if category == "noise"}
    assert noise == {0.002, 0.005, 0.01, 0.02}
    faults = {
        (i.disturbance.missing, i.disturbance.choice)
        for (category, _), i in instances.items()
        if category == "faults" and i.disturbance.mirrors is None
    }
    assert faults == {(k, choice) for k in (1, 2, 5) for choice in ("run", "step")}


def test_mirrors_are_the_stretches_that_the_id_says(instances):
    mirrored = {label: i for (_, label), i in instances.items() if label.startswith("mirror")}
    assert len(mirrored) == 10
    for label, instance in mirrored.items():
        mirrors, said = instance.disturbance.mirrors, label.split(".")
        assert said[0] == f"mirror{math.degrees(mirrors.incidence):.12g}deg"
        assert (instance.disturbance.noise, instance.disturbance.missing) == (0, 0)
        # How far from the corner each stretch begins and ends, and on which wall.
        found = []
        for segment in mirrors.segments:
            assert segment.hall == 0
            wall, along = ("left", 1) if segment.begin[0] == segment.end[0] == 0 else ("front", 0)
            assert segment.begin[1 - along] == segment.end[1 - along] == 0
            found.append((wall, segment.begin[along], segment.end[along]))
        if said[1] == "any1mof0to4m":
            assert found == [
                (wall, half / 2, half / 2 + 1) for wall in ("left", "front") for half in range(7)
            ]
        else:
            wall, near, far = re.fullmatch(r"(left|front)(\d)to(\d)m", said[1]).groups()
            assert found == [(wall, float(near), float(far))]


def test_a_lap_takes_the_car_through_four_turns():
    # Without steering errors: the straight way at full speed, beside the middle of the halls.
    steps = {question.steps for question in CATEGORIES["lap"].asked}
    way = 4 * (20 - 1.5)
    assert min(steps) * 0.1 >= way / 2.4
