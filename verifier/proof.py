"""Proving one box of start states safe: rows go through the control steps together.

A row whose walls are not clear is cut where they change; a row whose models get too coarse,
or whose margin cannot be shown, is split in halves and does the step again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from racecar.track import Advance
from verifier.clearance import least_margin
from verifier.cuts import parts
from verifier.elementary import SIN_COS_RANGE
from verifier.models import Array, Models, bounds, error_spread, norm
from verifier.motion import Motion, extent, new_error, total_error
from verifier.network import Network
from verifier.problem import Box, Problem, start_rows
from verifier.rounding import U
from verifier.rows import THETA, F, Rows, S, consolidate, join
from verifier.scan import Guards, Scanner

#: Rows treated at once: bounds the memory.
BATCH = 48
#: A row narrower than this (of the box's 2) is given up rather than split.
NARROWEST = 1e-9
#: A gap between rows (of the box's 2) that may be due to rounding alone.
GAP = 1e-10
#: A row whose errors (m, rad) exceed this is given up.
COARSEST = 2e-3
#: The share of the errors that a row comes with by which they may grow in a step.
GROWTH = 0.1
#: If splitting did not bring the error of a step below this share, it stems from the errors
#: that the row came with, and is accepted.
FUTILE = 0.5


@dataclass(frozen=True)
class Proof:
    """What was shown of a box.

    low, high: pieces (within [-1, 1]) that were not proved safe; least: proved lower bound of
    the margin (m) on all the others; leaves: rows at the end.
    """

    low: Array
    high: Array
    least: float
    leaves: int


#: How much larger than a kink (1/m) the error of a step that keeps it may be (m, rad).
KINK_GAIN = 100.0


class OutOfTime(Exception):
    """The time limit was reached."""


class Prover:
    """Proves boxes of one problem; ``check`` is called often and may raise OutOfTime."""

    def __init__(
        self, problem: Problem, wanted: float, check: Callable[[], None] = lambda: None
    ) -> None:
        self._problem = problem
        self._active = problem.active
        self._wanted = wanted
        self._check = check
        self._network = Network(problem.controller)
        self._motion = Motion(problem.plant.bicycle, problem.plant.period)
        alike = problem.plant.track.alike
        frames = problem.plant.track.frames
        by_shape = {
            int(i): Scanner(problem.plant.lidar, frames[i].obstacles) for i in np.unique(alike)
        }
        self._scanners = [by_shape[int(i)] for i in alike]
        # Frames are treated together if they agree in walls, advance and unsafe set.
        self._alike = alike * len(frames) + problem.safety.alike
        self._restrictions = 0
        #: How often a row was cut in two at a change of walls.
        self.cuts = 0

    def prove(self, box: Box, low: Array, high: Array, tolerance: float) -> Proof:
        """Prove pieces [low, high] of a box; tolerance: for the error of one step."""
        rows = start_rows(box, self._active, low, high)
        failed: list[Rows] = []
        for _ in range(self._problem.steps):
            if len(rows):
                rows = self._step(rows, tolerance, failed)
        bad = join(failed) if failed else rows.take(np.zeros(len(rows), dtype=bool))
        least = float(rows.least.min(initial=np.inf))
        # low and high of a row are rounded anew at each of the restrictions that made it.
        pad = 8 * U * self._restrictions
        covered = [np.concatenate([rows.low, bad.low]), np.concatenate([rows.high, bad.high])]
        lost = uncovered(low, high, *covered)
        open_low = np.concatenate([bad.low, lost[0]]) - pad
        open_high = np.concatenate([bad.high, lost[1]]) + pad
        return Proof(np.maximum(open_low, -1), np.minimum(open_high, 1), least, len(rows))

    def _step(self, rows: Rows, tolerance: float, failed: list[Rows]) -> Rows:
        """Take all rows through one control step."""
        todo, done = [rows], []
        while todo:
            self._check()
            batch = todo.pop()
            if len(batch) > BATCH:
                todo.append(batch.take(np.arange(BATCH, len(batch))))
                batch = batch.take(np.arange(BATCH))
            # Beyond this, sin and cos are not known.
            wild = ~(norm(batch.state.c[:, THETA]) + batch.state.radius[THETA] < SIN_COS_RANGE)
            if wild.any():
                failed.append(batch.take(wild))
                batch = batch.take(~wild)
                if not len(batch):
                    continue
            shapes = self._alike[batch.frame]
            if shapes.min() != shapes.max():
                todo += [batch.take(shapes == shape) for shape in np.unique(shapes)]
                continue
            again, finished = self._attempt(batch, tolerance, failed)
            todo += [r for r in again if len(r)]
            if len(finished):
                done.append(finished)
        return join(done) if done else rows.take(np.zeros(len(rows), dtype=bool))

    def _attempt(self, rows: Rows, tolerance: float, failed: list[Rows]) -> tuple[list[Rows], Rows]:
        """Return rows that do the step again, and rows that have done it."""
        frame = int(rows.frame[0])
        came = total_error(rows.state)
        lost = ~(came <= COARSEST)
        if lost.any():
            failed.append(rows.take(lost))
            rows, came = rows.take(~lost), came[~lost]
        if not len(rows):
            return [], rows
        scan = self._scanners[frame].measure(rows, 0.1 * tolerance)
        blocked = scan.unclear.copy()
        blocked[scan.guards.row] = True
        again = self._cut(rows, scan.guards, scan.unclear, failed)
        clear = np.flatnonzero(~blocked)
        if not clear.size:
            return again, rows.take(clear)
        rows, came = rows.take(clear), came[clear]
        with np.errstate(invalid="ignore", over="ignore"):  # rows too wide; sorted out below
            steering = self._network.steering(scan.distance[:, clear])
            path = self._motion.drive(rows.state, steering)
        error = new_error(path.state)
        error = np.where(np.isfinite(error), error, np.inf)
        # Splitting does not help where the errors are wider than the piece.
        dominated = came > 0.5 * extent(rows.state)
        fine = error <= tolerance + KINK_GAIN * rows.kink + GROWTH * came
        fine |= np.isfinite(error) & (dominated | (error > FUTILE * rows.tried))
        least = np.full(len(rows), -np.inf)
        clear = np.flatnonzero(fine)
        least[clear] = least_margin(
            path.take(clear), self._problem.safety.unsafe[frame], self._wanted
        )
        good = fine & (least > 0)
        lost = dominated & ~good
        if lost.any():
            failed.append(rows.take(lost))
        retry = np.flatnonzero(~good & ~lost)
        again += self._halve(replace(rows.take(retry), tried=error[retry]), failed)
        good &= ~lost
        rows, least = rows.take(good), least[good]
        rows = replace(
            rows,
            state=consolidate(path.state[:, np.flatnonzero(good)], self._active),
            least=np.minimum(rows.least, least),
            decisions=((),) * len(rows),
            kink=np.zeros(len(rows)),
            tried=np.full(len(rows), np.inf),
        )
        return again, self._advance(rows)

    def _cut(
        self, rows: Rows, guards: Guards, unclear: NDArray[np.bool_], failed: list[Rows]
    ) -> list[Rows]:
        """Cut each row at the one of its failing guards that divides it best."""
        self._restrictions += 1
        children = [*self._halve(rows.take(unclear), failed)]
        fit = ~unclear[guards.row]
        if not fit.any():
            return children
        index = np.flatnonzero(fit)
        both = parts(guards.models[index])
        row = guards.row[index]
        size_p = np.maximum(both.positive[1] - both.positive[0], 0)
        size_n = np.maximum(both.negative[1] - both.negative[0], 0)
        larger = np.maximum(size_p, size_n)
        order = np.lexsort((larger, row))
        first = order[np.unique(row[order], return_index=True)[1]]
        chosen = rows.take(row[first])
        decisions = [guards.decisions[index[n]] for n in first]
        overlap = (size_p + size_n - 2)[first]
        whole = larger[first] > 1.998
        narrow = chosen.high - chosen.low < NARROWEST
        undecided = np.array([d is None for d in decisions])
        fails = guards.fails[index[first]]
        # A kink that fails by no more than the guard's own error cannot be cut any better: it
        # goes into the radius.
        inherent = fails <= 4.1 * error_spread(guards.models[index[first]])
        give_in = undecided & (inherent | narrow) & (chosen.kink < fails)
        held = chosen.take(give_in)
        if len(held):
            children.append(replace(held, kink=fails[give_in] * 1.01))
        split = ~give_in & (whole & (overlap < 1) | undecided & (overlap >= 1))
        children += self._halve(chosen.take(split), failed)
        go = np.flatnonzero(~give_in & ~split)
        self.cuts += len(go)
        for part, positive in ((both.positive, True), (both.negative, False)):
            low, high = part[0, first[go]], part[1, first[go]]
            some = low <= high
            kept = chosen.take(go[some])
            if not len(kept):
                continue
            assumed = []
            for n, known in zip(go[some], kept.decisions, strict=True):
                d = decisions[n]
                if d is not None:
                    known = (*known, d if positive else replace(d, positive=not d.positive))  # noqa: PLW2901
                assumed.append(known)
            kept = replace(kept, decisions=tuple(assumed))
            children.append(kept.restrict(low[some], high[some]))
        return children

    def _halve(self, rows: Rows, failed: list[Rows]) -> list[Rows]:
        narrow = rows.high - rows.low < NARROWEST
        if narrow.any():
            failed.append(rows.take(narrow))
        rows = rows.take(~narrow)
        if not len(rows):
            return []
        self._restrictions += 1
        end, middle = np.ones(len(rows)), np.zeros(len(rows))
        return [rows.restrict(-end, middle), rows.restrict(middle, end)]

    def _advance(self, rows: Rows) -> Rows:
        """Move cars that are far enough into the next hall to its frame.

        Where that is so for a part of a row only, the row is cut: the unsafe sets of two frames
        need not be the same, and the numbers that describe the walls there are rounded.
        """
        done = []
        for index in np.unique(rows.frame):
            mine = rows.take(rows.frame == index)
            change = self._problem.plant.track.frames[index].advance
            if change is None:
                done.append(mine)
                continue
            value = mine.state[S].times(change.guard[0]) + mine.state[F].times(change.guard[1])
            value = value.plus(-change.guard[2])
            low, high = bounds(value)
            moves, stays = low > 0, high <= 0
            done += [_move(mine.take(moves), change), mine.take(stays)]
            open_rows = np.flatnonzero(~(moves | stays))
            if not open_rows.size:
                continue
            self._restrictions += 1
            both = parts(value[open_rows])
            for part, beyond in ((both.positive, True), (both.negative, False)):
                some = part[0] <= part[1]
                kept = mine.take(open_rows[some]).restrict(part[0, some], part[1, some])
                done.append(_move(kept, change) if beyond else kept)
        return join([r for r in done if len(r)]) if done else rows


def _move(rows: Rows, change: Advance) -> Rows:
    """Describe rows in the frame of the next hall."""
    (a, b), (d, e) = change.matrix
    s, f, c, radius = rows.state[S], rows.state[F], rows.state.c.copy(), rows.state.radius.copy()
    moved_s = (s.times(a) + f.times(b)).plus(change.offset[0])
    moved_f = (s.times(d) + f.times(e)).plus(change.offset[1])
    # The rotation is a quarter turn; its double is off by less than U.
    turned = rows.state[THETA].plus(change.rotation).widen(U)
    for component, models in ((S, moved_s), (F, moved_f), (THETA, turned)):
        c[:, component], radius[component] = models.c, models.radius
    return replace(rows, frame=np.full(len(rows), change.to), state=Models(c, radius))


def uncovered(low: Array, high: Array, lows: Array, highs: Array) -> tuple[Array, Array]:
    """Return the gaps in pieces [low, high] that intervals [lows, highs] leave.

    There should be none: this guards against a row that was lost on the way. Gaps that may be
    due to rounding are left out.
    """
    order = np.argsort(lows)
    begins = np.concatenate([[-1.0], np.maximum.accumulate(highs[order])])
    ends = np.concatenate([lows[order], [1.0]])
    wide = ends > begins + GAP
    gap_low = np.maximum(low, begins[wide, None]).ravel()
    gap_high = np.minimum(high, ends[wide, None]).ravel()
    lost = gap_high > gap_low + GAP
    return gap_low[lost], gap_high[lost]
