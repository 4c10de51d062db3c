"""Robust training: real, of tiny networks for a few rounds."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from click.testing import CliRunner

from generator.cli import main
from generator.hyperparams import ENVIRONMENT, load_hyperparameters
from generator.instances import benchmark_plant
from generator.robust.mine import worst_sets
from generator.robust.spoil import draw_spoil
from generator.robust.teacher import Teacher
from generator.seeds import CHECKPOINT
from generator.setups import parse_setup
from racecar.closed_loop import State, simulate
from racecar.controller import load_controller, runtime_session, save_controller, to_model
from racecar.errors import BadInput
from racecar.faults import GivenFaults
from racecar.raysets import all_sets, drawn_sets, least_margins
from racecar.safety import named_property

torch = pytest.importorskip("torch")

ONNX = Path(__file__).parents[2] / "onnx"
TINY = {"rounds": 3, "cars": 20, "steps": 12, "gradient_steps": 8, "batch_size": 16}
SETUP = parse_setup("ROBUST_L5_8x8_C1")
PLANT = benchmark_plant(5, math.radians(230))


def tiny(**changes):
    faults = changes.pop("faults", {})
    parameters = load_hyperparameters("ROBUST").model_copy(update=TINY | changes)
    return parameters.model_copy(
        update={"faults": parameters.faults.model_copy(update={"missing": 2} | faults)}
    )


def run_training(folder, parameters, stop_at=(), seed=1):
    """Train in one go, or stopped after the given rounds and begun again."""
    from generator.robust.train import train

    folder.mkdir(parents=True, exist_ok=True)
    for stop in stop_at:

        def interrupt(done, total, stop=stop):
            if done >= stop:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            train(SETUP, seed, parameters, folder, interrupt, chunk=1)
    return train(SETUP, seed, parameters, folder, chunk=1)


def model_bytes(trained):
    return to_model(trained.controller).SerializeToString(deterministic=True)


@pytest.mark.parametrize("mined", [0.0, 0.5])
def test_an_interrupted_training_ends_in_the_same_bytes(tmp_path, mined, monkeypatch):
    import generator.robust.train

    monkeypatch.setattr(generator.robust.train, "CURVE_RUNS", 8)
    parameters = tiny(teacher_rounds=1, faults={"mined": mined, "curriculum_rounds": 2})
    whole = run_training(tmp_path / "whole", parameters)
    stopped = run_training(tmp_path / "stopped", parameters, stop_at=(1, 2))
    assert model_bytes(stopped) == model_bytes(whole)
    rows = [
        [{k: v for k, v in r.items() if k != "seconds"} for r in x.curve] for x in (whole, stopped)
    ]
    assert rows[0] == rows[1]
    assert [row["rounds"] for row in whole.curve] == [1, 2, 3]
    other = run_training(tmp_path / "other", parameters, seed=2)
    assert model_bytes(other) != model_bytes(whole)


def test_a_checkpoint_of_another_training_or_a_broken_one_is_refused(tmp_path):
    run_training(tmp_path, tiny(rounds=1))
    with pytest.raises(BadInput, match="begun with other hyper-parameters"):
        run_training(tmp_path, tiny(rounds=1, gain_penalty=0.5))
    (tmp_path / CHECKPOINT).write_bytes(b"PK")
    with pytest.raises(BadInput, match="not a checkpoint"):
        run_training(tmp_path, tiny(rounds=1))


def test_the_student_learns_to_answer_like_the_teacher():
    """Its squared error falls far below that of steering straight on."""
    from generator.robust.dagger import Dagger

    parameters = tiny(rounds=6, cars=40, steps=50, gradient_steps=60, batch_size=64)
    dagger = Dagger(PLANT, (8, 8), parameters, seed=1)
    errors = [dagger.round()[0] for _ in range(parameters.rounds)]
    _, answers = dagger.seen[-1]
    assert errors[-1] < 0.5 * float((answers**2).mean())


def test_the_gain_is_the_l1_norm_of_the_gradient():
    from generator.robust.student import Student

    student = Student(5, (8, 8))
    scan = (5 * torch.rand(20, 5)).requires_grad_()
    steering, gain = student.with_gain(scan)
    (gradient,) = torch.autograd.grad(student(scan).sum(), scan)
    torch.testing.assert_close(steering, student(scan))
    torch.testing.assert_close(gain, gradient.abs().sum(dim=1))


def test_the_file_drives_as_the_student(tmp_path):
    from generator.robust.student import Student

    student = Student(5, (8, 8))
    save_controller(student.controller({}), tmp_path / "c.onnx")
    scan = (5 * torch.rand(500, 5)).to(torch.float32)
    (ours,) = runtime_session(tmp_path / "c.onnx").run(None, {"scan": scan.numpy()})
    with torch.no_grad():
        answers = student(scan).numpy() * np.float32(np.radians(15))
    assert np.abs(ours[:, 0] - answers).max() < 1e-6


def test_faults_in_training_are_those_of_the_file():
    faults = load_hyperparameters("ROBUST").faults.model_copy(update={"jitter": 0.0, "missing": 3})
    plant = benchmark_plant(21, math.radians(230))
    none = np.zeros((21, 0), dtype=bool)
    spoil = draw_spoil(plant, faults, 4000, 1.0, none, np.random.default_rng(0))
    counts = spoil.gone.sum(axis=0)
    assert counts.max() == 3
    # Half of the drives draw 3 rays, the others 0 to 3 alike: 0 in one of eight.
    assert np.mean(counts == 0) == pytest.approx(1 / 8, abs=4 * math.sqrt(7 / 64 / 4000))
    state = State.start(np.full(4000, 0.75), 1.0)
    scan = np.full((21, 4000), 2.0)
    faulty = spoil(0, state, scan)
    assert (faulty[spoil.gone] == 5.0).all()
    added = (faulty - scan)[~spoil.gone]
    assert 0 <= added.min() <= added.max() <= faults.noise
    far = spoil(0, State.start(np.full(4000, 0.75), 9.0), scan)
    assert far.max() <= 2.0 + faults.noise
    half = draw_spoil(plant, faults, 1000, 0.34, none, np.random.default_rng(0))
    assert half.gone.sum(axis=0).max() == 1


def test_the_adversary_finds_the_sets_that_hurt():
    assert all_sets(21, 2).shape == (21, 210)
    assert (all_sets(6, 2).sum(axis=0) == 2).all()
    assert len(np.unique(all_sets(6, 2), axis=1).T) == 15
    assert (drawn_sets(21, 6, 50, np.random.default_rng(0)).sum(axis=0) <= 6).all()

    plant = benchmark_plant(21, math.radians(230))
    steer = load_controller(ONNX / "TD3_L21_64x64_C1.onnx").steering_rows
    singles = all_sets(21, 1)
    margins = least_margins(plant, steer, singles)
    assert margins.min() < 0 < margins.max()
    # One of them simulated by itself, from the middle start alone.
    worst = int(np.argmin(least_margins(plant, steer, singles, starts=(0.75,))))
    gone = np.arange(21)[:, None] == worst
    runs = simulate(
        plant,
        steer,
        named_property("clearance", plant.track),
        State.start([0.75]),
        70,
        GivenFaults(1.5, 5.0, gone),
    )
    assert runs.margin[0] == pytest.approx(least_margins(plant, steer, gone, (0.75,))[0])
    found = worst_sets(plant, steer, 1, np.random.default_rng(0), drawn=5, kept=3)
    assert set(np.flatnonzero(found.any(axis=1))) == set(np.argsort(margins)[:3])


def test_the_command_trains_and_says_how_the_budget_is_set(tmp_path, monkeypatch):
    import generator.robust.train
    from generator.nominal import Nominal

    monkeypatch.setattr(
        generator.robust.train, "drive_nominal", lambda *_: Nominal(0.5, -0.1, True, 0.0)
    )
    file = tmp_path / "own.yml"
    file.write_text(yaml.safe_dump({ENVIRONMENT: tiny(rounds=1).model_dump()}))
    options = ["--work", str(tmp_path / "w"), "--out", str(tmp_path / "out")]
    arguments = ["train", SETUP.name, "--hyperparameters", str(file), "--json", *options]
    result = CliRunner().invoke(main, arguments)
    assert result.exit_code == 0, result.output
    record = json.loads(result.stdout)
    assert (record["name"], record["hyperparameters"]["rounds"]) == (SETUP.name, 1)
    refused = CliRunner().invoke(main, ["train", SETUP.name, "--timesteps", "9", *options])
    assert refused.exit_code == 2
    file.write_text(yaml.safe_dump({ENVIRONMENT: tiny().model_dump() | {"rounds": 0}}))
    refused = CliRunner().invoke(main, arguments)
    assert refused.exit_code == 2
    assert "rounds" in refused.stderr


def test_the_packages_own_file_has_a_teacher_of_its_kind():
    assert Teacher(**load_hyperparameters("ROBUST").teacher.model_dump()).lane == 0.5
