import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from generator.cli import main
from generator.yaml_network import import_yaml
from racecar.controller import load_controller
from racecar.errors import BadInput

PAPER = Path(__file__).parents[2].parent / "shared" / "paper_controllers"
FUNCTIONS = {
    "Tanh": np.tanh,
    "Sigmoid": lambda x: 1 / (1 + np.exp(-x)),
    "Relu": lambda x: np.maximum(x, 0),
    "Linear": lambda x: x,
}


def evaluate(data, scan):
    """Steering (rad) for scans [batch, rays], by the layout's definition in float64."""
    x = (scan - 2.5) / 5
    for i in sorted(data["weights"]):
        x = x @ np.array(data["weights"][i]).T + np.array(data["offsets"][i])
        x = FUNCTIONS[data["activations"][i]](x)
    return x[:, 0] * math.radians(15)


def network(kinds=("Tanh", "Tanh"), sizes=(4, 3, 1)):
    random = np.random.default_rng(1)
    layers = range(1, len(kinds) + 1)
    return {
        "activations": dict(zip(layers, kinds, strict=True)),
        "offsets": {i: random.normal(size=sizes[i]).tolist() for i in layers},
        "weights": {i: random.normal(size=(sizes[i], sizes[i - 1])).tolist() for i in layers},
    }


def save(path, data):
    path.write_text(yaml.safe_dump(data))
    return path


def run(*arguments):
    return CliRunner().invoke(main, [str(x) for x in arguments])


@pytest.mark.parametrize(
    "name", ["DDPG_L21_64x64_C1", "DDPG_L21_128x128_C2", "TD3_L21_64x64_C1", "TD3_L21_128x128_C1"]
)
def test_paper_networks_steer_as_their_yaml_says(tmp_path, name):
    source = PAPER / f"{name}.yml"
    if not source.exists():
        pytest.skip("the paper's controllers are not beside the repository")
    assert run("import-yaml", source, "-o", tmp_path / "c.onnx").exit_code == 0
    controller = load_controller(tmp_path / "c.onnx")
    scan = np.random.default_rng(0).uniform(0, 5, (2000, 21))
    data = yaml.load(source.read_bytes(), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    assert np.abs(controller.steering(scan) - evaluate(data, scan)).max() < 1e-6


@pytest.mark.parametrize("kinds", [("Tanh", "Tanh"), ("Relu", "Linear"), ("Sigmoid", "Tanh")])
def test_every_activation_is_imported(tmp_path, kinds):
    data = network(kinds)
    controller = import_yaml(save(tmp_path / "n.yml", data), "n")
    scan = np.random.default_rng(0).uniform(0, 5, (500, 4))
    assert np.abs(controller.steering(scan) - evaluate(data, scan)).max() < 1e-6


def test_deep_networks_are_imported(tmp_path):
    data = network(("Tanh",) * 4, (6, 5, 4, 3, 1))
    controller = import_yaml(save(tmp_path / "n.yml", data), "n")
    scan = np.random.default_rng(0).uniform(0, 5, (500, 6))
    assert np.abs(controller.steering(scan) - evaluate(data, scan)).max() < 1e-6


def test_numbers_without_a_point_are_numbers(tmp_path):
    file = tmp_path / "n.yml"
    file.write_text("activations: {1: Linear}\noffsets: {1: [1e-05]}\nweights: {1: [[1, -2e+0]]}\n")
    controller = import_yaml(file, "n")
    expected = math.radians(15) * (0.5 * 1 + -0.5 * -2 + 1e-05)
    assert controller.steering(np.array([[5.0, 0.0]]))[0] == pytest.approx(expected, rel=1e-6)


def test_the_same_file_gives_the_same_bytes_and_names_its_source(tmp_path):
    source = save(tmp_path / "n.yml", network())
    for name in ("a", "b"):
        assert run("import-yaml", source, "-o", tmp_path / name, "--name", "N").exit_code == 0
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    metadata = load_controller(tmp_path / "a").metadata
    assert metadata["name"] == "N"
    assert len(metadata["source_sha256"]) == 64


def broken(change):
    data = network()
    change(data)
    return yaml.safe_dump(data)


BROKEN = {
    "no file content": ("", "sections"),
    "a list": ("[1, 2]", "sections"),
    "cut off": (broken(lambda d: None)[:-200], "not YAML|it needs the sections|numbered"),
    "binary": ("\x00\x01", "YAML"),
    "a section missing": (broken(lambda d: d.pop("offsets")), "sections"),
    "a section too many": (broken(lambda d: d.update(bias={})), "sections"),
    "no layers": ("{weights: {}, offsets: {}, activations: {}}", "numbered"),
    "layers from 0": (
        "{weights: {0: [[1, 1]]}, offsets: {0: [1]}, activations: {0: Tanh}}",
        "1, 2",
    ),
    "a gap in the layers": (broken(lambda d: d["weights"].update({4: [[1]]})), "numbered"),
    "a layer without offsets": (broken(lambda d: d["offsets"].pop(2)), "offsets.*numbered"),
    "a key twice": ("{weights: {1: [[1, 1]], 1: [[2, 2]]}, offsets: {}, activations: {}}", "twice"),
    "an unknown activation": (
        broken(lambda d: d["activations"].update({1: "Swish"})),
        "layer 1: 'Swish'",
    ),
    "rows of two lengths": (broken(lambda d: d["weights"][1][0].pop()), "different lengths"),
    "an empty row": (broken(lambda d: d["weights"][1].__setitem__(0, [])), "row 0"),
    "too few offsets": (broken(lambda d: d["offsets"][1].pop()), "2 values for 3 neurons"),
    "layers that do not fit": (
        broken(lambda d: d["weights"].update({2: [[1.0, 2.0]]})),
        "reads 2 values, but layer 1 has 3",
    ),
    "two outputs": (
        broken(lambda d: (d["weights"][2].append([1, 1, 1]), d["offsets"][2].append(1))),
        "2 neurons",
    ),
    "one input": ("{weights: {1: [[1]]}, offsets: {1: [1]}, activations: {1: Tanh}}", "2 rays"),
    "NaN": (broken(lambda d: d["offsets"][1].__setitem__(0, math.nan)), "finite"),
    "infinity": (broken(lambda d: d["weights"][1][2].__setitem__(0, math.inf)), "layer 1, row 2"),
    "text": (broken(lambda d: d["offsets"][1].__setitem__(0, "one")), "'one' is not a finite"),
    "a truth value": (broken(lambda d: d["offsets"][1].__setitem__(0, True)), "finite"),
    "too large for float32": (broken(lambda d: d["offsets"][1].__setitem__(0, 1e39)), "float32"),
    "an integer beyond any float": (
        broken(lambda d: d["offsets"][1].__setitem__(0, 10**400)),
        "finite",
    ),
}


@pytest.mark.parametrize("case", BROKEN)
def test_a_broken_file_gives_one_clear_line_and_writes_nothing(tmp_path, case):
    text, message = BROKEN[case]
    file = tmp_path / "n.yml"
    file.write_text(text)
    with pytest.raises(BadInput, match=message):
        import_yaml(file, "n")
    result = run("import-yaml", file, "-o", tmp_path / "c.onnx")
    assert result.exit_code == 2
    assert result.stderr.startswith(f"error: {file}: ")
    assert result.stderr.count("\n") == 1
    assert not (tmp_path / "c.onnx").exists()


def test_a_missing_file_gives_one_clear_line(tmp_path):
    result = run("import-yaml", tmp_path / "no.yml", "-o", tmp_path / "c.onnx")
    assert result.exit_code == 2
    assert "cannot be read" in result.stderr
