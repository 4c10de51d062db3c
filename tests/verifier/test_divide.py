"""Dividing rows: what a row becomes covers it, along x and along error symbols."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from enclosed import TRACKS, rows_of
from exact_members import random_models
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.lidar import Lidar
from verifier import divide as under_test
from verifier.divide import Divider, transformed
from verifier.models import TERMS, Models
from verifier.record import Part, Record
from verifier.rows import THETA, Decision, F, Rows, S, V
from verifier.scan import Guards

SEEDS = st.integers(0, 2**32 - 1)
SYMBOLS = 3


class Kept(Record):
    """A record that remembers which part of which row each row is, and what it assumes."""

    def __init__(self) -> None:
        super().__init__(S)
        self.made: dict[int, tuple[int, int, float, float, object]] = {}

    def parts(self, rows, step, part: Part, assumed=None):
        nodes = super().parts(rows, step, part, assumed)
        self._note(rows, part, nodes, assumed)
        return nodes

    def moved(self, rows, step, part: Part):
        nodes = super().moved(rows, step, part)
        self._note(rows, part, nodes, ["moved"] * len(rows))
        return nodes

    def _note(self, rows, part, nodes, assumed) -> None:
        for i, node in enumerate(nodes.tolist()):
            what = None if assumed is None else assumed[i]
            self.made[node] = (
                int(rows.node[i]), int(part.parameter[i]), float(part.low[i]), float(part.high[i]),
                what,
            )  # fmt: skip


def some_rows(random: np.random.Generator, count: int, error: float) -> Rows:
    state = random_models(random, (4, count), 0.01, SYMBOLS, error, 1.0)
    return rows_of(state)


def children(record: Kept, node: int) -> list[tuple[int, float, float, object]]:
    return [made[1:] for made in record.made.values() if made[0] == node]


def begun(record: Kept, rows: Rows) -> Rows:
    return replace(rows, node=record.roots(rows, rows.low, rows.high))


@settings(max_examples=40)
@given(SEEDS, st.booleans())
def test_halves_cover(seed, wide):
    random = np.random.default_rng(seed)
    record = Kept()
    divider = Divider(record, wide)
    rows = begun(record, some_rows(random, 5, 0.1))
    along = random.integers(0, SYMBOLS + 1, 5) if seed % 2 else None
    halves = divider.halve(rows, along)
    assert sum(map(len, halves)) == 10
    for i, node in enumerate(rows.node.tolist()):
        (first, second) = sorted(children(record, node), key=lambda x: x[1])
        assert first[0] == second[0]
        assert first[1:3] == (-1.0, 0.0)
        assert second[1:3] == (0.0, 1.0)
        if not wide:
            assert first[0] == 0
        elif along is not None:
            assert first[0] == along[i]
    for half in halves:
        for row, node in enumerate(half.node.tolist()):
            parent, parameter, low, high, _ = record.made[node]
            assert_part_of(rows, parent, half, row, parameter, low, high)


def assert_part_of(
    rows: Rows, parent: int, part: Rows, row: int, parameter: int, low: float, high: float
) -> None:
    """Assert that a row's models are its parent's on a part: at points of the part."""
    random = np.random.default_rng(0)
    for end in (low, (low + high) / 2, high):
        x, e = random.choice([-1.0, 1.0]), random.choice([-1.0, 1.0], SYMBOLS)
        new_x, new_e = x, e.copy()
        inner = (end - (low + high) / 2) / max((high - low) / 2, 1e-300)
        if parameter:
            e[parameter - 1], new_e[parameter - 1] = end, inner
        else:
            x, new_x = end, inner
        old, new = (
            _value(models, place, at, symbols)
            for models, place, at, symbols in (
                (rows.state, parent, x, e), (part.state, row, new_x, new_e),
            )
        )  # fmt: skip
        extra = part.state.radius[:, row] - rows.state.radius[:, parent]
        assert (extra >= 0).all()
        assert (np.abs(new - old) <= 1e-11).all()  # the half widths are rounded up by 2^-40


def _value(models: Models, row: int, x: float, e: np.ndarray) -> np.ndarray:
    values = np.concatenate([x ** np.arange(TERMS), np.ravel(np.stack([e, e * x], axis=1))])
    return values @ models.c[:, :, row]


def test_rows_that_are_too_narrow_are_given_up_and_noted():
    divider = Divider(None, wide=True)
    rows = some_rows(np.random.default_rng(0), 4, 0.1)
    rows = replace(
        rows,
        low=np.array([0.0, 0.0, 0.0, -1.0]),
        high=np.array([1e-10, 1e-10, 1e-10, 1.0]),
        splits=np.array([0, 0, under_test.MOST_SPLITS, under_test.MOST_SPLITS]),
    )
    # Too narrow along x; wide along a symbol; divided too often; not along x.
    halves = divider.halve(rows, np.array([0, 1, 1, 0]))
    assert sum(map(len, halves)) == 4
    (failed,) = divider.failed
    assert failed.state.c.tolist() == rows.take(np.array([0, 2])).state.c.tolist()


def test_gathered_rows_are_not_halved_for_ever():
    """Their piece stays as wide as it is."""
    divider = Divider(None, wide=True)
    rows = replace(some_rows(np.random.default_rng(0), 1, 0.1), gathered=np.array([True]))
    todo, rounds = [rows], 0
    while todo:
        todo = [half.take(np.array([0])) for half in divider.halve(todo[0], np.array([0]))][:1]
        rounds += 1
        assert rounds <= under_test.MOST_SPLITS + 1
    assert len(divider.failed) == 1
    assert (divider.failed[0].low[0], divider.failed[0].high[0]) == (-1.0, 1.0)


def guards_on(random: np.random.Generator, rows: Rows, count: int) -> Guards:
    """Return jumps and kinks that may fail, several a row."""
    models = random_models(random, (count,), 0.3, SYMBOLS, random.choice([1e-6, 1e-2, 0.3]), 0.1)
    decisions = tuple(
        Decision(0, 1, 2, n, True) if random.random() < 0.6 else None for n in range(count)
    )
    fails = np.abs(models.c).sum(axis=0) + models.radius
    return Guards(models, fails, np.sort(random.integers(0, len(rows), count)), decisions)


@settings(max_examples=60)
@given(SEEDS, st.booleans())
def test_cuts_cover_each_row(seed, wide):
    """Of every row: the whole again, halves that meet, or one part for each sign that may be."""
    random = np.random.default_rng(seed)
    record = Kept()
    divider = Divider(record, wide)
    rows = begun(record, some_rows(random, 6, 0.1))
    guards = guards_on(random, rows, 10)
    unclear = np.zeros(6, dtype=bool)
    unclear[random.integers(6)] = True
    out = divider.cut(rows, guards, unclear)
    given_up = [n for part in divider.failed for n in part.node.tolist()]
    held = {n: float(r.kink[i]) for r in out for i, n in enumerate(r.node.tolist())}
    for row, node in enumerate(rows.node.tolist()):
        mine = np.flatnonzero(guards.row == row)
        if not unclear[row] and not mine.size:
            assert not children(record, node)
            continue
        if node in given_up:
            continue
        if node in held:  # the same row, which bears its kinks now
            assert any(guards.decisions[g] is None and held[node] > guards.fails[g] for g in mine)
            continue
        made = sorted(children(record, node), key=lambda x: x[1:3])
        assert made, "a row was lost"
        assert len({m[0] for m in made}) == 1
        if len(made) == 2 and made[0][2] == made[1][1] == 0.0 and made[0][3] is made[1][3] is None:
            continue  # halves
        assert not unclear[row]
        assert _explained(made, guards, mine), made
    for part in out:
        for i, node in enumerate(part.node.tolist()):
            if node in record.made:
                parent, parameter, low, high, _ = record.made[node]
                assert_part_of(rows, parent, part, i, parameter, low, high)


def _explained(made: list, guards: Guards, mine: np.ndarray) -> bool:
    """Tell whether parts hold, for one guard of the row, all members of each sign."""
    random = np.random.default_rng(1)
    for g in mine:
        jump = guards.decisions[g] is not None
        signs = {m[3].positive: m for m in made if m[3] is not None}
        if jump != bool(signs) or (signs and made[0][3].ray != guards.decisions[g].ray):
            continue
        good = True
        for _ in range(300):
            x, e = random.uniform(-1, 1), random.uniform(-1, 1, SYMBOLS)
            if random.random() < 0.5:
                x, e = np.sign(x), np.sign(e)
            at = x if made[0][0] == 0 else e[made[0][0] - 1]
            values = np.concatenate([x ** np.arange(TERMS), np.ravel(np.stack([e, e * x], axis=1))])
            value = values @ guards.models.c[:, g]
            for sign, may in (
                (True, value + guards.models.radius[g] >= 0),
                (False, value - guards.models.radius[g] <= 0),
            ):
                if not may:
                    continue
                homes = [signs[sign]] if jump and sign in signs else [] if jump else made
                good &= any(low <= at <= high for _, low, high, _ in homes)
        if good:
            return True
    return False


def beyond(rows: Rows, change) -> np.ndarray:
    a, b, offset = change.guard
    return a * rows.state.c[:, S] + b * rows.state.c[:, F], offset


@pytest.mark.parametrize("wide", [False, True])
def test_rows_that_straddle_the_line_to_the_next_hall(wide):
    """Members before the line stay, members beyond it are described in the next frame."""
    random, plant = np.random.default_rng(5), Plant(TRACKS["square"], Bicycle(), Lidar(5))
    change = plant.track.frames[0].advance
    straddled = 0
    for _ in range(30):
        record = Kept()
        divider = Divider(record, wide)
        state = random_models(random, (4, 4), 0.05, SYMBOLS, 0.05, 0.0)
        # The line is s = 5.
        state.c[0] = np.array([5.0, 0.7, 2.0, -1.6])[:, None] + 0.1 * random.normal(size=(4, 4))
        rows = begun(record, rows_of(state))
        out = divider.advance(rows, change)
        assert all(r.frame.min() == r.frame.max() for r in out)
        straddled += sum(len(children(record, n)) == 2 for n in rows.node.tolist())
        for row in range(4):
            for _ in range(40):
                x, e = random.uniform(-1, 1), random.choice([-1.0, 1.0, 0.2], SYMBOLS)
                car = _value(state, row, x, e)
                moved = plant.advance(State.start(*car[:, None]))
                after = np.array([moved.s[0], moved.f[0], moved.v[0], moved.theta[0]])
                assert _somewhere(record, out, rows, row, x, e, int(moved.frame[0]), after)
    assert straddled > 20


def _somewhere(
    record: Kept, out: list[Rows], rows: Rows, row: int, x: float, e: np.ndarray, frame: int,
    after: np.ndarray,
) -> bool:  # fmt: skip
    for part in out:
        for i, node in enumerate(part.node.tolist()):
            parent, parameter, low, high, _ = record.made.get(node, (node, 0, -1.0, 1.0, None))
            at = x if parameter == 0 else e[parameter - 1]
            if parent != rows.node[row] or part.frame[i] != frame or not low <= at <= high:
                continue
            inner = (at - (low + high) / 2) / max((high - low) / 2, 1e-300)
            new_e = e.copy()
            if parameter:
                new_e[parameter - 1] = inner
            value = _value(part.state, i, x if parameter else inner, new_e)
            if (np.abs(value - after) <= part.state.radius[:, i] + 1e-10).all():
                return True
    return False


def test_the_next_frame_turns_and_shifts_as_the_simulation_does():
    random = np.random.default_rng(1)
    for track in (TRACKS["square"], TRACKS["left"], TRACKS["uneven"]):
        plant = Plant(track, Bicycle(), Lidar(5))
        frame = next(f for f in track.frames if f.advance is not None)
        a_s, a_f, b = frame.advance.guard
        pose = np.array([a_s * b, a_f * b, 2.0, 0.3]) + np.array([a_s, a_f, 0.0, 0.0]) * 0.3
        state = random_models(random, (4, 1), 1e-3, SYMBOLS, 1e-3, 0.0)
        state.c[0, :, 0] = pose
        result = transformed(state, frame.advance)
        index = track.frames.index(frame)
        x, e = 0.4, np.array([1.0, -1.0, 0.5])
        car = State.start(*_value(state, 0, x, e)[:, None])
        moved = plant.advance(replace(car, frame=np.array([index])))
        assert moved.frame[0] == frame.advance.to
        found = _value(result, 0, x, e)
        wanted = [moved.s[0], moved.f[0], moved.v[0], moved.theta[0]]
        assert found == pytest.approx(wanted, abs=1e-12)
        assert result.radius[THETA, 0] >= state.radius[THETA, 0] + 6e-17
        assert (result.radius[V] == state.radius[V]).all()


def test_the_heading_counts_by_what_it_moves_and_x_less_than_symbols():
    c = np.zeros((TERMS + 4, 4, 3))
    c[1, S] = 0.1  # x
    c[TERMS, F] = [0.01, 0.03, 0.0]
    c[TERMS + 2, THETA] = [0.0, 0.0, 0.005]
    assert under_test.widest(rows_of(Models(c, np.zeros((4, 3))))).tolist() == [0, 1, 2]
