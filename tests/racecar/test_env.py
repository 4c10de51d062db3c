"""The Gymnasium environments: Gymnasium's own checks, seeds, rewards, ends of episodes."""

from __future__ import annotations

import math
import subprocess
import sys
import warnings
from itertools import pairwise

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from racecar.env import EPISODE_STEPS, MAX_STEERING, HallwayEnv, HallwayVectorEnv
from racecar.errors import BadInput
from racecar.faultmodels.named import fault_names
from racecar.faults import Faults
from racecar.track import Hall, Track, square_track, track_from_turns

NAME = "racecar.env:racecar/Hallway-v0"
STRAIGHT = np.zeros(1, dtype=np.float32)


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"rays": 41, "faults": "paper", "slip": True},
        {"faults": "none", "track": track_from_turns(["left"], length=12.0)},
    ],
)
def test_gymnasiums_checker_has_nothing_to_say(options):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(NAME, disable_env_checker=True, **options).unwrapped)


def test_a_fresh_process_finds_the_environment_by_its_name():
    code = f"""
import gymnasium
env = gymnasium.make({NAME!r}, rays=5)
print(env.reset(seed=1)[0].shape, gymnasium.make_vec({NAME!r}, num_envs=3).reset()[0].shape)
"""
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout.split("\n")[0] == "(5,) (3, 21)"


def test_spaces_are_metres_and_radians():
    env = HallwayEnv(rays=61)
    assert env.observation_space == gymnasium.spaces.Box(0, 5, (61,), np.float32)
    low, high = env.action_space.low, env.action_space.high
    assert np.degrees([low[0], high[0]]) == pytest.approx([-15, 15])


def episode(env: gymnasium.Env, seed: int) -> list[np.ndarray]:
    actions = np.random.default_rng(seed).uniform(-0.1, 0.1, (40, 1)).astype(np.float32)
    seen = [env.reset(seed=seed)[0]]
    for action in actions:
        scan, reward, terminated, truncated, info = env.step(action)
        assert scan in env.observation_space
        seen += [scan, np.array([reward, terminated, truncated, *info.values()])]
        if terminated:
            break
    return seen


@pytest.mark.parametrize("faults", ["noise", "paper", "none"])
def test_a_seed_gives_the_same_episode_again(faults):
    env = gymnasium.make(NAME, faults=faults)
    one, again, other = (
        episode(env, 3),
        episode(gymnasium.make(NAME, faults=faults), 3),
        episode(env, 4),
    )
    assert len(one) == len(again)
    assert all((a == b).all() for a, b in zip(one, again, strict=True))
    assert not (one[0] == other[0]).all()


def test_starts_are_the_papers():
    """s0 = 0.75 +- 0.2, theta0 = +-0.3, f0 = 10, at rest: all of the range, nothing outside."""
    env = HallwayVectorEnv(2000)
    env.reset(seed=0)
    state = env._state
    assert state is not None
    assert (state.f == 10).all()
    assert (state.v == 0).all()
    assert (state.frame == 0).all()
    for values, low, high in ((state.s, 0.55, 0.95), (state.theta, -0.3, 0.3)):
        assert low <= values.min() < low + 0.01 * (high - low)
        assert high - 0.01 * (high - low) < values.max() <= high


def test_training_noise_is_up_to_a_tenth_of_a_metre():
    start = {"s": 0.75, "f": 10.0, "theta": 0.0}
    clean, _ = HallwayEnv(faults="none").reset(seed=0, options=start)
    env = HallwayEnv()
    added = np.array([env.reset(options=start)[0] - clean for _ in range(500)])
    seen = clean < 4.9
    assert added[:, seen].min() >= -1e-6
    assert added[:, seen].max() <= 0.1 + 1e-6
    assert added[:, seen].mean() == pytest.approx(0.05, abs=0.002)
    assert (added[:, clean == 5] == 0).all()


@pytest.mark.parametrize(
    ("f", "degrees", "expected"),
    [(9.0, 0, 10.0), (9.0, 10, 5.0), (9.0, -15, 10 - 0.05 * 225), (1.6, 10, 5.0), (1.4, 10, 10.0)],
)
def test_reward_is_the_papers(f, degrees, expected):
    """10 - 0.05 delta^2 with delta in degrees; in the turn (f <= W) the steering is free."""
    env = HallwayEnv(faults="none")
    env.reset(options={"s": 0.75, "f": f, "theta": 0.0})
    _, reward, terminated, _, _ = env.step(np.array([math.radians(degrees)]))
    assert not terminated
    assert reward == pytest.approx(expected, abs=1e-9)


def test_a_crash_costs_100_and_ends_the_episode():
    env = HallwayEnv(faults="none")
    _, info = env.reset(options={"f": 1.2, "v": 2.4})
    total = []
    for _ in range(10):
        _, reward, terminated, truncated, info = env.step(STRAIGHT)
        assert not truncated
        total.append(reward)
        if terminated:
            break
    assert info["f"] <= 0.3
    assert total[-1] == -100
    assert set(total[:-1]) == {10.0}


def test_steering_beyond_the_limit_is_clipped():
    ends = []
    for action in (MAX_STEERING, 5.0):
        env = HallwayEnv(faults="none")
        env.reset(options={"s": 0.7, "v": 2.0, "theta": 0.0})
        ends.append(env.step(np.array([action]))[4])
    assert ends[0] == pytest.approx(ends[1], abs=1e-12)


def follow_space(scan: np.ndarray) -> np.ndarray:
    left, right = scan[..., 13:18].sum(axis=-1), scan[..., 3:8].sum(axis=-1)
    return (MAX_STEERING * np.tanh(0.4 * (left - right)))[..., None].astype(np.float32)


def test_episodes_are_truncated_after_130_steps():
    env = gymnasium.make(NAME)
    scan, _ = env.reset(seed=0)
    for step in range(1, EPISODE_STEPS + 1):
        scan, _, terminated, truncated, _ = env.step(follow_space(scan))
        assert not terminated
        assert truncated == (step == EPISODE_STEPS == 130) or (step < 130 and not truncated)
    assert truncated


def test_a_vector_agrees_step_by_step_with_single_environments():
    """Same starts, same actions, no noise: same scans, rewards and ends, until all are over."""
    count = 12
    random = np.random.default_rng(0)
    s, theta = random.uniform(0.5, 1.0, count), random.uniform(-0.3, 0.3, count)
    vector = gymnasium.make_vec(NAME, num_envs=count, faults="none")
    singles = [gymnasium.make(NAME, faults="none") for _ in range(count)]
    scans, _ = vector.reset(seed=0, options={"s": s, "theta": theta})
    for i, env in enumerate(singles):
        single, _ = env.reset(options={"s": s[i], "theta": theta[i]})
        assert scans[i] == pytest.approx(single, abs=1e-6)
    over = np.zeros(count, dtype=bool)
    for _ in range(EPISODE_STEPS):
        actions = follow_space(scans) * random.choice([1.0, 0.8], (count, 1)).astype(np.float32)
        actions[0], actions[1] = 0.1, -0.1  # these two crash
        scans, rewards, terminated, truncated, _ = vector.step(actions)
        for i in np.flatnonzero(~over):
            single, reward, end, cut, _ = singles[i].step(actions[i])
            assert scans[i] == pytest.approx(single, abs=1e-5)
            assert rewards[i] == pytest.approx(reward, abs=1e-6)
            assert (terminated[i], truncated[i]) == (end, cut)
        over |= terminated | truncated
    assert over.all()
    assert terminated.sum() < count


def test_a_vector_starts_ended_runs_anew_at_the_next_step():
    env = HallwayVectorEnv(3, faults="none", max_episode_steps=4)
    assert env.metadata["autoreset_mode"] == AutoresetMode.NEXT_STEP
    env.reset(seed=0, options={"f": [10.0, 0.4, 10.0], "v": [0.0, 2.0, 0.0]})
    actions = np.zeros((3, 1), dtype=np.float32)
    _, rewards, terminated, truncated, _ = env.step(actions)
    assert terminated.tolist() == [False, True, False]
    assert not truncated.any()
    assert rewards.tolist() == [10, -100, 10]
    scans, rewards, terminated, truncated, _ = env.step(actions)  # run 1 is reset now
    assert rewards.tolist() == [10, 0, 10]
    assert not terminated.any()
    assert not truncated.any()
    assert env._state is not None
    assert env._state.f[1] == 10
    single = env._cars.plant.scan_rows(env._state.take(slice(1, 2)))[:, 0]
    assert scans[1] == pytest.approx(single, abs=1e-6)
    env.step(actions)
    *_, truncated, _ = env.step(actions)  # four steps for runs 0 and 2, two for run 1
    assert truncated.tolist() == [True, False, True]
    *_, truncated, _ = env.step(actions)
    assert not truncated.any()
    *_, truncated, _ = env.step(actions)
    assert truncated.tolist() == [False, True, False]


def test_a_vector_has_gymnasiums_own_interface():
    ours = gymnasium.make_vec(NAME, num_envs=4)
    theirs = SyncVectorEnv([lambda: gymnasium.make(NAME)] * 4)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.reset(seed=0)[0] in ours.observation_space
    for one, other in zip(ours.step(ours.action_space.sample()), theirs_step(theirs), strict=True):
        if isinstance(one, np.ndarray):
            assert (one.shape, one.dtype) == (other.shape, other.dtype)


def theirs_step(env: SyncVectorEnv) -> tuple:
    env.reset(seed=0)
    return env.step(env.action_space.sample())


@pytest.mark.parametrize("seed", [5, [5, 6, 7]])
def test_a_seed_gives_the_same_vector_episode_again(seed):
    seen = []
    for _ in range(2):
        env = HallwayVectorEnv(3, faults="paper", max_episode_steps=5)
        scans = [env.reset(seed=seed)[0]]
        scans += [env.step(np.full((3, 1), 0.02, np.float32))[0] for _ in range(20)]
        seen.append(np.array(scans))
    assert (seen[0] == seen[1]).all()
    other = HallwayVectorEnv(3, faults="paper").reset(seed=[5, 6, 8])[0]
    assert not (seen[0][0] == other).all()


def test_each_run_of_a_vector_has_its_own_missing_rays():
    env = HallwayVectorEnv(50, faults=Faults(missing=5, turn_only=False), max_episode_steps=1)
    actions = np.zeros((50, 1), dtype=np.float32)
    scans, _ = env.reset(seed=0)
    patterns = {tuple(np.flatnonzero(scan[:9] == 5)) for scan in scans}
    assert len(patterns) > 10
    before = env._faults.gone.copy()
    env.step(actions)
    assert (env._faults.gone == before).all()
    env.step(actions)  # all start anew
    assert not (env._faults.gone == before).all()


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: HallwayEnv(faults="fog"), "faults 'fog' are unknown; choose from none, paper"),
        (lambda: HallwayEnv(render_mode="human"), "does not render"),
        (lambda: HallwayVectorEnv(2, render_mode="human"), "does not render"),
        (lambda: HallwayEnv(rays=1), "lidar: 1 rays"),
        (lambda: HallwayEnv(track=square_track(9.0)), "no room"),
        (lambda: HallwayEnv(track=Track(0.9, (Hall(20.0, None),), False)), "no room"),
        (lambda: HallwayEnv().reset(options={"x": 1}), r"options \['x'\] are unknown"),
        (lambda: HallwayEnv().reset(options={"s": 0.2}), "within 0.3 m of a wall"),
        (lambda: HallwayEnv().reset(options={"s": math.nan}), "within 0.3 m of a wall"),
        (lambda: HallwayEnv().reset(options={"v": -1.0}), "v must be 0 or more"),
        (lambda: HallwayEnv().reset(options={"theta": math.inf}), "theta a number"),
        (lambda: HallwayEnv().reset(options={"s": [0.7, 0.8]}), "must be numbers"),
        (lambda: HallwayEnv().reset(options={"s": "middle"}), "must be numbers"),
        (lambda: HallwayVectorEnv(3).reset(options={"s": [0.7, 0.8]}), "arrays of 3"),
    ],
)
def test_wrong_use_is_refused(make, message):
    with pytest.raises(BadInput, match=message):
        make()


@pytest.mark.parametrize("env", [HallwayEnv(), HallwayVectorEnv(1)])
def test_a_step_before_reset_is_refused(env):
    with pytest.raises(gymnasium.error.ResetNeeded):
        env.step(np.zeros((1, 1), dtype=np.float32))


def test_starts_are_in_the_middle_of_any_track():
    track = Track(2.0, (Hall(30.0, "left"), Hall(12.0, None)), False)
    env = HallwayEnv(track=track)
    infos = [env.reset(seed=seed)[1] for seed in range(50)]
    s = [info["s"] for info in infos]
    assert min(s) >= 0.8
    assert max(s) <= 1.2


# --- Fault models by name ----------------------------------------------------------------


@pytest.mark.parametrize("name", fault_names())
def test_every_fault_model_has_an_environment(name):
    env = gymnasium.make(f"racecar.env:racecar/Hallway-{name}-v0")
    first = env.reset(seed=4)[0]
    assert first in env.observation_space
    rest = [env.step(STRAIGHT)[0] for _ in range(3)]
    assert (env.reset(seed=4)[0] == first).all()
    assert all((env.step(STRAIGHT)[0] == x).all() for x in rest)


def test_gymnasiums_checker_has_nothing_to_say_about_faults():
    name = "racecar.env:racecar/Hallway-mixture-v0"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(gymnasium.make(name, disable_env_checker=True).unwrapped)


def test_noise_changes_from_step_to_step_and_from_run_to_run():
    env = HallwayVectorEnv(2, faults="bounded_noise", max_episode_steps=2)
    clean = HallwayVectorEnv(2, faults="none", max_episode_steps=2)
    start = {"s": 0.75, "f": 10.0, "theta": 0.0}
    actions = np.zeros((2, 1), dtype=np.float32)
    noise = [env.reset(seed=1, options=start)[0] - clean.reset(options=start)[0]]
    noise += [env.step(actions)[0] - clean.step(actions)[0] for _ in range(2)]
    seen = np.abs(noise[0]) > 0
    assert (np.abs(noise[0][0] - noise[0][1])[seen[0] & seen[1]] > 0).all()
    assert all(np.abs(a - b)[0].max() > 1e-3 for a, b in pairwise(noise))
    before = env._faults.runs.copy()
    env.step(actions)  # both were over and start anew
    assert (env._faults.runs != before).all()
