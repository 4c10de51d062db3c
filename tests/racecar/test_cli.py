from __future__ import annotations

import json
import math
import os
import pty
import shutil
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from racecar.bicycle import Bicycle
from racecar.cli import main
from racecar.closed_loop import Plant
from racecar.controller import Controller, Layer, save_controller
from racecar.experiment import EvenStarts, Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.summary import summarise
from racecar.track import square_track

FIELDS = {
    "runs", "safe", "safe_fraction", "safe_fraction_interval", "safe_fraction_continuous",
    "margin_min", "margin_min_sampled", "steps_per_second", "worst_run", "worst_start",
    "seed", "faults", "property", "steps",
}  # fmt: skip


def make_controller(rays: int = 21) -> Controller:
    """Steer away from the nearer side and, smoothly, by every reading."""
    random = np.random.default_rng(rays)
    side = np.sign(np.linspace(-1, 1, rays))
    first = np.stack([side / rays, random.normal(size=rays) / rays]).astype(np.float32)
    return Controller(
        (
            Layer(first, np.zeros(2, np.float32), "tanh"),
            Layer(np.array([[1.0, 0.1]], np.float32), np.zeros(1, np.float32), "tanh"),
            Layer(np.array([[0.26]], np.float32), np.zeros(1, np.float32), "linear"),
        )
    )


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with controllers: good ones, and every kind of bad one."""
    monkeypatch.chdir(tmp_path)
    good = make_controller()
    save_controller(good, tmp_path / "good.onnx")
    save_controller(make_controller(1081), tmp_path / "full.onnx")
    whole = (tmp_path / "good.onnx").read_bytes()
    (tmp_path / "truncated.onnx").write_bytes(whole[: len(whole) // 2])
    weights = good.layers[0].weights.copy()
    weights[0, 3] = np.nan
    broken = Controller((replace(good.layers[0], weights=weights), *good.layers[1:]))
    save_controller(broken, tmp_path / "nan.onnx")
    return tmp_path


@pytest.fixture
def run(capsys):
    """Run a command in this process: exit status, standard output, standard error."""

    def invoke(*arguments: object):
        with pytest.raises(SystemExit) as end:
            main([str(x) for x in arguments], prog_name="racecar")
        out, err = capsys.readouterr()
        return end.value.code, out, err

    return invoke


@pytest.fixture
def run_json(run):
    def invoke(*arguments: object) -> dict:
        status, out, err = run(*arguments, "--json")
        assert (status, err) == (0, "")
        assert out.count("\n") == 1
        return json.loads(out)

    return invoke


def engine(controller: Controller, **changes) -> Experiment:
    plant = Plant(square_track(), Bicycle(), Lidar(controller.rays))
    return Experiment(plant, named_property("clearance", plant.track), **changes)


class TestSimulate:
    def test_json_has_the_promised_fields(self, folder, run_json):
        record = run_json("simulate", "--onnx", "good.onnx", "--starts", 20)
        assert set(record) >= FIELDS
        assert record["runs"] == 20
        assert record["safe_fraction"] == record["safe"] / 20
        assert set(record["worst_start"]) == {"s", "f", "v", "theta"}
        assert record["steps_per_second"] > 0
        assert (record["faults"], record["property"]) == ("none", "clearance")
        assert (record["steps"], record["seed"]) == (70, 0)
        low, high = record["safe_fraction_interval"]
        assert low <= record["safe_fraction"] <= high
        assert record["margin_min"] <= record["margin_min_sampled"]

    def test_the_defaults_are_the_benchmarks(self, folder, run_json):
        record = run_json("simulate", "--onnx", "good.onnx")
        assert record["runs"] == 1001
        start = record["worst_start"]
        assert 0.65 <= start["s"] <= 0.85
        assert (start["f"], start["v"], start["theta"]) == (9.9, 0.0, 0.0)

    def test_faults_bring_the_papers_starts(self, folder, run_json):
        record = run_json("simulate", "--onnx", "good.onnx", "--faults", "paper", "--starts", 50)
        assert (record["faults"], record["missing"], record["noise"]) == ("paper", 5, 0.2)
        start = record["worst_start"]
        assert 0.55 <= start["s"] <= 0.95
        assert (start["f"], start["v"]) == (10.0, 0.0)
        assert 0 < abs(start["theta"]) <= 0.3

    @pytest.mark.parametrize("faults", ["none", "paper"])
    def test_it_agrees_with_the_network_in_float64(self, folder, run_json, faults):
        controller = make_controller()
        record = run_json(
            "simulate", "--onnx", "good.onnx", "--starts", 200, "--faults", faults, "--seed", 3
        )
        starts = EvenStarts() if faults == "none" else RandomStarts()
        setup = engine(controller, starts=starts, faults=FAULTS[faults], runs=200, seed=3)
        expected = summarise(run_experiment(setup, controller.steering_rows))
        assert record["safe"] == expected.safe
        assert record["margin_min"] == pytest.approx(expected.margin_min, abs=1e-4)
        assert record["worst_start"]["s"] == pytest.approx(expected.worst_start["s"], abs=1e-12)

    def test_the_same_seed_gives_the_same_numbers(self, folder, run_json):
        def numbers(seed):
            record = run_json(
                "simulate", "--onnx", "good.onnx", "--faults", "paper", "--starts", 60,
                "--seed", seed,
            )  # fmt: skip
            del record["steps_per_second"], record["seed"]
            return record

        assert numbers(5) == numbers(5)
        assert numbers(5) != numbers(6)

    def test_options_reach_the_model(self, folder, run_json):
        def record(*options):
            return run_json("simulate", "--onnx", "good.onnx", "--starts", 9, *options)

        base = record()
        assert record("--fov", 230)["margin_min"] == base["margin_min"]
        assert record("--fov", 200)["margin_min"] != base["margin_min"]
        assert record("--slip")["margin_min"] != base["margin_min"]
        assert record("--property", "hscc20")["property"] == "hscc20"
        assert record("--steps", 3)["margin_min"] == pytest.approx(0.35, abs=2e-3)
        narrow = record("--start", 0.7, 0.7)
        assert narrow["worst_start"]["s"] == 0.7
        custom = record("--faults", "paper", "--missing", 1, "--noise", 0)
        assert (custom["faults"], custom["missing"], custom["noise"]) == ("custom", 1, 0.0)
        assert custom["worst_start"]["f"] == 10.0
        assert record("--noise", 0.1)["faults"] == "noise"

    def test_the_number_of_rays_and_the_field_of_view_come_from_the_file(self, folder, run_json):
        record = run_json("simulate", "--onnx", "full.onnx", "--starts", 2, "--steps", 2)
        assert record["rays"] == 1081
        assert record["field_of_view"] == math.radians(270)
        record = run_json("simulate", "--onnx", "good.onnx", "--starts", 2, "--steps", 2)
        assert record["rays"] == 21
        assert record["field_of_view"] == math.radians(230)

    def test_people_get_a_table(self, folder, run):
        status, out, err = run("simulate", "--onnx", "good.onnx", "--starts", 20)
        assert (status, err) == (0, "")
        assert out.startswith("good")
        for words in ("safe at control instants", "least margin at all times", "steps/s"):
            assert words in out
        assert max(map(len, out.splitlines())) <= 80

    def test_an_interrupt_ends_with_130_and_no_result(self, folder, run, monkeypatch):
        def interrupted(*arguments, **options):
            raise KeyboardInterrupt

        monkeypatch.setattr("racecar.cli.run_experiment", interrupted)
        status, out, err = run("simulate", "--onnx", "good.onnx", "--json")
        assert (status, out, err.strip()) == (130, "", "interrupted")


BAD_FOR_BOTH = [
    (["--onnx", "missing.onnx"], "missing.onnx"),
    (["--onnx", "."], "cannot be read"),
    (["--onnx", "truncated.onnx"], "truncated.onnx"),
    (["--onnx", "nan.onnx"], "not finite"),
    (["--onnx", "good.onnx", "--rays", "41"], "reads 21 rays"),
    (["--onnx", "good.onnx", "--start", "0.8", "0.7"], "lower end"),
    (["--onnx", "good.onnx", "--start", "nan", "0.7"], "finite"),
    (["--onnx", "good.onnx", "--start", "0.7", "1.6"], "wall"),
    (["--onnx", "good.onnx", "--start", "0", "0.7"], "wall"),
    (["--onnx", "good.onnx", "--starts", "0"], "--starts"),
    (["--onnx", "good.onnx", "--steps", "0"], "--steps"),
    (["--onnx", "good.onnx", "--seed", "-1"], "--seed"),
    (["--onnx", "good.onnx", "--noise", "-0.1"], "noise"),
    (["--onnx", "good.onnx", "--noise", "nan"], "noise"),
    (["--onnx", "good.onnx", "--missing", "-1"], "missing"),
    (["--onnx", "good.onnx", "--fov", "361"], "field of view"),
    (["--onnx", "good.onnx", "--faults", "some"], "--faults"),
    (["--onnx", "good.onnx", "--property", "none"], "--property"),
    ([], "--onnx"),
]
BAD_FOR_PLOT = [
    (["--onnx", "good.onnx", "-o", "figure.pdf"], ".png or .svg"),
    (["--onnx", "good.onnx"], "--output"),
    (["-o", "figure.png", "--scan", "1.5", "3", "0"], "wall"),
    (["-o", "figure.png", "--scan", "0.7", "3", "nan"], "finite"),
    (["-o", "figure.png", "--scan", "0.7", "3"], "--scan"),
    (["-o", "figure.png", "--scan", "0.7", "3", "0", "--rays", "1"], "1 rays"),
    (["-o", "figure.png", "--scan", "0.7", "3", "0", "--starts", "5"], "--starts"),
    (["-o", "figure.png", "--scan", "0.7", "3", "0", "--property", "hscc20"], "--property"),
    (["-o", "figure.png", "--scan", "0.7", "3", "0", "--onnx", "nan.onnx"], "not finite"),
    (["-o", "figure.png", "--starts", "10001", "--onnx", "good.onnx"], "--starts"),
]


class TestBadInput:
    def check(self, folder, run, arguments, words):
        before = sorted(folder.iterdir())
        status, out, err = run(*arguments)
        assert (status, out) == (2, "")
        assert err.startswith("error: ")
        assert err.count("\n") == 1
        assert words in err
        assert sorted(folder.iterdir()) == before

    @pytest.mark.parametrize(("arguments", "words"), BAD_FOR_BOTH)
    def test_simulate_says_so_in_one_line(self, folder, run, arguments, words):
        self.check(folder, run, ["simulate", *arguments], words)
        self.check(folder, run, ["simulate", "--json", *arguments], words)

    @pytest.mark.parametrize(("arguments", "words"), BAD_FOR_BOTH)
    def test_plot_says_so_in_one_line_and_writes_nothing(self, folder, run, arguments, words):
        self.check(folder, run, ["plot", "-o", "figure.png", *arguments], words)

    @pytest.mark.parametrize(("arguments", "words"), BAD_FOR_PLOT)
    def test_plots_own_options_are_checked(self, folder, run, arguments, words):
        self.check(folder, run, ["plot", *arguments], words)

    def test_an_output_that_is_a_folder(self, folder, run):
        (folder / "figure.png").mkdir()
        self.check(folder, run, ["plot", "--onnx", "good.onnx", "-o", "figure.png"], "figure.png")

    def test_no_command_shows_the_help(self, run):
        status, out, err = run()
        assert (status, out) == (2, "")
        assert "simulate" in err
        assert "plot" in err


class TestPlot:
    @pytest.mark.parametrize("suffix", ["png", "svg"])
    def test_traces_are_those_of_simulate(self, folder, run_json, suffix):
        options = ["--onnx", "good.onnx", "--faults", "paper", "--starts", 12, "--seed", 4]
        simulated = run_json("simulate", *options)
        plotted = run_json("plot", *options, "-o", f"figure.{suffix}")
        assert plotted.pop("file") == f"figure.{suffix}"
        del simulated["steps_per_second"]
        assert plotted == simulated
        assert (folder / f"figure.{suffix}").stat().st_size > 5000

    def test_people_get_one_line(self, folder, run):
        status, out, err = run("plot", "--onnx", "good.onnx", "--starts", 5, "-o", "figure.svg")
        assert (status, err) == (0, "")
        assert out.startswith("figure.svg: ")
        assert out.count("\n") == 1

    def test_the_title_tells_the_safe_share(self, folder, run_json):
        from xml.etree import ElementTree

        record = run_json("plot", "--onnx", "good.onnx", "--starts", 8, "-o", "figure.svg")
        # Text is drawn as outlines; matplotlib keeps it as a comment beside them.
        text = (folder / "figure.svg").read_text()
        assert f"<!-- good: {record['safe']} of 8 runs safe" in text
        ElementTree.fromstring(text)

    def test_the_whole_track_and_longer_drives(self, folder, run_json):
        record = run_json(
            "plot", "--onnx", "good.onnx", "--starts", 3, "--steps", 90, "--whole-track",
            "-o", "lap.png",
        )  # fmt: skip
        assert record["steps"] == 90
        assert (folder / "lap.png").exists()

    def test_a_scan_is_that_of_the_lidar(self, folder, run_json):
        record = run_json("plot", "--scan", 0.6, 3, -10, "--rays", 41, "-o", "scan.svg")
        assert record["theta"] == math.radians(-10)
        track = square_track()
        lidar = Lidar(41)
        expected = lidar.scan(track.frames[0].obstacles, 0.6, 3.0, math.radians(-10))[0]
        np.testing.assert_allclose(record["distances"], expected, atol=1e-15)
        assert record["missing"] == []
        assert record["steering"] is None
        assert (folder / "scan.svg").exists()

    def test_a_scan_with_faults_and_a_controller(self, folder, run_json):
        record = run_json(
            "plot", "--scan", 0.6, 2, 0, "--faults", "paper", "--seed", 2,
            "--onnx", "good.onnx", "-o", "scan.png",
        )  # fmt: skip
        distances = np.array(record["distances"])
        assert record["rays"] == len(distances) == 21
        assert record["missing"]
        assert (distances[record["missing"]] == 5).all()
        steering = make_controller().steering(distances[None])[0]
        assert record["steering"] == pytest.approx(steering, abs=1e-6)

    def test_files_are_byte_identical_in_another_process(self, folder, run):
        pictures = [
            ["--onnx", "good.onnx", "--faults", "paper", "--starts", "6"],
            ["--scan", "0.6", "2", "15", "--faults", "paper", "--seed", "1"],
        ]
        commands = [
            ["plot", *picture, "-o", f"{i}.{suffix}"]
            for i, picture in enumerate(pictures)
            for suffix in ("png", "svg")
        ]
        for command in commands:
            assert run(*command)[0] == 0
        # Another process, started elsewhere by a user with settings of their own.
        other = folder / "other"
        other.mkdir()
        shutil.copy(folder / "good.onnx", other)
        (other / "matplotlibrc").write_text("lines.linewidth: 7\nsvg.fonttype: none\n")
        code = (
            "import json, sys\n"
            "from racecar.cli import main\n"
            "for command in json.loads(sys.argv[1]):\n"
            "    try: main(command)\n"
            "    except SystemExit as end: assert end.code == 0\n"
        )
        subprocess.run(
            [sys.executable, "-c", code, json.dumps(commands)],
            check=True,
            cwd=other,
            env=os.environ | {"PYTHONHASHSEED": "3"},
            stdout=subprocess.DEVNULL,
        )
        for command in commands:
            assert (folder / command[-1]).read_bytes() == (other / command[-1]).read_bytes()


def test_a_terminal_gets_a_progress_bar_on_standard_error_only(folder):
    terminal, its_end = pty.openpty()
    command = [sys.executable, "-m", "racecar", "simulate", "--onnx", "good.onnx"]
    for options, shown in (([], True), (["--json"], False)):
        done = subprocess.run(
            [*command, *options], stdout=subprocess.PIPE, stderr=its_end, check=True, text=True
        )
        os.set_blocking(terminal, False)
        try:
            seen = os.read(terminal, 100_000)
        except BlockingIOError:
            seen = b""
        assert (b"runs" in seen) == shown
        assert "\x1b" not in done.stdout
    os.close(terminal)
    os.close(its_end)


def test_python_dash_m_runs_the_commands(folder):
    command = [sys.executable, "-m", "racecar", "simulate", "--onnx", "good.onnx", "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stderr) == (0, "")
    assert json.loads(done.stdout)["runs"] == 1001


def test_starting_does_not_import_heavy_libraries():
    code = (
        "import sys, racecar.cli; "
        "print({'matplotlib', 'onnxruntime', 'onnx', 'torch', 'gymnasium', 'rich.progress'} "
        "& set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
