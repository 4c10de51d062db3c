"""Proofs under noise: parts of the start range that are halved until they can be proved."""

from __future__ import annotations

import numpy as np
import pytest
from enclosed import TRACKS, zero_controller
from instances import everywhere, question

from racecar.disturbance import Disturbance
from verifier import halves as under_test
from verifier.certificate import ROOT
from verifier.halves import prove_halved
from verifier.piece import Outcome, Piece
from verifier.problem import Box, Problem
from verifier.proof import OutOfTime
from verifier.rows import S

NOISE = Disturbance(noise=0.01, missing=0, turn_only=True, choice="run")
STEPS = 5


def noisy(unsafe: list[list[float]], **extra) -> Problem:
    """A car that goes straight on whatever it reads: what is unsafe is known exactly."""
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    safety = everywhere("lines", TRACKS["square"], unsafe)
    given = {"safety": safety, "steps": STEPS, "disturbance": NOISE} | extra
    return question(zero_controller(5), lower, upper, **given)


def outcome_of(problem: Problem, piece: Piece, check=lambda: None, recorded=True) -> Outcome:
    box = Box(problem.lower, problem.upper, S)
    return prove_halved(problem, box, piece, 0.0, check, recorded, lambda share: None)


def test_a_start_range_that_is_safe_is_proved_at_once():
    outcome = outcome_of(noisy([[1.0, 0.0, 0.6]]), Piece(0, -1.0, 1.0))
    assert (outcome.low.size, outcome.decided, outcome.in_time) == (0, 1.0, True)
    assert 0.05 - 1e-6 < outcome.least <= 0.05 + 1e-12


def test_what_is_unsafe_stays_open(monkeypatch):
    """s <= 0.7 is unsafe: the first quarter, and what halving cannot tell from it."""
    monkeypatch.setattr(under_test, "MOST_HALVES", 3)
    monkeypatch.setattr("verifier.divide.MOST_SPLITS", 6)
    monkeypatch.setattr("verifier.divide.NARROWEST", 1e-2)
    outcome = outcome_of(noisy([[1.0, 0.0, 0.7]]), Piece(0, -1.0, 1.0))
    assert outcome.in_time
    assert outcome.low[0] == -1
    assert outcome.high[-1] >= -0.5
    assert 0.5 <= outcome.decided <= 0.75
    assert outcome.decided == pytest.approx(1 - np.sum(outcome.high - outcome.low) / 2)
    assert outcome.least > 0


@pytest.mark.parametrize("depth", [0, 2, 4])
def test_halves_of_halves_make_up_the_piece(depth, monkeypatch):
    """No attempt is allowed a whole run until nothing is left to halve."""
    monkeypatch.setattr(under_test, "MOST_HALVES", depth)
    monkeypatch.setattr(under_test, "BOLD_ROWS", STEPS - 1)
    monkeypatch.setattr(under_test, "USUAL_ROWS", STEPS - 1)
    outcome = outcome_of(noisy([[1.0, 0.0, 0.6]]), Piece(0, -1.0, 1.0))
    assert (outcome.low.size, outcome.decided) == (0, 1.0)
    assert outcome.leaves == 2**depth
    assert outcome.record is not None
    cert = outcome.record.certificate("0" * 64, "0" * 64, 0.01, np.zeros((1, 5), dtype=bool))
    roots = np.sort(cert.piece[cert.kind == ROOT, 0], axis=0)
    assert len(roots) == 2**depth
    assert roots[0, 0] == -1
    assert roots[-1, 1] == 1
    assert (roots[1:, 0] == roots[:-1, 1]).all()
    # Nothing of the attempts that came to nothing is left.
    assert len(cert.parent) == (1 + STEPS) * 2**depth
    assert not cert.elsewhere.any()


def test_at_a_time_limit_only_what_is_proved_counts(monkeypatch):
    monkeypatch.setattr(under_test, "MOST_HALVES", 2)
    monkeypatch.setattr(under_test, "BOLD_ROWS", STEPS - 1)
    monkeypatch.setattr(under_test, "USUAL_ROWS", STEPS - 1)
    shares = []
    for most in range(0, 60, 4):
        calls = 0

        def check(most=most):
            nonlocal calls
            calls += 1
            if calls > most:
                raise OutOfTime

        outcome = outcome_of(noisy([[1.0, 0.0, 0.6]]), Piece(0, -1.0, 1.0), check)
        proved = [] if outcome.record is None else [outcome.record]
        assert outcome.decided == pytest.approx(1 - np.sum(outcome.high - outcome.low) / 2)
        assert bool(proved) == (outcome.decided > 0)
        assert outcome.in_time == (outcome.decided == 1)
        shares.append(outcome.decided)
    assert shares[0] == 0
    assert shares == sorted(shares)
    assert any(0 < share < 1 for share in shares)
    assert shares[-1] == 1


def test_a_start_that_is_one_point_is_not_halved():
    problem = noisy([[1.0, 0.0, 0.6]])
    problem.lower[S] = problem.upper[S] = 0.7
    attempts = under_test._attempts(Box(problem.lower, problem.upper, S), Piece(0, -1.0, 1.0))
    assert attempts[-1].most_rows == np.inf
    outcome = outcome_of(problem, Piece(0, -1.0, 1.0))
    assert (outcome.low.size, outcome.leaves) == (0, 1)


def test_the_last_halves_have_no_bound_of_rows():
    problem = noisy([[1.0, 0.0, 0.6]])
    box = Box(problem.lower, problem.upper, S)
    width = 2.0
    while (attempts := under_test._attempts(box, Piece(0, -1.0, width - 1)))[-1].most_rows < np.inf:
        assert (len(attempts) == 1) == (width / 2 * 0.2 > under_test.USUAL_WIDTH)
        width /= 2
    assert width == 2.0 * 0.5**under_test.MOST_HALVES
