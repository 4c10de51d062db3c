"""The form that Verisig reads: unpickled, composed as its runner does, and run."""

import json
import math
import pickle
import re

import numpy as np
import pytest
import yaml
from hybrid_readers import Edge, Parser, Read
from hybrid_runner import Runner, periods

from generator.hybrid.export import hybrid_files
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.errors import BadInput
from racecar.instance import plant_data, property_data
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import track_from_turns

_FUNCTIONS = ("sin", "cos", "sqrt", "exp", "log")


class Composed:
    """What Verisig's runner makes of the files, ready to run."""

    def __init__(self, files):
        self.network = yaml.safe_load(files[".network.yml"])
        self.plant = pickle.loads(files[".plant.pickle"])
        self.glue = pickle.loads(files[".glue.pickle"])
        self.problem = json.loads(files[".problem.json"])
        self.json = {name: json.loads(files[f".{name}.json"]) for name in ("plant", "glue")}
        # Verisig: `states` of mode 1 first, then the clock; modes get the number plus 1.
        self.states = self.plant[1]["states"]
        self.names = {i: f"{mode['name']}m{i + 1}" for i, mode in self.plant.items()}
        flows = {"DNNm1": {"clock": "(1.0)"}}
        invariants = {"DNNm1": [("v['clock']", "<=", 0.0)]}
        edges = []
        for i, mode in self.plant.items():
            flows[self.names[i]] = {"clock": "(1.0)"} | dict(map(_flow, mode["dynamics"].values()))
            invariants[self.names[i]] = [_constraint(text) for text in mode["invariants"]]
            for (source, target), ways in mode["transitions"].items():
                assert source == i
                edges += self._edges(self.names[source], self.names[target], ways)
        for i, ways in self.glue["plant2dnn"].items():
            edges += self._edges(self.names[i], "DNNm1", ways)
        for i, ways in self.glue["dnn2plant"].items():
            edges += self._edges("DNNm1", self.names[i], ways)
        initial = dict(map(_box, self.problem["initial"])) | {"clock": (0.0, 0.0)}
        self.read = Read(
            [*self.states, "clock"], flows, invariants, edges, self.problem["initial_mode"],
            initial, [],
        )  # fmt: skip
        special = {name: self.special(name) for name in flows}
        self.runner = Runner(self.read, "clock", special=special)

    @staticmethod
    def _edges(source, target, ways):
        found = []
        for i in range(1, len(ways) // 2 + 1):
            reset = dict(map(_reset, ways[f"reset{i}"]))
            assert reset.get("clock", "(0.0)") == "(0.0)"
            guard = [_constraint(text) for text in ways[f"guards{i}"]]
            found.append(Edge(source, target, guard, {"clock": "(0.0)"} | reset))
        return found

    def special(self, name):
        """Return what a jump into a mode computes from the values before it."""
        if name.startswith("DNN"):
            return self.steer
        if match := re.match(r"_(div|cos|sin)_(\d+)_(\d+)_m", name):
            kind, store, argument = match[1], *(self.states[int(x)] for x in match.groups()[1:])
            apply = {"div": lambda x: 1 / x, "cos": math.cos, "sin": math.sin}[kind]
            return lambda values: {store: apply(values[argument])}
        return lambda _: {}

    def steer(self, values):
        layers = len(self.network["weights"])
        x = np.array([values[f"_f{i}"] for i in range(1, len(self.network["weights"][1][0]) + 1)])
        for i in range(1, layers + 1):
            x = np.array(self.network["weights"][i]) @ x + np.array(self.network["offsets"][i])
            assert self.network["activations"][i] == "Tanh"
            x = np.tanh(x)
        return {"_f1": float(x[0])}


def _parsed(text, part):
    parser = Parser(text, functions=_FUNCTIONS)
    found = part(parser)
    parser.end()
    return found


def _constraint(text):
    return _parsed(text, Parser.constraint)


def _flow(line):
    assert line.endswith("\n")
    name, rate = line.split("' = ")
    return name, _parsed(rate, Parser.expression)


def _reset(text):
    name, value = text.split("' := ")
    return name, _parsed(value, Parser.expression)


def _box(text):
    name, low, high = re.fullmatch(r"(\w+) in \[(\S+), (\S+)\]", text).groups()
    return name, (float(low), float(high))


@pytest.fixture(scope="module")
def composed(make_small):
    return Composed(hybrid_files(*make_small(), "verisig", zipped=False))


def test_the_composed_model_drives_the_simulated_trace_on_both_sides_of_a_wall_jump(
    composed, make_small, trace, beside_jumps
):
    instance, controller = make_small()
    for f in beside_jumps:
        simulated = trace(instance, controller, 0.75, f=f)
        start = composed.runner.middle(y1=0.75, y2=f)
        for k, values in enumerate(periods(composed.runner.run(start))):
            for ours, name in {"y1": "s", "y2": "f", "y3": "v", "y4": "theta"}.items():
                assert values[ours] == pytest.approx(simulated[name][k], abs=1e-6), (k, name)
        assert k == 70


def test_a_committed_controller_and_slip_are_followed(committed, trace):
    instance, controller = committed
    data = instance.model_dump(mode="json") | {"steps": 50}
    data["plant"]["bicycle"]["slip"] = True
    changed = type(instance).model_validate(data)
    composed = Composed(hybrid_files(changed, controller, "verisig", zipped=False))
    simulated = trace(changed, controller, 0.7)
    for k, values in enumerate(periods(composed.runner.run(composed.runner.middle(y1=0.7)))):
        assert values["y1"] == pytest.approx(simulated["s"][k], abs=1e-6)
        assert values["y4"] == pytest.approx(simulated["theta"][k], abs=1e-6)
    assert k == 50


def test_halls_of_several_kinds_are_followed_into_each_other(make_small, trace):
    track = track_from_turns(["right", "left"], length=7.0)

    def change(data):
        plant = Plant(track, Bicycle(), Lidar(5))
        data["plant"] = plant_data(plant).model_dump(mode="json")
        data["property"] = property_data(named_property("clearance", track)).model_dump(mode="json")

    instance, controller = make_small(change=change, front="2.2", speed="2", steps=28)
    composed = Composed(hybrid_files(instance, controller, "verisig", zipped=False))
    simulated = trace(instance, controller, 0.75)
    assert simulated["frame"][-1] == 1
    for k, values in enumerate(periods(composed.runner.run(composed.runner.middle(y1=0.75)))):
        assert values["y1"] == pytest.approx(simulated["s"][k], abs=1e-6)
    assert k == 28
    polygons = [polygon for frame in instance.property.unsafe for polygon in frame]
    assert len(composed.problem["unsafe"]) == len(polygons)


def test_time_passes_in_mode_1_and_the_run_begins_in_mode_2(composed):
    # The shipped runner begins in m3, a mode without a name, and looks for _cont_m2.
    assert composed.names[1] == "_cont_m2"
    assert composed.problem["initial_mode"] == "m3" == composed.names[2]
    for i, mode in composed.plant.items():
        assert mode["invariants"] == [f"clock <= {0.1 if i == 1 else 0.0}"]


def test_names_begin_as_verisig_expects(composed):
    assert composed.states[:4] == ["y1", "y2", "y3", "y4"]
    inputs = [name for name in composed.states if name.startswith("_f")]
    assert inputs == [f"_f{i}" for i in range(1, 6)]
    others = set(composed.states) - set(inputs) - {"y1", "y2", "y3", "y4"}
    assert not [name for name in others if name[0] in "xyf_"]
    for mode in composed.plant.values():
        assert mode["states"] == composed.states
        assert list(mode["dynamics"]) == composed.states  # the clock's line is Verisig's


def test_what_a_mode_computes_is_not_reset_by_its_jump(composed):
    for edge in composed.read.edges:
        if match := re.match(r"_(?:div|cos|sin)_(\d+)_\d+_m", edge.target):
            assert composed.states[int(match[1])] not in edge.reset


def test_each_unsafe_polygon_is_a_text_of_its_own_that_lists_every_mode(composed, make_small):
    instance, _ = make_small()
    polygons = instance.property.unsafe[0]
    texts = composed.problem["unsafe"]
    assert len(texts) == len(polygons)
    for text, polygon in zip(texts, polygons, strict=True):
        blocks = re.findall(r"(\w+)\n\t\{\n\t\t(.*)\n", text)
        assert sorted(name for name, _ in blocks) == sorted(
            ["m0", "DNNm1", *composed.names.values()]
        )
        for name, row in blocks:
            if name != "_cont_m2":
                assert row == "clock <= -1.0"
        row = dict(blocks)["_cont_m2"]
        parser, found = Parser(row), []
        while parser.peek():
            found.append(parser.constraint())
        named = {"v['y1']": (1, 0), "v['y2']": (0, 1), "(-v['y1'])": (-1, 0), "(-v['y2'])": (0, -1)}
        assert [[*named[left], b] for left, _, b in found] == [[*map(float, r)] for r in polygon]


def test_pickles_are_of_protocol_2_and_json_says_the_same(make_small, composed):
    files = hybrid_files(*make_small(), "verisig", zipped=False)
    for name in (".plant.pickle", ".glue.pickle"):
        assert files[name].startswith(b"\x80\x02")
    assert len(composed.json["plant"]) == len(composed.plant)
    for i, mode in composed.plant.items():
        told = composed.json["plant"][str(i)]
        assert told["dynamics"] == mode["dynamics"]
        ways = {tuple(map(int, k.split(" -> "))): v for k, v in told["transitions"].items()}
        assert ways == mode["transitions"]


def test_disturbances_are_refused_in_one_line(make_small):
    def change(data):
        data["disturbance"] = {"noise": 0.01, "missing": 0, "turn_only": False, "choice": "run"}

    with pytest.raises(BadInput, match="noise or missing rays") as error:
        hybrid_files(*make_small(change=change), "verisig")
    assert "\n" not in str(error.value)


def test_relu_is_refused(make_small, small):
    first = small.layers[0]
    layers = (type(first)(first.weights, first.biases, "relu"), *small.layers[1:])
    with pytest.raises(BadInput, match="layer 1 has relu"):
        hybrid_files(*make_small(controller=type(small)(layers)), "verisig")
