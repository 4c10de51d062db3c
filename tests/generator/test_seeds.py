"""Which seed becomes which controller, with a trainer that does not train."""

import fcntl
import json

import pytest

from generator.hyperparams import load_hyperparameters
from generator.nominal import Nominal
from generator.record import ControllerRecord, SeedRecord, load_record
from generator.seeds import Trained, file_sha256, find_controller, publish, published_seeds
from generator.setups import parse_setup
from racecar.controller import load_controller
from racecar.errors import BadInput

PARAMETERS = load_hyperparameters("TD3")


class Trainer:
    """Seeds 2, 4 and 5 finish the turn; 4 is safe."""

    def __init__(self, make_controller):
        self.make_controller = make_controller
        self.trained = []

    def __call__(self, setup, seed, parameters, folder):
        self.trained.append(seed)
        (folder / "checkpoint.pt").write_text("half-way")
        safe = 1.0 if seed == 4 else 0.5
        return Trained(
            self.make_controller(seed=seed),
            Nominal(safe, 0.1 if seed == 4 else -0.1, seed in (2, 4, 5), 0.01),
            [{"timesteps": 10, "seconds": 0.1}, {"timesteps": 20, "seconds": 0.2}],
            {"torch": "0"},
            1e-7,
        )


@pytest.fixture
def trainer(make_controller):
    return Trainer(make_controller)


def find(name, work, trainer, max_seeds=10, parameters=PARAMETERS):
    return find_controller(parse_setup(name), parameters, work, max_seeds, trainer)


@pytest.mark.parametrize(("index", "seed", "label"), [(1, 2, "unsafe"), (2, 4, "safe")])
def test_the_index_counts_seeds_that_finish_the_turn_safe_or_not(
    tmp_path, index, seed, label, trainer
):
    record, folder = find(f"TD3_L5_8_C{index}", tmp_path, trainer)
    assert (record.seed, record.label, record.name) == (seed, label, f"TD3_L5_8_C{index}")
    assert folder == tmp_path / "TD3_L5_8" / f"seed_{seed}"
    assert [(x.seed, x.finishes_turn) for x in record.tried] == [
        (x, x in (2, 4)) for x in range(1, seed + 1)
    ]


def test_what_a_seed_gave_is_kept_for_the_next_controller(tmp_path, trainer):
    find("TD3_L5_8_C1", tmp_path, trainer)
    record, _ = find("TD3_L5_8_C3", tmp_path, trainer)
    assert trainer.trained == [1, 2, 3, 4, 5]
    assert record.seed == 5
    find("TD3_L5_8x8_C1", tmp_path, trainer)
    assert trainer.trained == [1, 2, 3, 4, 5, 1, 2]  # another family trains its own
    seed = tmp_path / "TD3_L5_8" / "seed_4"
    assert sorted(x.name for x in seed.iterdir() if x.name[0] != ".") == [
        "controller.onnx",
        "curve.csv",
        "record.json",
    ]
    assert load_record(seed / "record.json", SeedRecord).sha256 == file_sha256(
        seed / "controller.onnx"
    )


def test_a_seed_that_stopped_half_way_keeps_its_checkpoint(tmp_path, trainer):

    def stop(setup, seed, parameters, folder):
        trainer(setup, seed, parameters, folder)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find("TD3_L5_8_C1", tmp_path, stop)
    assert (tmp_path / "TD3_L5_8" / "seed_1" / "checkpoint.pt").exists()
    assert find("TD3_L5_8_C1", tmp_path, trainer)[0].seed == 2


def test_seeds_may_run_out(tmp_path, trainer):
    assert find("TD3_L5_8_C2", tmp_path, trainer, max_seeds=3) is None


def test_publishing_writes_controller_curve_and_record(tmp_path, trainer):
    record, folder = find("TD3_L5_8_C2", tmp_path / "work", trainer)
    files = publish(record, folder, tmp_path / "out")
    assert [x.name for x in files] == [f"TD3_L5_8_C2.{x}" for x in ("onnx", "curve.csv", "json")]
    read = load_record(files[2], ControllerRecord)
    assert read == record
    assert read.sha256 == file_sha256(files[0])
    assert load_controller(files[0]).rays == 5
    assert files[1].read_text() == "timesteps,seconds\n10,0.1\n20,0.2\n"
    assert json.loads(files[2].read_text())["nominal"]["margin"] == 0.1
    before = [x.read_bytes() for x in files]
    publish(record, folder, tmp_path / "out")
    assert [x.read_bytes() for x in files] == before


def test_another_controller_of_the_same_name_is_not_overwritten(tmp_path, trainer):
    record, folder = find("TD3_L5_8_C1", tmp_path / "work", trainer)
    target = tmp_path / "out" / "TD3_L5_8_C1.onnx"
    target.parent.mkdir()
    target.write_text("mine")
    with pytest.raises(BadInput, match="another controller"):
        publish(record, folder, tmp_path / "out")
    assert [x.name for x in target.parent.iterdir()] == [target.name]
    assert target.read_text() == "mine"


def test_results_with_other_hyperparameters_are_not_mixed(tmp_path, trainer):
    find("TD3_L5_8_C1", tmp_path, trainer)
    with pytest.raises(BadInput, match="other hyper-parameters"):
        find(
            "TD3_L5_8_C1",
            tmp_path,
            trainer,
            parameters=PARAMETERS.model_copy(update={"n_timesteps": 7}),
        )


def test_a_result_that_was_changed_is_noticed(tmp_path, trainer):
    _, folder = find("TD3_L5_8_C1", tmp_path, trainer)
    (folder / "controller.onnx").write_bytes(b"")
    with pytest.raises(BadInput, match=r"controller\.onnx: it is not the one of its record"):
        find("TD3_L5_8_C1", tmp_path, trainer)


def test_a_folder_in_use_is_left_alone(tmp_path, trainer):
    folder = tmp_path / "TD3_L5_8" / "seed_1"
    folder.mkdir(parents=True)
    with (folder / ".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        with pytest.raises(BadInput, match="another process"):
            find("TD3_L5_8_C1", tmp_path, trainer)
    assert trainer.trained == []
    assert find("TD3_L5_8_C1", tmp_path, trainer) is not None


def find_published(name, work, trainer, out, parameters=PARAMETERS):
    """What the command does; the trainer's library is as if installed."""
    setup = parse_setup(name)
    known = published_seeds(setup, parameters, out)
    return find_controller(setup, parameters, work, 10, trainer, known=known)


def test_what_published_controllers_tried_is_not_trained_again(tmp_path, trainer, monkeypatch):
    monkeypatch.setattr("generator.seeds.version", {"torch": "0"}.__getitem__)
    publish(*find("TD3_L5_8_C1", tmp_path / "work", trainer), tmp_path / "out")
    trainer.trained.clear()
    record, folder = find_published("TD3_L5_8_C2", tmp_path / "empty", trainer, tmp_path / "out")
    assert trainer.trained == [3, 4]
    assert (record, folder.name) == (find("TD3_L5_8_C2", tmp_path / "work", trainer)[0], "seed_4")
    publish(record, folder, tmp_path / "out")
    # The same controller again is trained: only so can its files be made.
    trainer.trained.clear()
    assert find_published("TD3_L5_8_C2", tmp_path / "new", trainer, tmp_path / "out")[0] == record
    assert trainer.trained == [4]


def test_published_results_of_other_trainings_do_not_count(tmp_path, trainer, monkeypatch):
    publish(*find("TD3_L5_8_C1", tmp_path / "work", trainer), tmp_path / "out")

    def known(parameters=PARAMETERS, family="TD3_L5_8"):
        return sorted(published_seeds(parse_setup(f"{family}_C2"), parameters, tmp_path / "out"))

    assert known() == []  # torch 0 is not what is installed
    monkeypatch.setattr("generator.seeds.version", {"torch": "0"}.__getitem__)
    assert known() == [1, 2]
    assert known(PARAMETERS.model_copy(update={"gamma": 0.9})) == []
    assert known(family="TD3_L5_8x8") == []
    (tmp_path / "out" / "TD3_L5_8_C1.json").write_text("{}")
    with pytest.raises(BadInput, match=r"TD3_L5_8_C1\.json"):
        known()
