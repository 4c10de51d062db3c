"""The export command and the files that it writes."""

import gzip
import json
import pickle
import subprocess
import sys
import xml.etree.ElementTree as ET
from pathlib import Path

import click
import jsonschema
import pytest
import yaml
from click.testing import CliRunner
from hybrid_readers import read_flowstar, read_json, read_spaceex

from generator.export_command import FORMATS, export
from generator.hybrid import export as forms
from generator.hybrid.export import hybrid_files
from generator.instances import ControllerFile, Question, make_instance
from racecar.command_line import Commands
from racecar.controller import Controller, Layer, save_controller
from racecar.instance import save_instance

ENDINGS = {
    "flowstar": {".model"},
    "spaceex": {".xml", ".cfg"},
    "json": {".automaton.json"},
    "verisig": {
        ".network.yml",
        ".plant.pickle",
        ".glue.pickle",
        ".plant.json",
        ".glue.json",
        ".problem.json",
    },
}


@click.group(cls=Commands)
def main():
    """Stand in for the command ``generator``."""


main.add_command(export)


@pytest.fixture
def saved(tmp_path, small):
    """Return an instance file beside its controller."""
    save_controller(small, tmp_path / "small.onnx")
    file = ControllerFile.load(tmp_path / "small.onnx")
    path = tmp_path / "small.json"
    question = Question("small.test", "test", ("0.65", "0.85"), steps=5)
    save_instance(make_instance(question, file, 4.0, path), path)
    return path


def run(*args):
    return CliRunner().invoke(main, ["export", *map(str, args)])


def test_all_formats_are_written_and_read_back(saved, tmp_path):
    out = tmp_path / "out"
    result = run(saved, "-o", out)
    assert result.exit_code == 0, result.output
    texts = {}
    for form, endings in ENDINGS.items():
        names = {path.name for path in (out / form).iterdir()}
        wanted = {f"small.test{ending}.gz" for ending in endings}
        assert names == wanted | ({"automaton.schema.json"} if form == "json" else set())
        texts |= {
            ending: gzip.decompress((out / form / f"small.test{ending}.gz").read_bytes())
            for ending in endings
        }
    assert read_flowstar(texts[".model"].decode()).initial["s"] == (0.65, 0.85)
    space = read_spaceex(texts[".xml"].decode(), texts[".cfg"].decode())
    assert space.initial["s"] == (0.65, 0.85)
    assert read_json(texts[".automaton.json"]).initial["s"] == (0.65, 0.85)
    schema = json.loads((out / "json" / "automaton.schema.json").read_text())
    jsonschema.Draft202012Validator(schema).validate(json.loads(texts[".automaton.json"]))
    assert pickle.loads(texts[".plant.pickle"])[1]["name"] == "_cont_"
    assert set(yaml.safe_load(texts[".network.yml"])) == {"weights", "offsets", "activations"}
    assert "y1 in [0.65, 0.85]" in json.loads(texts[".problem.json"])["initial"]


def test_json_tells_each_file_set(saved, tmp_path):
    result = run(saved, "--format", "spaceex", "--format", "json", "-o", tmp_path, "--json")
    rows = [json.loads(line) for line in result.stdout.splitlines()]
    assert [row["format"] for row in rows] == ["spaceex", "json"]
    assert all(row["id"] == "small.test" for row in rows)
    for row in rows:
        for file in row["files"]:
            assert gzip.decompress(Path(file).read_bytes())


def test_plain_files_are_what_is_compressed(saved, tmp_path):
    run(saved, "-o", tmp_path / "zipped")
    run(saved, "--plain", "-o", tmp_path / "plain")
    plain = list((tmp_path / "plain").rglob("small.test*"))
    assert len(plain) == sum(map(len, ENDINGS.values()))
    for path in plain:
        zipped = tmp_path / "zipped" / path.relative_to(tmp_path / "plain")
        content = (zipped.parent / f"{path.name}.gz").read_bytes()
        assert gzip.decompress(content) == path.read_bytes()


def test_the_same_instance_gives_the_same_bytes_in_another_process(saved, make_small):
    script = (
        "import hashlib, sys; from pathlib import Path\n"
        "from generator.hybrid.export import FORMATS, hybrid_files\n"
        "from racecar.instance import load_instance, load_instance_controller\n"
        "p = Path(sys.argv[1]); i = load_instance(p); c = load_instance_controller(i, p)\n"
        "for f in FORMATS:\n"
        "    for n, t in hybrid_files(i, c, f).items(): print(n, hashlib.sha256(t).hexdigest())\n"
    )
    first, second = (
        subprocess.run(
            [sys.executable, "-c", script, str(saved)],
            capture_output=True, text=True, check=True, env={"PYTHONHASHSEED": seed},
        ).stdout
        for seed in ("1", "2")
    )  # fmt: skip
    assert first == second
    assert len(first.splitlines()) == sum(map(len, ENDINGS.values()))


def test_compressed_files_carry_no_time_and_no_name(make_small):
    for content in hybrid_files(*make_small(steps=1), "flowstar").values():
        assert content[:4] == b"\x1f\x8b\x08\x00"  # no flags: no name
        assert content[4:8] == b"\x00\x00\x00\x00"


def test_the_command_knows_the_formats():
    assert set(FORMATS) == set(forms.FORMATS) == set(ENDINGS)


@pytest.mark.parametrize(
    ("args", "message"),
    [
        ([], "name at least one instance file"),
        (["missing.json"], "missing.json: cannot be read"),
        (["x", "--format", "matlab"], "matlab"),
    ],
)
def test_bad_usage_is_one_line_and_status_2(args, message):
    result = run(*args)
    assert result.exit_code == 2
    assert message in result.stderr
    assert len(result.stderr.splitlines()) == 1


def test_bad_input_among_good_leaves_nothing_behind(saved, tmp_path):
    for second, message in (
        (tmp_path / "missing.json", "missing.json: cannot be read"),
        (saved, "its ID, small.test, is that of"),
    ):
        result = run(saved, second, "-o", tmp_path / "out")
        assert result.exit_code == 2
        assert message in result.stderr
        assert len(result.stderr.splitlines()) == 1
        assert not (tmp_path / "out").exists()


def test_what_a_format_cannot_say_is_one_line_and_status_2(saved, tmp_path):
    data = json.loads(saved.read_text())
    data["disturbance"] = {"noise": 0.01, "missing": 0, "turn_only": False, "choice": "run"}
    saved.write_text(json.dumps(data))
    # Named second; the first one could be said.
    forms = ["--format", "json", "--format", "verisig"]
    result = run(saved, *forms, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()
    assert result.stderr.startswith("error: small.test: Verisig")
    assert len(result.stderr.splitlines()) == 1


@pytest.mark.parametrize("form", FORMATS)
def test_walls_that_mirror_are_said_in_no_hybrid_format(saved, tmp_path, form):
    data = json.loads(saved.read_text())
    wall = {"hall": 0, "begin": [0.0, 1.0], "end": [0.0, 2.0]}
    data["disturbance"] = {
        "noise": 0.01, "missing": 0, "turn_only": False, "choice": "run",
        "mirrors": {"segments": [wall], "incidence": 0.7},
    }  # fmt: skip
    saved.write_text(json.dumps(data))
    result = run(saved, "--format", form, "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert not (tmp_path / "out").exists()
    assert result.stderr.startswith("error: small.test: the hybrid automaton does not know walls")
    assert len(result.stderr.splitlines()) == 1


def test_help_imports_nothing_heavy():
    script = (
        "import sys; from generator.export_command import export\n"
        "export.main(['--help'], standalone_mode=False)\n"
        "assert 'generator.hybrid.export' not in sys.modules\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)


def test_a_full_scan_of_1081_rays_is_printed_in_seconds(tmp_path):
    rays = 1081
    layers = (
        Layer(_weights(32, rays), _weights(32, 1)[:, 0], "tanh"),
        Layer(_weights(1, 32), _weights(1, 1)[0], "tanh"),
        Layer(_weights(1, 1), _weights(1, 1)[0] * 0, "linear"),
    )
    save_controller(Controller(layers), tmp_path / "scan.onnx")
    file = ControllerFile.load(tmp_path / "scan.onnx")
    question = Question("scan", "test", ("0.65", "0.85"))
    instance = make_instance(question, file, 4.7, tmp_path / "scan.json")
    files = {}
    for form in FORMATS:
        files |= hybrid_files(instance, file.controller, form)
    ET.fromstring(gzip.decompress(files[".xml.gz"]))
    data = json.loads(gzip.decompress(files[".automaton.json.gz"]))
    assert f"y{rays}" in [variable["name"] for variable in data["variables"]]


def test_what_instances_share_is_printed_once_and_the_files_stay_the_same(make_small):
    exporter = forms.Exporter()
    starts = [("0.65", "0.66"), ("0.66", "0.67"), ("0.65", "0.66")]
    for start in starts:
        instance, controller = make_small(id=f"at.{start[0]}", start=start, heading=("-1", "2"))
        for form in FORMATS:
            for zipped in (True, False):
                files = exporter.files(instance, controller, form, zipped)
                assert files == hybrid_files(instance, controller, form, zipped)
    # Another horizon is another text.
    shorter, controller = make_small(start=starts[0], steps=9)
    for form in FORMATS:
        files = exporter.files(shorter, controller, form)
        assert files == hybrid_files(shorter, controller, form)


def _weights(rows, columns):
    import numpy as np

    return np.random.default_rng(rows).normal(size=(rows, columns)).astype(np.float32) / 30
