import math
from importlib.resources import files

import pytest

from generator.hyperparams import load_hyperparameters
from generator.setups import parse_setup, setup_hyperparameters
from racecar.errors import BadInput


@pytest.mark.parametrize(
    "name",
    ["TD3_L21_64x64_C1", "DDPG_L1081_128x128_C12", "TD3_L5_8_C1",
     "TD3_L21_64x64x64x64_C1", "TD3_L21_128x128relu_C2", "TD3_L1081_conv_C1",
     "EARLY_L21_64x64_C2"],
)  # fmt: skip
def test_names_read_and_print_alike(name):
    setup = parse_setup(name)
    assert setup.name == name
    assert setup.family == name.rpartition("_")[0]


def test_a_name_says_how_to_train():
    setup = parse_setup("DDPG_L41_64x32x16_C3")
    assert (setup.algorithm, setup.rays, setup.hidden, setup.index) == ("DDPG", 41, (64, 32, 16), 3)


def test_a_full_scan_covers_270_degrees_and_the_others_230():
    for name, degrees in (
        ("TD3_L1081_64x64_C1", 270), ("TD3_L61_64x64_C1", 230), ("TD3_L121_64x64_C1", 230),
        ("TD3_L271_64x64_C1", 230), ("TD3_L1081_conv_C1", 270),
    ):  # fmt: skip
        assert math.degrees(parse_setup(name).field_of_view) == pytest.approx(degrees, abs=1e-12)


@pytest.mark.parametrize(
    "name",
    ["", "TD3", "PPO_L21_64x64_C1", "TD3_L1_64x64_C1", "TD3_L21_0x64_C1", "TD3_L21_64x64_C0",
     "TD3_L21_64x64", "TD3_L21_64x64_C1 ", "td3_L21_64x64_C1", "TD3_L21_64x_C1",
     "TD3_L21_relu_C1", "TD3_L21_64x64tanh_C1", "TD3_L21_conv64_C1", "TD3_L21_convrelu_C1",
     "ROBUST_L21_64x64relu_C1", "SMOOTH_L1081_conv_C1"],
)  # fmt: skip
def test_other_names_are_refused(name):
    with pytest.raises(BadInput):
        parse_setup(name)


@pytest.mark.parametrize(
    ("algorithm", "field"),
    [("DDPG", "gamma"), ("TD3", "gamma"), ("ROBUST", "rounds"), ("SMOOTH", "rounds")],
)
def test_hyperparameters_hash_alike_only_if_equal(algorithm, field):
    parameters = load_hyperparameters(algorithm)
    assert parameters.sha256() == load_hyperparameters(algorithm).sha256()
    assert parameters.sha256() != parameters.model_copy(update={field: 3}).sha256()


@pytest.mark.parametrize("algorithm", ["DDPG", "TD3"])
def test_reinforcement_learning_has_the_papers_budget(algorithm):
    parameters = load_hyperparameters(algorithm)
    assert parameters.n_timesteps == 100_000
    assert parameters.rate() == (1e-3, True)


def test_each_kind_of_network_has_its_hyperparameters(tmp_path):
    def said(name, own=None):
        return setup_hyperparameters(parse_setup(name), own)

    assert said("TD3_L61_64x64_C1") == load_hyperparameters("TD3")
    assert said("TD3_L21_256x256_C1") == load_hyperparameters("TD3")
    assert said("ROBUST_L1081_64x64_C1") == load_hyperparameters("ROBUST")
    assert said("TD3_L21_64x64relu_C1").policy_kwargs.activation == "relu"
    for rays in (121, 271, 1081):
        assert said(f"TD3_L{rays}_64x64_C1").policy_kwargs.critic_rays == 121
    early, whole = said("EARLY_L21_64x64_C1"), said("TD3_L21_64x64_C1")
    assert early.n_timesteps < whole.n_timesteps / 2
    with pytest.raises(BadInput, match=r"ddpg_relu\.yml do not exist; write a file"):
        said("DDPG_L21_64x64relu_C1")
    convolutional = said("TD3_L1081_conv_C1").policy_kwargs
    assert (len(convolutional.convolutions), convolutional.hidden) == (2, [64])
    own = tmp_path / "own.yml"
    own.write_text(files("generator.hyperparams").joinpath("td3.yml").read_text())
    assert said("TD3_L1081_64x64_C1", own) == load_hyperparameters("TD3")
    with pytest.raises(BadInput, match=r"activation is tanh, but the name .* says relu"):
        said("TD3_L21_64x64relu_C1", own)
    with pytest.raises(BadInput, match="convolutional setups; give it for"):
        said("TD3_L1081_conv_C1", own)
    own.write_text(files("generator.hyperparams").joinpath("td3_conv.yml").read_text())
    with pytest.raises(BadInput, match="convolutional setups; leave it out"):
        said("TD3_L1081_64x64_C1", own)
