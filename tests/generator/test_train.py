"""Real training, of tiny networks for a few steps."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from generator.cli import main
from generator.hyperparams import ConvolutionArguments
from generator.nominal import Nominal
from generator.seeds import CHECKPOINT, CONTROLLER, CURVE, try_seed
from generator.setups import parse_setup, setup_hyperparameters
from racecar.controller import load_controller, runtime_session, save_controller, to_model
from racecar.errors import BadInput

pytest.importorskip("torch")
pytest.importorskip("stable_baselines3")

CHUNK = 200
FINISHES = Nominal(safe_fraction=0.5, margin=-0.1, finishes_turn=True, smoothness=0.0)
#: Gradient steps begin inside the second chunk, an odd number of them before its end, so that
#: a training that went on would delay its policy updates by one if it forgot the count.
TINY = {
    "n_timesteps": 900,
    "learning_starts": 251,
    "batch_size": 16,
    "buffer_size": 500,  # the replay buffer wraps around
}


def tiny(setup, **changes):
    parameters = setup_hyperparameters(setup)
    smaller = {"critic": [16]} | ({"critic_rays": 5} if setup.rays > 61 else {})
    if setup.convolutional:
        sizes = ((2, 5, 3), (3, 4, 2))
        convolutions = [ConvolutionArguments(channels=a, kernel=b, stride=c) for a, b, c in sizes]
        smaller |= {"convolutions": convolutions, "hidden": [8]}
    networks = parameters.policy_kwargs.model_copy(update=smaller)
    return parameters.model_copy(update={"policy_kwargs": networks} | TINY | changes)


def model_bytes(controller):
    return to_model(controller).SerializeToString(deterministic=True)


def run_training(network, folder, stop_at=(), **changes):
    """Train in one go, or stopped at the given steps and begun again by a fresh call."""
    from generator.train import train

    setup = parse_setup(f"{network}_C1")
    parameters = tiny(setup, **changes)
    folder.mkdir(parents=True, exist_ok=True)
    for stop in stop_at:

        def interrupt(done, total, stop=stop):
            if done >= stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train(setup, 1, parameters, folder, interrupt, CHUNK)
    return train(setup, 1, parameters, folder, chunk=CHUNK)


def without_times(curve):
    return [{k: v for k, v in row.items() if k != "seconds"} for row in curve]


@pytest.mark.parametrize(
    "network", ["TD3_L5_8x8", "DDPG_L5_8x8", "TD3_L121_8x8x8x8relu", "TD3_L41_conv"]
)
def test_an_interrupted_training_ends_in_the_same_bytes(tmp_path, network):
    whole = run_training(network, tmp_path / "whole")
    # Stopped before the first gradient step, in the middle of a chunk (whose steps are lost
    # and done again), at a checkpoint's very step, and after the replay buffer wrapped.
    stopped = run_training(network, tmp_path / "stopped", stop_at=(200, 300, 400, 700))
    assert model_bytes(stopped.controller) == model_bytes(whole.controller)
    assert without_times(stopped.curve) == without_times(whole.curve)
    assert [row["timesteps"] for row in whole.curve] == [200, 400, 600, 800, 900]
    assert stopped.nominal == whole.nominal


def test_training_leaves_the_processors_arithmetic_as_it_was(tmp_path):
    """Bounds of rounding, on which proofs rely, hold for denormal numbers only if there are any."""
    smallest = np.array([5e-324])
    run_training("TD3_L5_8x8", tmp_path / "done", n_timesteps=CHUNK)
    assert (smallest * 1.0 > 0).all()
    run_training("TD3_L5_8x8", tmp_path / "stopped", (CHUNK + 1,), n_timesteps=2 * CHUNK)
    assert (smallest * 1.0 > 0).all()


def test_training_changes_the_network_only_once_it_learns(tmp_path):
    """The test above means something: gradient steps happen, and seeds matter."""
    first = run_training("TD3_L5_8x8", tmp_path / "a", n_timesteps=200).controller
    second = run_training("TD3_L5_8x8", tmp_path / "b", n_timesteps=240).controller
    learned = run_training("TD3_L5_8x8", tmp_path / "c").controller
    np.testing.assert_array_equal(first.layers[0].weights, second.layers[0].weights)
    assert np.abs(learned.layers[0].weights - first.layers[0].weights).max() > 1e-4


def test_another_process_gives_the_same_bytes(tmp_path):
    here = run_training("TD3_L5_8x8", tmp_path / "here", n_timesteps=400).controller
    code = (
        "import sys; from pathlib import Path; sys.path.insert(0, sys.argv[1])\n"
        "from test_train import run_training\n"
        "from racecar.controller import save_controller\n"
        "work = Path(sys.argv[2])\n"
        "controller = run_training('TD3_L5_8x8', work, n_timesteps=400).controller\n"
        "save_controller(controller, work / 'c.onnx')\n"
    )
    arguments = [sys.executable, "-c", code, str(Path(__file__).parent), str(tmp_path / "there")]
    subprocess.run(arguments, check=True, timeout=120)
    assert (tmp_path / "there" / "c.onnx").read_bytes() == model_bytes(here)


@pytest.mark.parametrize("name", ["TD3_L5_8x8_C1", "TD3_L121_16x8relu_C1", "TD3_L41_conv_C1"])
def test_the_file_drives_as_the_trained_actor(tmp_path, name):
    """Against onnxruntime, an evaluation that shares no code with the export."""
    import torch

    from generator.train import _make_model, export, export_error

    setup = parse_setup(name)
    model = _make_model(setup, tiny(setup), seed=3)
    controller = export(model, {})
    save_controller(controller, tmp_path / "c.onnx")
    scan = np.random.default_rng(1).uniform(0, 5, (1000, setup.rays)).astype(np.float32)
    (ours,) = runtime_session(tmp_path / "c.onnx").run(None, {"scan": scan})
    with torch.no_grad():
        actor = model.actor(torch.as_tensor(scan)).numpy()
    assert np.abs(ours - actor * np.float32(np.radians(15))).max() < 1e-6
    # What predict() returns is the action that the environment gets, in radians.
    action, _ = model.predict(scan, deterministic=True)
    assert np.abs(ours - action).max() < 1e-6
    assert export_error(model, controller) < 1e-6


def test_metadata_names_the_training_and_no_date(tmp_path):
    metadata = run_training("TD3_L5_8x8", tmp_path, n_timesteps=200).controller.metadata
    assert set(metadata) == {
        "algorithm",
        "gymnasium",
        "hyperparameters_sha256",
        "numpy",
        "seed",
        "setup",
        "stable-baselines3",
        "timesteps",
        "torch",
        "weights_sha256",
    }
    assert metadata["setup"] == "TD3_L5_8x8"
    assert metadata["seed"] == "1"
    assert metadata["timesteps"] == "200"


def test_a_checkpoint_of_another_training_or_a_broken_one_is_refused(tmp_path):
    run_training("TD3_L5_8x8", tmp_path, n_timesteps=200)
    with pytest.raises(BadInput, match="begun with other hyper-parameters"):
        run_training("TD3_L5_8x8", tmp_path, n_timesteps=400)
    checkpoint = tmp_path / CHECKPOINT
    checkpoint.write_bytes(checkpoint.read_bytes()[:1000])
    with pytest.raises(BadInput, match="not a checkpoint"):
        run_training("TD3_L5_8x8", tmp_path, n_timesteps=200)


def test_a_finished_checkpoint_goes_straight_to_export(tmp_path):
    from generator.train import train

    setup = parse_setup("TD3_L5_8x8_C1")
    parameters = tiny(setup, n_timesteps=400)
    run_training("TD3_L5_8x8", tmp_path, n_timesteps=400)
    steps = []

    def train_seed(setup, seed, parameters, folder):
        return train(setup, seed, parameters, folder, lambda done, total: steps.append(done))

    record = try_seed(setup, 1, parameters, tmp_path, train_seed)
    assert steps == []
    assert record.hyperparameters.n_timesteps == 400
    assert not (tmp_path / CHECKPOINT).exists()
    assert (tmp_path / CURVE).read_text().count("\n") == 3
    assert load_controller(tmp_path / CONTROLLER).rays == 5


def run(*arguments):
    return CliRunner().invoke(main, ["train", *(str(x) for x in arguments)])


def test_the_command_keeps_seeds_and_says_when_none_finishes(tmp_path):
    """400 random steps teach nothing: no seed finishes the turn."""
    options = ("--timesteps", 400, "--max-seeds", 2, "--work", tmp_path / "w", "--out", tmp_path)
    result = run("TD3_L5_8x8_C1", *options)
    assert result.exit_code == 1
    assert "2 seeds did not give 1 controllers" in result.stderr
    assert result.stdout.count("does not finish the turn") == 2
    assert sorted(x.name for x in (tmp_path / "w" / "TD3_L5_8x8").iterdir()) == ["seed_1", "seed_2"]
    assert list(tmp_path.glob("*.onnx")) == []


def test_the_command_writes_controller_curve_and_record(tmp_path, monkeypatch):
    import generator.train

    # Drive past the training: what is tested is the command.
    monkeypatch.setattr(generator.train, "drive_nominal", lambda controller, view: FINISHES)
    options = ("--timesteps", 300, "--work", tmp_path / "w", "--out", tmp_path / "out")
    result = run("TD3_L5_8x8_C2", *options, "--json")
    assert result.exit_code == 0, result.output
    record = json.loads(result.stdout)
    assert (record["name"], record["seed"], record["label"]) == ("TD3_L5_8x8_C2", 2, "unsafe")
    assert sorted(x.name for x in (tmp_path / "out").iterdir()) == [
        "TD3_L5_8x8_C2.curve.csv",
        "TD3_L5_8x8_C2.json",
        "TD3_L5_8x8_C2.onnx",
    ]
    again = run("TD3_L5_8x8_C2", *options)
    assert again.exit_code == 0
    assert "is seed 2, unsafe" in again.stdout


def test_bad_names_and_numbers_give_one_line(tmp_path):
    for arguments in (("PPO_L21_64x64_C1",), ("TD3_L5_8x8_C1", "--timesteps", "0")):
        result = run(*arguments, "--work", tmp_path / "w", "--out", tmp_path / "out")
        assert result.exit_code == 2
        assert result.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
