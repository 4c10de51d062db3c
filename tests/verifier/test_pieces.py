"""Pieces side by side: what they make up, honest outcomes, and the records that they leave."""

from __future__ import annotations

import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from enclosed import TRACKS, rows_of, zero_controller
from exact_members import random_models
from instances import everywhere, question

from racecar.disturbance import Disturbance, Mirrors
from racecar.faultmodels.spec import Segment
from verifier import pieces as under_test
from verifier import proof, verify
from verifier.certificate import ADVANCE, GATHERED, IMAGE, PART, ROOT
from verifier.disturbed import cases
from verifier.piece import Outcome, Piece, merged
from verifier.pieces import divided, prove_piece, prove_pieces
from verifier.problem import Box, Problem
from verifier.record import Part, Record, everything, joined
from verifier.rows import Beyond, Decision, Inside, S

SQUARE = TRACKS["square"]
WHOLE = Piece(0, -1.0, 1.0)


def straight(unsafe: list[list[float]], steps: int = 5, **extra) -> Problem:
    """The car goes straight on, s stays what it was: what is unsafe is known exactly."""
    lower, upper = [0.65, 9.9, 0.0, 0.0], [0.85, 9.9, 0.0, 0.0]
    safety = everywhere("lines", SQUARE, unsafe)
    return question(zero_controller(5), lower, upper, safety=safety, steps=steps, **extra)


def box_of(problem: Problem) -> Box:
    return Box(problem.lower, problem.upper, S)


def done(problem: Problem, piece: Piece, seconds: float = 60.0, recorded: bool = False) -> Outcome:
    return prove_piece(problem, box_of(problem), piece, 0.0, time.monotonic() + seconds, recorded)


@pytest.mark.parametrize("workers", [1, 2, 3, 7])
@pytest.mark.parametrize("number", [1, 2, 22])
def test_pieces_make_up_the_start_range_in_every_case(workers, number):
    found = divided(number, workers)
    assert len(found) >= min(workers, 2)
    assert workers > 1 or len(found) == number
    for case in range(number):
        mine = sorted((p.low, p.high) for p in found if p.case == case)
        assert mine[0][0] == -1
        assert mine[-1][1] == 1
        assert all(a[1] == b[0] for a, b in pairwise(mine))


def test_merged_intervals_stay_in_their_piece():
    low, high = merged(np.array([0.0, 0.3]), np.array([0.25, 0.5]), Piece(0, 0.0, 0.5))
    assert low.tolist() == [0.0, pytest.approx(0.3, abs=2e-10)]
    assert high.tolist() == [pytest.approx(0.25, abs=2e-10), 0.5]


def test_an_outcome_in_time():
    problem = straight([[1.0, 0.0, 0.6]])
    outcome = done(problem, Piece(0, -1.0, 0.0))
    assert (outcome.low.size, outcome.decided, outcome.in_time) == (0, 1.0, True)
    assert 0.05 - 1e-9 < outcome.least <= 0.05 + 1e-12
    # The other half does not come as near.
    assert 0.15 - 1e-9 < done(problem, Piece(0, 0.0, 1.0)).least <= 0.15 + 1e-12


def test_what_is_unsafe_stays_open(monkeypatch):
    """s <= 0.7 is unsafe: the first quarter, and little else."""
    monkeypatch.setattr("verifier.divide.NARROWEST", 1e-4)
    outcome = done(straight([[1.0, 0.0, 0.7]]), WHOLE)
    assert outcome.in_time
    assert outcome.low.tolist() == [-1.0]
    assert -0.5 <= outcome.high[0] < -0.499
    assert 0.749 < outcome.decided <= 0.75
    assert 0 < outcome.least < 1e-4


def test_the_decided_share_at_a_time_limit_counts_only_what_is_done(monkeypatch):
    """Stopped at every possible moment: no start that is unsafe ever counts as decided."""
    monkeypatch.setattr("verifier.divide.NARROWEST", 1e-2)
    monkeypatch.setattr(proof, "BATCH", 4)
    problem = straight([[1.0, 0.0, 0.7]], steps=3)
    total = _calls(problem)
    assert total > 20
    shares = []
    for stop in range(1, total, max(1, total // 8)):
        outcome = _stopped(problem, stop)
        assert not outcome.in_time
        assert outcome.low.size
        shares.append(outcome.decided)
    assert shares[0] == 0
    assert max(shares) <= 0.75 + 1e-9
    assert shares[-1] > 0.6


def _calls(problem: Problem) -> int:
    count = 0
    original = proof.Prover._attempt

    def counted(self, *arguments):
        nonlocal count
        count += 1
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof.Prover, "_attempt", counted)
        done(problem, WHOLE)
    return count


def _stopped(problem: Problem, after: int) -> Outcome:
    """Return the outcome when the time is up after so many batches."""
    count = 0
    original = proof.Prover._attempt

    def counted(self, *arguments):
        nonlocal count
        count += 1
        if count > after:
            raise proof.OutOfTime
        return original(self, *arguments)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof.Prover, "_attempt", counted)
        return done(problem, WHOLE)


def test_no_time_at_all():
    outcome = done(straight([[1.0, 0.0, 0.6]]), WHOLE, seconds=0.0)
    assert (outcome.decided, outcome.in_time) == (0.0, False)
    assert outcome.low.tolist() == [-1.0]
    assert outcome.high.tolist() == [1.0]


def test_what_one_tolerance_leaves_open_is_tried_at_the_next():
    """All of what failed is: every open part lies within those tried next."""
    tried: list[tuple[np.ndarray, np.ndarray]] = []
    original = proof.Prover.prove

    def half(self, box, low, high, tolerance, *rest):
        tried.append((low, high))
        result = original(self, box, low, high, tolerance, *rest)
        if len(tried) == 1:
            return replace(result, low=np.array([-0.25]), high=np.array([0.5]))
        return result

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(proof.Prover, "prove", half)
        outcome = done(straight([[1.0, 0.0, 0.6]]), WHOLE)
    assert outcome.low.size == 0
    assert len(tried) == 2
    assert tried[1][0][0] < -0.25
    assert tried[1][1][0] > 0.5


def test_two_workers_find_what_one_finds():
    problem = straight([[1.0, 0.0, 0.6]])
    results = [
        verify.verify(problem, problem.controller.steering_rows, 100.0, workers=n) for n in (1, 2)
    ]
    assert [r.verdict for r in results] == ["unsat", "unsat"]
    assert results[0].margin_lower == pytest.approx(results[1].margin_lower, abs=1e-9)
    shares: list[float] = []
    outcomes = list(
        prove_pieces(
            straight([[1.0, 0.0, 0.7]], steps=1), box_of(problem), divided(1, 1), 0.0,
            time.monotonic() + 60, False, 1, shares.append,
        )
    )  # fmt: skip
    assert shares == sorted(shares)
    assert shares[-1] == outcomes[0].decided


def checked_tree(record: Record, pieces: int) -> None:
    """Assert that every row follows from an earlier one of its own piece, in order."""
    cert = record.certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))
    number = np.arange(len(cert))
    roots = np.flatnonzero(cert.kind == ROOT)
    assert len(roots) == pieces
    assert (cert.parent[roots] == -1).all()
    later = np.flatnonzero((cert.kind != ROOT) & (cert.kind != GATHERED))
    assert set(np.unique(cert.kind[later])) <= {PART, IMAGE, ADVANCE}
    assert (cert.parent[later] < number[later]).all()
    steps = cert.step[later] - cert.step[cert.parent[later]]
    assert (steps == (cert.kind[later] == IMAGE)).all()
    # A row belongs to the last root before it: records are appended one after the other.
    owner = np.searchsorted(roots, number, side="right")
    assert (owner[later] == owner[cert.parent[later]]).all()
    leaves = np.setdiff1d(number, cert.parent)
    assert (cert.step[leaves] == 5).all()
    for guard in cert.guard[cert.guard >= 0]:
        assert guard < len(cert.guard_kind)


def test_joined_records_are_the_same_rows_with_new_numbers():
    problem = straight([[1.0, 0.0, 0.6]], steps=5)
    parts = [Piece(0, -1.0, -0.25), Piece(0, -0.25, 0.5), Piece(0, 0.5, 1.0)]
    records = [done(problem, p, recorded=True).record for p in parts]
    sizes = [
        len(r.certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))) for r in records
    ]
    whole = joined(records)
    checked_tree(whole, 3)
    cert = whole.certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))
    assert len(cert) == sum(sizes)
    begin = 0
    for record, size in zip(records, sizes, strict=True):
        alone = record.certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))
        mine = slice(begin, begin + size)
        for name in ("step", "frame", "kind", "centre", "spread", "radius", "piece", "elsewhere"):
            assert np.array_equal(getattr(cert, name)[mine], getattr(alone, name))
        own = np.where(alone.parent < 0, -1, alone.parent + begin)
        assert np.array_equal(cert.parent[mine], own)
        begin += size


def test_joined_records_keep_guards_and_gathered_rows_apart():
    """Guards of both, in another order; one row of the second gathered into another."""

    def rows(count: int):
        return rows_of(random_models(np.random.default_rng(count), (4, count), 0.1, 2, 0.1))

    whole = np.array([-1.0, -1.0]), np.array([1.0, 1.0])
    guards = [Decision(0, 1, 2, 3, True), Inside(False), Beyond(True)]
    records = []
    for order in ((0, 1), (2, 0)):
        record = Record(S)
        two = rows(2)
        two = replace(two, node=record.roots(two, *whole))
        part, begun = everything(2), two
        two = replace(two, node=record.parts(two, 0, part, [guards[i] for i in order]))
        record.give_up(two.take(np.array([1])))
        record.parts(begun, 0, part)
        record.gathered(two.take(np.array([0])), 4, rows(1))
        records.append(record)
    cert = joined(records).certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))
    assert cert.parent.tolist() == [-1, -1, 0, 1, 0, 1, -1, -1, -1, 7, 8, 7, 8, -1]
    assert np.flatnonzero(cert.into >= 0).tolist() == [2, 9]
    assert cert.into[[2, 9]].tolist() == [6, 13]
    assert np.flatnonzero(cert.elsewhere).tolist() == [3, 10]
    kinds = [int(cert.guard_kind[g]) if g >= 0 else -1 for g in cert.guard]
    assert kinds == [-1, -1, 0, 2, *[-1] * 5, 1, 0, *[-1] * 3]  # cross 0, advance 1, turn 2
    cross = cert.guard[2]
    assert cert.guard[10] == cross
    assert (cert.ray[cross], cert.obstacle[cross]) == (3, 0)
    assert (cert.front[cross], cert.back[cross], cert.positive[cross]) == (1, 2, True)
    assert not cert.positive[cert.guard[3]]


def test_every_case_of_missing_rays_is_proved_and_counted():
    """One of five rays, or none, for the whole run: six cases; one unproved spoils all."""
    given = Disturbance(noise=0.0, missing=1, turn_only=False, choice="run")
    problem = straight([[1.0, 0.0, 0.6]], disturbance=given)
    masks = cases(given, 5)
    assert sorted(map(tuple, masks.tolist())) == sorted(
        tuple(i == k for i in range(5)) for k in range(-1, 5)
    )
    result = verify.verify(problem, problem.controller.steering_rows, 100.0)
    assert result.verdict == "unsat"
    seen: list[int] = []
    original = under_test.prove_piece

    def spoiled(problem, box, piece, *rest):
        seen.append(piece.case)
        outcome = original(problem, box, piece, *rest)
        if piece.case == 4:
            return replace(outcome, low=np.array([0.0]), high=np.array([0.5]), decided=0.75)
        return outcome

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(under_test, "prove_piece", spoiled)
        result = verify.verify(problem, problem.controller.steering_rows, 100.0)
    assert seen == [0, 1, 2, 3, 4, 5]
    assert result.verdict == "unknown"
    assert result.decided == pytest.approx((5 + 0.75) / 6)


def test_too_many_choices_of_rays_are_said_so(monkeypatch):
    monkeypatch.setattr("verifier.disturbed.MOST_CHOICES", 5)
    given = Disturbance(noise=0.0, missing=1, turn_only=False, choice="run")
    for steps in (2, verify.LONG + 1):
        problem = straight([[1.0, 0.0, 0.6]], disturbance=given, steps=steps)
        result = verify.verify(problem, problem.controller.steering_rows, 5.0)
        assert result.verdict in {"unknown", "sat"}
        if result.verdict == "unknown":
            assert "more choices" in result.note


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_nothing_is_proved_of_walls_that_mirror(noise):
    """The car cannot become unsafe, whatever it reads; but that is not to be said yet."""
    wall = Segment(hall=0, begin=(0.0, 0.0), end=(0.0, 1.0))
    mirrors = Mirrors(segments=(wall,), incidence=0.8)
    given = Disturbance(noise=noise, missing=0, turn_only=False, choice="run", mirrors=mirrors)
    for steps in (2, verify.LONG + 1):
        problem = straight([[1.0, 0.0, 0.6]], disturbance=given, steps=steps)
        result = verify.verify(problem, problem.controller.steering_rows, 5.0)
        assert result.verdict in {"unknown", "sat"}
        if result.verdict == "unknown":
            assert "mirror" in result.note
            assert result.margin_lower is None


def test_what_came_to_nothing_is_given_up_where_it_began():
    """Of a root's two halves one goes on; the other, and all that followed from it, is given up."""
    record = Record(S)
    rows = rows_of(random_models(np.random.default_rng(0), (4, 1), 0.1, 2, 0.1))
    root = replace(rows, node=record.roots(rows, np.array([-1.0]), np.array([1.0])))
    zero = np.zeros(1, dtype=np.intp)
    low = replace(root, node=record.parts(root, 0, Part(zero, -np.ones(1), np.zeros(1))))
    high = replace(root, node=record.parts(root, 0, Part(zero, np.zeros(1), np.ones(1))))
    later = replace(low, node=record.images(low, 1))
    for end in (-np.ones(1), np.zeros(1)):
        half = replace(later, node=record.parts(later, 1, Part(zero, end, end + 1)))
        record.give_up(half)
    record.images(high, 1)
    cert = record.certificate("0" * 64, "0" * 64, 0.1, np.zeros((1, 5), dtype=bool))
    assert cert.parent.tolist() == [-1, 0, 0, 2]
    assert cert.elsewhere.tolist() == [False, True, False, False]
    assert cert.step.tolist() == [0, 0, 0, 1]
