"""Small controllers, made by hand, with the records that a training would leave."""

import math

import numpy as np
import pytest
from click.testing import CliRunner

from generator.actor import fold
from generator.cli import main
from generator.hyperparams import load_hyperparameters
from generator.nominal import drive_nominal
from generator.record import ControllerRecord, Tried, save_record
from generator.seeds import file_sha256
from racecar.controller import save_controller

CURVE = "timesteps,episode_return,seconds\n5000,100.5,30.0\n10000,900.25,45.0\n"


def _make(rays=5, seed=0):
    """A network of 8 tanh neurons that hardly steers."""
    random = np.random.default_rng(seed)
    return fold(
        [
            (random.normal(size=(8, rays)), random.normal(size=8), "tanh"),
            (0.01 * random.normal(size=(1, 8)), [0.0], "tanh"),
        ],
        {},
    )


def _add(root, name="TD3_L5_8_C1", rays=5, seed=0):
    """Put a controller, its record and curve into ROOT/onnx; return the controller's file."""
    controller = _make(rays, seed)
    path = root / "onnx" / f"{name}.onnx"
    save_controller(controller, path)
    nominal = drive_nominal(controller, math.radians(230))
    record = ControllerRecord(
        setup=name.rpartition("_")[0],
        seed=1,
        sha256=file_sha256(path),
        nominal=nominal,
        hyperparameters=load_hyperparameters("TD3"),
        libraries={},
        python="3.11",
        export_error=0.0,
        name=name,
        label=nominal.label,
        tried=[Tried(seed=1, finishes_turn=nominal.finishes_turn, safe_fraction=0.0)],
    )
    save_record(record, path.with_suffix(".json"))
    path.with_suffix(".curve.csv").write_text(CURVE)
    return path


@pytest.fixture(scope="session")
def make_controller():
    """make_controller(rays, seed) returns a controller."""
    return _make


@pytest.fixture(scope="session")
def add_controller():
    """add_controller(root, name, rays, seed) makes one with its record and curve in ROOT/onnx."""
    return _add


@pytest.fixture(scope="session")
def emitted(tmp_path_factory):
    """A root with one controller and everything that is emitted of it; not to be changed."""
    root = tmp_path_factory.mktemp("root")
    _add(root)
    assert CliRunner().invoke(main, ["emit", "--root", str(root)]).exit_code == 0
    return root
