"""DAgger (Ross, Gordon and Bagnell 2011): the student drives, the teacher says what it would do.

In each round the student drives, with faulty scans, and every scan that it meets is kept with
the steering that the teacher, who sees the state, would choose there. Then the student learns
from what the last rounds have seen. So it learns where its own mistakes and faults lead it.

The loss is the squared error plus ``gain_penalty`` times the squared gain (L1 norm of the
gradient): a network of small gain averages over rays instead of trusting a few of them.
"""

from __future__ import annotations

import math

import numpy as np
import torch

from generator.hyperparams.robust import RobustHyperparameters
from generator.robust.mine import worst_sets
from generator.robust.spoil import draw_spoil
from generator.robust.student import Student
from generator.robust.teacher import Teacher
from racecar.closed_loop import Plant, State
from racecar.env import MAX_STEERING
from racecar.polygon import Array
from racecar.safety import named_property

#: A drive is over at this margin (m): a scan from within a wall teaches nothing.
_LOST = -0.25
_WARM_UP = 0.1
#: The first round must show the whole drive to a student that knows nothing.
_MORE_AT_FIRST = 3
#: Random sets of rays tried by the adversary, and how many sets of all those tried it keeps.
_SETS_TRIED, _SETS_KEPT = 200, 64
#: The gain penalty is per (1 / 5 m)^2: the network's inputs are metres divided by 5.
_SCALE = 5.0


class Dagger:
    """The state of a training; ``round()`` does the next round."""

    def __init__(
        self, plant: Plant, hidden: tuple[int, ...], parameters: RobustHyperparameters, seed: int
    ) -> None:
        torch.manual_seed(seed)  # the weights that layers begin with come from the global one
        self.plant, self.parameters = plant, parameters
        self.safety = named_property("clearance", plant.track)
        self.random = np.random.default_rng(seed)
        self.student = Student(plant.lidar.rays, hidden)
        self.teacher = Teacher(**parameters.teacher.model_dump())
        self.optimizer = torch.optim.AdamW(
            self.student.parameters(), lr=0.0, weight_decay=parameters.weight_decay
        )
        self.rounds = 0
        self.seen: list[tuple[torch.Tensor, torch.Tensor]] = []

    def round(self) -> tuple[float, float]:
        """Drive and learn once; return means over the steps: squared error, gain (1/m)."""
        self.seen = [*self.seen, self._drive()][-self.parameters.kept_rounds :]
        scans, answers = (torch.cat(part) for part in zip(*self.seen, strict=True))
        errors = gains = 0.0
        steps = self.parameters.gradient_steps
        for step in range(steps):
            rate = self._rate(self.rounds * steps + step)
            for group in self.optimizer.param_groups:
                group["lr"] = rate
            error, gain = self._learn(scans, answers)
            errors, gains = errors + error / steps, gains + gain / steps
        self.rounds += 1
        return errors, gains

    def _rate(self, step: int) -> float:
        p = self.parameters
        done = step / (p.rounds * p.gradient_steps)
        if done < _WARM_UP:
            return p.learning_rate * (0.04 + 0.96 * done / _WARM_UP)
        return p.learning_rate * (1 + math.cos(math.pi * (done - _WARM_UP) / (1 - _WARM_UP))) / 2

    def _learn(self, scans: torch.Tensor, answers: torch.Tensor) -> tuple[float, float]:
        batch = self.parameters.batch_size
        picked = torch.from_numpy(self.random.integers(len(scans), size=batch))
        steering, gain = self.student.with_gain(scans[picked])
        error = ((steering - answers[picked]) ** 2).mean()
        loss = error + self.parameters.gain_penalty * ((_SCALE * gain) ** 2).mean()
        self.optimizer.zero_grad()
        loss.backward()
        self.optimizer.step()
        return error.item(), gain.mean().item()

    def _drive(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Drive a round's cars; return the scans met ``[n, rays]`` and the teacher's answers."""
        p, plant, random = self.parameters, self.plant, self.random
        count = p.cars * (1 if self.rounds else _MORE_AT_FIRST)
        grown = p.faults.curriculum_rounds
        share = min(1.0, self.rounds / grown) if grown else 1.0
        worst = np.zeros((plant.lidar.rays, 0), dtype=bool)
        if p.faults.mined and self.rounds >= p.teacher_rounds:
            most = p.faults.missing
            worst = worst_sets(plant, self.steer, most, random, _SETS_TRIED, _SETS_KEPT)
        spoil = draw_spoil(plant, p.faults, count, share, worst, random)
        teachers = max(0.0, 1 - self.rounds / p.teacher_rounds) if p.teacher_rounds else 0.0
        state = draw_starts(count, p.near_turn, plant.track.width, random)
        going = np.ones(count, dtype=bool)
        scans, answers = [], []
        for step in range(p.steps):
            scan = spoil(step, state, plant.scan_rows(state))
            answer = self.teacher(state.s, state.f, state.theta)
            scans.append(scan.T[going].astype(np.float32))
            answers.append((answer[going] / MAX_STEERING).astype(np.float32))
            taught = random.random(count) < teachers
            after, _ = plant.drive(state, np.where(taught, answer, self.steer(scan)))
            going &= plant.margin(self.safety, after) > _LOST
            state = plant.advance(after)
        return torch.from_numpy(np.concatenate(scans)), torch.from_numpy(np.concatenate(answers))

    def steer(self, scan: Array) -> Array:
        """Return the student's steering (rad) for scans ``[rays, cars]`` (m)."""
        with torch.no_grad():
            answer = self.student(torch.from_numpy(scan.T.astype(np.float32)))
        return MAX_STEERING * answer.numpy().astype(float)


def draw_starts(count: int, near_turn: float, width: float, random: np.random.Generator) -> State:
    """Draw starts: the paper's and a little more, and a share at speed before the turn.

    width: of the hall, metres.
    """
    low, high = np.where(
        random.random(count) < near_turn,
        # s - W/2, f - W, v, theta; the start's f is 10 m at W = 1.5 m
        np.array([[-0.4, 1.0, 1.5, -0.4], [0.4, 3.5, 2.45, 0.4]])[..., None],
        np.array([[-0.22, 8.3, 0.0, -0.3], [0.22, 8.5, 0.0, 0.3]])[..., None],
    )
    s, f, v, theta = random.uniform(low, high)
    return State.start(width / 2 + s, width + f, v, theta)
