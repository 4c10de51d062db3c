"""Proving one box of start states safe: rows go through the control steps together.

A row whose walls are not clear is cut where they change; a row whose models get too coarse,
or whose margin cannot be shown, is split in halves and does the step again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from verifier.clearance import least_margin
from verifier.cuts import parts
from verifier.models import Array, Models, error_spread
from verifier.motion import Motion, new_error, total_error
from verifier.network import Network
from verifier.problem import Box, Problem, start_rows
from verifier.rounding import U
from verifier.rows import THETA, F, Rows, S, consolidate, join
from verifier.scan import Guards, Scanner

#: Rows treated at once: bounds the memory.
BATCH = 48
#: A row narrower than this (of the box's 2) is given up rather than split.
NARROWEST = 1e-9
#: A row whose errors (m, rad) exceed this is given up.
COARSEST = 1e-2
#: A row is given up if splitting did not bring the error of a step below this share: it stems
#: from the errors that the row came with.
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
        self._alike = alike
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
        return Proof(bad.low, bad.high, least, len(rows))

    def _step(self, rows: Rows, tolerance: float, failed: list[Rows]) -> Rows:
        """Take all rows through one control step."""
        todo, done = [rows], []
        while todo:
            self._check()
            batch = todo.pop()
            if len(batch) > BATCH:
                todo.append(batch.take(np.arange(BATCH, len(batch))))
                batch = batch.take(np.arange(BATCH))
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
        scan = self._scanners[frame].measure(rows, 0.1 * tolerance)
        blocked = scan.unclear.copy()
        blocked[scan.guards.row] = True
        again = self._cut(rows, scan.guards, scan.unclear, failed)
        clear = np.flatnonzero(~blocked)
        if not clear.size:
            return again, rows.take(clear)
        rows = rows.take(clear)
        with np.errstate(invalid="ignore", over="ignore"):  # rows too wide; sorted out below
            steering = self._network.steering(scan.distance[:, clear])
            path = self._motion.drive(rows.state, steering)
        error = new_error(path.state)
        error = np.where(np.isfinite(error), error, np.inf)
        fine = error <= tolerance + KINK_GAIN * rows.kink
        least = np.full(len(rows), -np.inf)
        clear = np.flatnonzero(fine)
        least[clear] = least_margin(
            path.take(clear), self._problem.safety.unsafe[frame], self._wanted
        )
        lost = ~(total_error(rows.state) <= COARSEST) | (~fine & ~(error <= FUTILE * rows.tried))
        if lost.any():
            failed.append(rows.take(lost))
        good = fine & (least > 0) & ~lost
        retry = np.flatnonzero(~good & ~lost)
        again += self._halve(replace(rows.take(retry), tried=error[retry]), failed)
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
        give_in = undecided & (inherent | (overlap > 1) | narrow) & (chosen.kink < fails)
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
        end, middle = np.ones(len(rows)), np.zeros(len(rows))
        return [rows.restrict(-end, middle), rows.restrict(middle, end)]

    def _advance(self, rows: Rows) -> Rows:
        """Describe rows that are mostly in the next hall in its frame; the set is the same."""
        frame, c, radius = rows.frame.copy(), rows.state.c.copy(), rows.state.radius.copy()
        for index in np.unique(rows.frame):
            change = self._problem.plant.track.frames[index].advance
            if change is None:
                continue
            middle = rows.state.c[0]
            value = change.guard[0] * middle[S] + change.guard[1] * middle[F]
            now = np.flatnonzero((rows.frame == index) & (value > change.guard[2]))
            if not now.size:
                continue
            (a, b), (d, e) = change.matrix
            s, f = rows.state[S][now], rows.state[F][now]
            moved_s = (s.times(a) + f.times(b)).plus(change.offset[0])
            moved_f = (s.times(d) + f.times(e)).plus(change.offset[1])
            # The rotation is a quarter turn; its double is off by less than U.
            turned = rows.state[THETA][now].plus(change.rotation).widen(U)
            for component, models in ((S, moved_s), (F, moved_f), (THETA, turned)):
                c[:, component, now], radius[component, now] = models.c, models.radius
            frame[now] = change.to
        return replace(rows, frame=frame, state=Models(c, radius))
