"""Gymnasium environments: ``racecar/Hallway-v0``.

Importing this module registers them; ``gymnasium.make("racecar.env:racecar/Hallway-v0")``
imports it by itself.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.errors import BadInput
from racecar.faultmodels.draw import SpecFaults, spec_faults
from racecar.faultmodels.find import find_faults
from racecar.faultmodels.named import fault_names
from racecar.faultmodels.spec import FaultSpec
from racecar.faults import DrawnFaults, Faults
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import Track, square_track

MAX_STEERING = math.radians(15)
EPISODE_STEPS = 130
START_SPREAD, START_HEADING, START_AHEAD = 0.2, 0.3, 10.0
STEP_REWARD, STEERING_COST, CRASH_REWARD = 10.0, 0.05, -100.0


AnyFaults = DrawnFaults | SpecFaults


def renewed(faults: AnyFaults, which: NDArray[np.bool_], fresh: AnyFaults) -> AnyFaults:
    """Return the faults with those of the cars ``which`` (mask) replaced by fresh ones."""
    if isinstance(faults, SpecFaults) and isinstance(fresh, SpecFaults):
        return faults.renewed(which, fresh)
    assert isinstance(faults, DrawnFaults)
    assert isinstance(fresh, DrawnFaults)
    return faults.renewed(which, fresh)


class _Cars:
    """A batch of cars in training: starts, faults, rewards, ends of episodes."""

    def __init__(
        self,
        rays: int,
        field_of_view: float,
        faults: str | Faults | FaultSpec,
        slip: bool,
        track: Track | None,
    ) -> None:
        if isinstance(faults, str):
            faults = find_faults(faults)
        self.faults = faults
        lidar = Lidar(rays, field_of_view)
        self.plant = Plant(track or square_track(), Bicycle(slip=slip), lidar)
        self.safety = named_property("clearance", self.plant.track)
        self.scan_space = spaces.Box(0.0, lidar.range, (rays,), np.float32)
        self.steering_space = spaces.Box(-MAX_STEERING, MAX_STEERING, (1,), np.float32)
        self.centre = self.plant.track.width / 2
        extremes = State.start(
            [self.centre - START_SPREAD, self.centre + START_SPREAD], START_AHEAD
        )
        if not (self.plant.margin(self.safety, extremes) > 0).all():
            raise BadInput(
                f"track: cars start {START_AHEAD} m before the first front wall, up to "
                f"{START_SPREAD} m off the middle; there is no room for that"
            )

    def start(
        self, count: int, random: np.random.Generator, options: dict[str, Any] | None = None
    ) -> tuple[State, AnyFaults]:
        """Draw starts and the faults of the runs; options set some of the state instead."""
        drawn = {
            "s": self.centre + random.uniform(-START_SPREAD, START_SPREAD, count),
            "f": START_AHEAD,
            "v": 0.0,
            "theta": random.uniform(-START_HEADING, START_HEADING, count),
        }
        unknown = set(options or {}) - set(drawn)
        if unknown:
            raise BadInput(f"reset: options {sorted(unknown)} are unknown; use {sorted(drawn)}")
        try:
            given = {
                name: np.broadcast_to(np.asarray(value, dtype=float), (count,))
                for name, value in (drawn | (options or {})).items()
            }
        except (TypeError, ValueError):
            raise BadInput(f"reset: options must be numbers, or arrays of {count}") from None
        state = State.start(**given)
        if not (self.plant.margin(self.safety, state) > 0).all():
            raise BadInput("reset: a start is within 0.3 m of a wall; move s and f")
        if not ((state.v >= 0) & np.isfinite(state.v) & np.isfinite(state.theta)).all():
            raise BadInput("reset: v must be 0 or more, theta a number")
        if isinstance(self.faults, FaultSpec):
            # Numbers of runs that no other episode has had.
            numbers = random.integers(2**63, size=count)
            return state, spec_faults(self.faults, self.plant, numbers, seed=0)
        track, lidar = self.plant.track, self.plant.lidar
        return state, self.faults.draw(lidar.rays, count, track.width, lidar.range, random)

    def observe(
        self, steps: NDArray[np.intp], state: State, faults: AnyFaults
    ) -> NDArray[np.float32]:
        """Return disturbed scans, ``[cars, rays]``; steps: done in each episode, ``[cars]``."""
        return faults(steps, state, self.plant.scan_rows(state)).T.astype(np.float32)

    def step(
        self, state: State, action: NDArray
    ) -> tuple[State, NDArray[np.float64], NDArray[np.bool_]]:
        """Drive one control period: next state, reward and crash of each car."""
        action = np.asarray(action, dtype=float).reshape(len(state))
        steering = np.minimum(np.maximum(action, -MAX_STEERING), MAX_STEERING)
        after, _ = self.plant.drive(state, steering)
        crashed = ~(self.plant.margin(self.safety, after) > 0)
        turning = state.f <= self.plant.track.width
        cost = np.where(turning, 0.0, STEERING_COST * np.degrees(steering) ** 2)
        reward = np.where(crashed, CRASH_REWARD, STEP_REWARD - cost)
        return self.plant.advance(after), reward, crashed


class HallwayEnv(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Drive the F1/10 car around hallways by LiDAR (Ivanov et al., HSCC 2020).

    ## Description
    The car drives at constant throttle (top speed 2.4 m/s) through hallways 1.5 m wide
    with 90-degree turns. The agent reads a LiDAR scan ten times a second and steers.

    ## Action Space
    ``Box(-0.2618, 0.2618, (1,), float32)``: the steering angle in radians (15 degrees to
    either side, left positive), held for 0.1 s.

    ## Observation Space
    ``Box(0, 5, (rays,), float32)``:

    | index    | observation                                  | min | max | unit |
    |----------|----------------------------------------------|-----|-----|------|
    | 0        | distance along the rightmost ray             | 0   | 5   | m    |
    | i        | ray at -fov/2 + i fov/(rays - 1)             | 0   | 5   | m    |
    | rays - 1 | distance along the leftmost ray              | 0   | 5   | m    |

    ## Rewards
    10 per step, less 0.05 times the square of the steering angle in degrees where the car
    is not in a turn (f > W when the steering is chosen); -100 for a crash.

    ## Starting State
    10 m before the front wall at rest; 0.75 m from the left wall, up to 0.2 m off; heading
    up to 0.3 rad off; all uniform.

    ## Episode End
    Terminates when the car is 0.3 m or less from a wall (at a control instant). Truncates
    after 130 steps.

    ## Arguments
    rays (21), field_of_view (230 degrees, given in radians), faults ("noise": uniform in
    [0, 0.1] m, as the paper trained; "none", "paper", a name of ``racecar faults``, a
    ``racecar.faults.Faults`` or a ``racecar.faultmodels.spec.FaultSpec``), slip (False), track
    (the paper's square). Every name of ``racecar faults`` has an environment of its own, such
    as ``racecar/Hallway-paper_pattern-v0``.

    ## Version History
    * v0: first version
    """

    metadata = {"render_modes": [], "render_fps": 10}  # noqa: RUF012 (Gymnasium's own form)

    def __init__(
        self,
        rays: int = 21,
        field_of_view: float = math.radians(230),
        faults: str | Faults | FaultSpec = "noise",
        slip: bool = False,
        track: Track | None = None,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise BadInput("Hallway-v0 does not render; draw traces with `racecar plot`")
        self.render_mode = None
        self._cars = _Cars(rays, field_of_view, faults, slip, track)
        self.observation_space = self._cars.scan_space
        self.action_space = self._cars.steering_space
        self._state: State | None = None
        self._faults: AnyFaults
        self._steps = np.zeros(1, dtype=int)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start a run; ``options`` may set ``s``, ``f``, ``v`` and ``theta`` (m, m/s, rad)."""
        super().reset(seed=seed)
        self._state, self._faults = self._cars.start(1, self.np_random, options)
        self._steps[:] = 0
        return self._cars.observe(self._steps, self._state, self._faults)[0], self._info()

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Hold the steering angle ``action`` (radians, clipped to the space) for 0.1 s."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        self._state, reward, crashed = self._cars.step(self._state, action)
        self._steps += 1
        scan = self._cars.observe(self._steps, self._state, self._faults)[0]
        return scan, float(reward[0]), bool(crashed[0]), False, self._info()

    def _info(self) -> dict[str, Any]:
        assert self._state is not None
        return {name: float(getattr(self._state, name)[0]) for name in ("s", "f", "v", "theta")}


class HallwayVectorEnv(VectorEnv):
    """Many hallway environments side by side, one batch of the model (see HallwayEnv)."""

    metadata = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}  # noqa: RUF012

    def __init__(
        self,
        num_envs: int = 1,
        rays: int = 21,
        field_of_view: float = math.radians(230),
        faults: str | Faults | FaultSpec = "noise",
        slip: bool = False,
        track: Track | None = None,
        max_episode_steps: int = EPISODE_STEPS,
        render_mode: str | None = None,
    ) -> None:
        if render_mode is not None:
            raise BadInput("Hallway-v0 does not render; draw traces with `racecar plot`")
        self.render_mode = None
        self._cars = _Cars(rays, field_of_view, faults, slip, track)
        self.num_envs = num_envs
        self._limit = max_episode_steps
        self.single_observation_space = self._cars.scan_space
        self.single_action_space = self._cars.steering_space
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state: State | None = None
        self._faults: AnyFaults
        self._steps = np.zeros(num_envs, dtype=int)
        self._over = np.zeros(num_envs, dtype=bool)

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start all runs; ``options`` as in HallwayEnv, numbers or arrays ``[num_envs]``.

        A list of seeds counts as one seed.
        """
        if isinstance(seed, list):
            numbers = [x for x in seed if x is not None]
            seed = int(np.random.SeedSequence(numbers).generate_state(1)[0]) if numbers else None
        super().reset(seed=seed, options=options)
        self._state, self._faults = self._cars.start(self.num_envs, self.np_random, options)
        self._steps[:] = 0
        self._over[:] = False
        return self._cars.observe(self._steps, self._state, self._faults), {}

    def step(
        self, actions: NDArray[np.float32]
    ) -> tuple[
        NDArray[np.float32],
        NDArray[np.float64],
        NDArray[np.bool_],
        NDArray[np.bool_],
        dict[str, Any],
    ]:
        """Hold the steering angles ``[num_envs, 1]`` for 0.1 s; runs that were over start anew."""
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        anew = self._over
        state, reward, crashed = self._cars.step(self._state, actions)
        self._steps += 1
        if anew.any():
            fresh, faults = self._cars.start(int(anew.sum()), self.np_random)
            for field in fields(State):
                getattr(state, field.name)[anew] = getattr(fresh, field.name)
            self._faults = renewed(self._faults, anew, faults)
            self._steps[anew] = 0
        self._state = state
        terminated = crashed & ~anew
        truncated = (self._steps >= self._limit) & ~anew
        self._over = terminated | truncated
        reward = np.where(anew, 0.0, reward)
        scans = self._cars.observe(self._steps, state, self._faults)
        return scans, reward, terminated, truncated, {}


def register() -> None:
    """Register the environments with Gymnasium (done when this module is imported)."""
    models: dict[str, dict[str, Any]] = {"racecar/Hallway-v0": {}}
    for name in fault_names():
        models[f"racecar/Hallway-{name}-v0"] = {"faults": name}
    for name, arguments in models.items():
        gymnasium.register(
            id=name,
            entry_point="racecar.env:HallwayEnv",
            vector_entry_point="racecar.env:HallwayVectorEnv",
            max_episode_steps=EPISODE_STEPS,
            kwargs=arguments,
        )


register()
