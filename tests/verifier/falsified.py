"""Falsification asked about small networks, and its witness judged by the harness."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
from enclosed import TRACKS, problem_of
from instances import save

from harness.replay import check_witness
from racecar.controller import Controller, Layer, RuntimeSteer
from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from racecar.instance import load_instance
from racecar.lidar import Lidar
from verifier.falsify import Worst, worst_start
from verifier.problem import Problem

RAYS, MIDDLE = 21, 10


def linear(weights: dict[int, float], bias: float = 0.0) -> Controller:
    """Steer linearly in some readings."""
    row = np.zeros((1, RAYS), np.float32)
    for ray, weight in weights.items():
        row[0, ray] = weight
    return Controller((Layer(row, np.array([bias], np.float32), "linear"),))


def disturbance(
    noise=0.0, missing=0, turn_only=False, choice="run", mirrors: Mirrors | None = None
) -> Disturbance:
    return Disturbance(
        noise=noise, missing=missing, turn_only=turn_only, choice=choice, mirrors=mirrors
    )


def outer_walls(*stretches: tuple[float, float], incidence: float = 0.7) -> Mirrors:
    """Return stretches of the first hall's left wall (to the corner at 0) and front wall."""
    segments = [
        Segment(
            hall=0,
            begin=(max(a, 0.0), max(-a, 0.0)),
            end=(max(b, 0.0), max(-b, 0.0)),
        )
        for a, b in stretches
    ]
    return Mirrors(segments=tuple(segments), incidence=incidence)


#: Where no car gets.
NOWHERE = [[-1.0, 0.0, -1e4]]
#: Stretches of a metre, from 4 m before the corner to 4 m beyond it.
WALLS = outer_walls(*((a, a + 1.0) for a in (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0, 3.0)))


def problem(controller: Controller, lower: list[float], upper: list[float], **extra) -> Problem:
    given_extra = {"steps": 10} | extra
    return problem_of(
        TRACKS["square"],
        Lidar(controller.rays),
        controller,
        lower=np.array(lower),
        upper=np.array(upper),
        **given_extra,
    )


def search(question: Problem, seed: int = 0, **options) -> Worst:
    steer = RuntimeSteer(question.controller)
    return worst_start(question, steer, question.lower, question.upper, seed, **options)


def replayed(question: Problem, worst: Worst, folder: Path):
    """Judge a witness as the harness does; return its check."""
    path = save(replace(question, disturbance=None), folder)
    data = json.loads(path.read_text())
    if question.disturbance is not None:
        data["disturbance"] = question.disturbance.model_dump()
    path.write_text(json.dumps(data))
    return check_witness(load_instance(path), path, json.dumps(worst.witness()).encode())


def driven(v: float, time: float) -> float:
    """Return how far the car gets: v' = -1.633 (v - 2.4)."""
    return 2.4 * time - (v - 2.4) * math.expm1(-1.633 * time) / 1.633
