"""Dividing rows: at a change of walls, in halves, or at the line to the next hall.

What a row is divided into covers it; rows that cannot be divided any more are given up.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from racecar.track import Advance
from verifier.models import TERMS, Array, Models, bounds, cuttable, error_spread, norm
from verifier.record import Part, Record, everything
from verifier.rounding import U
from verifier.rows import THETA, Assumption, Beyond, F, Rows, S
from verifier.scan import Guards
from verifier.sides import Sides, sides

Index = NDArray[np.intp]

#: A row narrower than this (of the start range's 2) is given up rather than split.
NARROWEST = 1e-9
#: A row is given up rather than divided along anything but its start position more often.
MOST_SPLITS = 40
#: What x does counts this much of what an error symbol does, when one of them is to be halved.
SYMBOL_SHARE = 0.2
#: Radians of heading count as so many metres.
LEVER = 5.0
#: Rows of which no member strays by more (m) need not be clear.
SMALL = 5e-3
#: A cut that leaves this much of a row (of 2) on one side is as good as none.
WHOLE = 1.998


class Divider:
    """Divides the rows of one proof; ``step`` is the current control step.

    wide: whether rows are to be divided along error symbols, too.
    """

    def __init__(self, record: Record | None, wide: bool) -> None:
        self._record = record
        self._wide = wide
        self.step = 0
        #: Rows given up so far.
        self.failed: list[Rows] = []
        #: How often a row was cut in two at a change of walls.
        self.cuts = 0
        #: How often ``low`` and ``high`` of a row were rounded, at most.
        self.restrictions = 0

    def give_up(self, rows: Rows) -> None:
        """Note rows that are not proved."""
        if len(rows):
            self.failed.append(rows)
            if self._record is not None:
                self._record.give_up(rows)

    def halve(self, rows: Rows, along: Index | None = None) -> list[Rows]:
        """Return the halves of rows along a parameter each: 0 for x, 1 + j for symbol j.

        along: ``[rows]``; if not given, the one by which the state strays most.
        """
        if not len(rows):
            return []
        if not self._wide:
            along = np.zeros(len(rows), dtype=np.intp)
        elif along is None:
            along = widest(rows)
        if self._wide:  # half the errors: a kink may be cut now
            rows = replace(rows, kink=np.zeros(len(rows)))
        tiny = rows.high - rows.low < NARROWEST
        often = rows.splits >= MOST_SPLITS
        narrow = np.where((along > 0) | rows.gathered, often, tiny)
        self.give_up(rows.take(narrow))
        halves = []
        for some in (~narrow & (along == 0), ~narrow & (along > 0)):
            index = np.flatnonzero(some)
            if not index.size:
                continue
            end, middle = np.ones(index.size), np.zeros(index.size)
            for low, high in ((-end, middle), (middle, end)):
                halves.append(self._part(rows.take(index), Part(along[index], low, high)))
        return halves

    def _part(
        self, rows: Rows, part: Part, assumed: Sequence[Assumption | None] | None = None
    ) -> Rows:
        """Return the parts of rows."""
        parts = self._within(rows, part)
        if assumed is not None:
            known = zip(rows.decisions, assumed, strict=True)
            parts = replace(parts, decisions=tuple(d if a is None else (*d, a) for d, a in known))
        if self._record is not None:
            parts = replace(parts, node=self._record.parts(parts, self.step, part, assumed))
        return parts

    def _within(self, rows: Rows, part: Part) -> Rows:
        """Return the models of the parts of rows, all along x or all along symbols."""
        if (part.low == -1).all() and (part.high == 1).all():
            return rows
        if (part.parameter == 0).all():
            self.restrictions += 1
            return rows.restrict(part.low, part.high)
        return rows.narrow(part.parameter - 1, part.low, part.high)

    def cut(self, rows: Rows, guards: Guards, unclear: NDArray[np.bool_]) -> list[Rows]:
        """Cut each row at the one of its failing guards that divides it best."""
        children = self._clear(rows.take(unclear))
        index = np.flatnonzero(~unclear[guards.row])
        if not index.size:
            return children
        both = sides(guards.models[index], self._wide)
        row = guards.row[index]
        order = np.lexsort((both.larger, row))
        first = order[np.unique(row[order], return_index=True)[1]]
        chosen, both = rows.take(row[first]), both.take(first)
        decisions = [guards.decisions[index[n]] for n in first]
        most = both.larger > WHOLE
        narrow = chosen.high - chosen.low < NARROWEST
        undecided = np.array([d is None for d in decisions])
        fails = guards.fails[index[first]]
        # A kink that fails by no more than the guard's own error cannot be cut any better: it
        # goes into the radius.
        useless = both.overlap >= 1
        if self._wide:
            inherent = useless
        else:
            inherent = fails <= 4.1 * error_spread(guards.models[index[first]])
        give_in = undecided & (inherent | narrow) & (chosen.kink < fails)
        held = chosen.take(give_in)
        if len(held):
            children.append(replace(held, kink=fails[give_in] * 1.01))
        several = np.bincount(row, minlength=len(rows))[row[first]] > 1
        # Several guards that no cut settles: halves settle some of them.
        split = ~give_in & (
            most & ~useless | undecided & useless | (several & useless & self._wide)
        )
        c = np.abs(guards.models.c[:, index[first]])
        pairs = _by_symbol(c)
        along = np.concatenate([c[1:TERMS].sum(axis=0)[None], pairs]).argmax(axis=0)
        children += self.halve(chosen.take(split), along[split])
        go = np.flatnonzero(~give_in & ~split)
        return children + self._sides(chosen.take(go), both.take(go), [decisions[n] for n in go])

    def _clear(self, rows: Rows) -> list[Rows]:
        """Return halves of rows that are unclear; small ones may keep kinks at any cost.

        At a place where a ray is parallel to a face and upon it, what it reads jumps: no part of
        a row around it is small enough.
        """
        small = self._wide & np.isfinite(rows.kink) & (reach_of(rows) < SMALL)
        forced = rows.take(small)
        forced = replace(forced, kink=np.full(len(forced), np.inf))
        return [*([forced] if len(forced) else []), *self.halve(rows.take(~small))]

    def _sides(self, rows: Rows, both: Sides, decisions: Sequence[Assumption | None]) -> list[Rows]:
        self.cuts += len(rows)
        children: list[Rows] = []
        for positive, kept, part in sided(both):
            assumed = [_signed(decisions[n], positive) for n in kept]
            children.append(self._part(rows.take(kept), part, assumed))
        return children

    def advance(self, rows: Rows, change: Advance) -> list[Rows]:
        """Move cars that are far enough into the next hall to its frame.

        Where that is so for a part of a row only, the row is cut: the unsafe sets of two frames
        need not be the same, and the numbers that describe the walls there are rounded.
        """
        value = rows.state[S].times(change.guard[0]) + rows.state[F].times(change.guard[1])
        value = value.plus(-change.guard[2])
        low, high = bounds(value)
        moves, stays = np.flatnonzero(low > 0), np.flatnonzero(high <= 0)
        done = [self._move(rows.take(moves), change, everything(len(moves))), rows.take(stays)]
        cut = np.flatnonzero(~((low > 0) | (high <= 0)))
        if not cut.size:
            return [r for r in done if len(r)]
        for beyond, kept, part in sided(sides(value[cut], self._wide)):
            some = rows.take(cut[kept])
            if beyond:
                done.append(self._move(some, change, part))
            else:
                stay = self._part(some, part, [Beyond(False)] * len(some))
                done.append(replace(stay, decisions=some.decisions))
        return [r for r in done if len(r)]

    def _move(self, rows: Rows, change: Advance, part: Part) -> Rows:
        """Describe the parts of rows in the frame of the next hall."""
        if not len(rows):
            return rows
        parts = self._within(rows, part)
        state = transformed(parts.state, change)
        moved = replace(parts, frame=np.full(len(rows), change.to), state=state)
        if self._record is not None:
            moved = replace(moved, node=self._record.moved(moved, self.step, part))
        return moved


def sided(both: Sides) -> Iterator[tuple[bool, Index, Part]]:
    """Yield of each side, the positive first, which rows have a part there, and the parts.

    Those along x and those along symbols come apart.
    """
    for interval, positive in ((both.positive, True), (both.negative, False)):
        there = interval[0] <= interval[1]
        for along_x in (True, False):
            kept = np.flatnonzero(there & ((both.parameter == 0) == along_x))
            if kept.size:
                yield positive, kept, Part(both.parameter[kept], *interval[:, kept])


def widest(rows: Rows) -> Index:
    """Return the parameter of each row by which its state strays most (0: x, 1 + j: symbol j).

    The heading is weighed as the distance by which it moves the far end of a ray. What x does is
    known to fifth order, what symbols do only to first.
    """
    c = rows.state.c * np.array([1.0, 1.0, 1.0, LEVER])[:, None]
    along_x = SYMBOL_SHARE * norm(c[1:TERMS]).max(axis=0)
    pairs = _by_symbol(np.abs(c)).max(axis=1)
    return np.concatenate([along_x[None], pairs]).argmax(axis=0)


def reach_of(rows: Rows) -> Array:
    """Return how far the members of rows stray at most (m; the heading times LEVER)."""
    sizes = norm(rows.state.c[1:]) * np.array([1.0, 1.0, 1.0, LEVER])[:, None]
    return np.asarray(sizes.max(axis=0))


def sharpest(scan: Models) -> Index:
    """Return the parameter by which a scan ``[rays, rows]`` is known least.

    A symbol's effect d on a reading is known to first order: about d^2 is missing. Of x the
    highest orders that are there say what is missing.
    """
    c = scan.c
    along_x = np.abs(c[TERMS - 1]).sum(axis=0)
    missing = np.square(_by_symbol(np.abs(c))).sum(axis=1)
    return np.concatenate([along_x[None], missing]).argmax(axis=0)


def shrunk(scan: Models, along: Index) -> Models:
    """Return a scan ``[rays, rows]`` of about half of each row, along a parameter each.

    For comparisons only: nothing is promised of it.
    """
    c, radius = scan.c.copy(), scan.radius.copy()
    x = along == 0
    for k in range(1, TERMS):
        c[k][:, x] *= 0.5**k
    c[TERMS + 1 :: 2][..., x] *= 0.5
    some = np.flatnonzero(~x)
    place = TERMS + 2 * (along[some] - 1)
    for k in (0, 1):
        c[place + k, :, some] *= 0.5
    radius[:, some] *= 0.4
    return Models(c, radius)


def _by_symbol(sizes: Array) -> Array:
    """Return the sum of the sizes of each symbol's coefficients; 0 for products."""
    pairs = sizes[TERMS::2] + sizes[TERMS + 1 :: 2]
    kept = np.zeros(len(pairs))
    kept[cuttable(len(pairs))] = 1.0
    return pairs * kept.reshape(-1, *[1] * (pairs.ndim - 1))


def _signed(assumption: Assumption | None, positive: bool) -> Assumption | None:
    """Return what a part assumes: a guard's decision, or the same with the other sign."""
    if assumption is None or positive:
        return assumption
    return replace(assumption, positive=not assumption.positive)


def transformed(state: Models, change: Advance) -> Models:
    """Return the state ``[4, rows]`` in the frame of the next hall."""
    (a, b), (d, e) = change.matrix
    s, f, c, radius = state[S], state[F], state.c.copy(), state.radius.copy()
    moved_s = (s.times(a) + f.times(b)).plus(change.offset[0])
    moved_f = (s.times(d) + f.times(e)).plus(change.offset[1])
    # The rotation is a quarter turn; its double is off by less than U.
    turned = state[THETA].plus(change.rotation).widen(U)
    for component, models in ((S, moved_s), (F, moved_f), (THETA, turned)):
        c[:, component], radius[component] = models.c, models.radius
    return Models(c, radius)
