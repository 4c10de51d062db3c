"""Proving start states safe: rows go through the control steps together.

A row whose walls are not clear is cut where they change; a row whose models get too coarse,
or whose margin cannot be shown, is split in halves and does the step again.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from racecar.instance import Disturbance
from verifier import disturbed
from verifier.arithmetic import KNOWN
from verifier.clearance import least_margin
from verifier.divide import Divider, sharpest, shrunk, widest
from verifier.elementary import SIN_COS_RANGE
from verifier.gather import gather, gathered, stale
from verifier.lohner import consolidate
from verifier.models import Array, Models, norm
from verifier.motion import Motion, extent, new_error, total_error
from verifier.network import Network
from verifier.policy import NARROW, WIDE, Policy
from verifier.problem import ACTIVE, Box, Problem, start_rows
from verifier.queue import Queue
from verifier.record import Record
from verifier.rounding import U
from verifier.rows import THETA, Rows, join
from verifier.scan import Guards, Scan, Scanner

#: Rows treated at once: bounds the memory.
BATCH = 48
#: Wide rows are put together every so many steps, where they have grown together.
GATHER = 4
#: A gap between rows (of the box's 2) that may be due to rounding alone.
GAP = 1e-10
#: An error that splitting did not help against may grow by this from step to step.
BORNE = 1.3
#: What a step adds to the errors is taken larger by this, too (Policy.slack says how much else).
TAIL = 1e-18
#: What noise does in a step, a symbol of its own, is taken larger by this.
PUSH_SLACK = 1.02
#: The policy's slack where a kink was kept: there the bounds depend on details. (Wide rows, which
#: are full of kinks, would grow too much.)
KINK_SLACK = 2.0


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


class OutOfTime(Exception):
    """The time limit was reached."""


class TooManyRows(Exception):
    """A proof took more rows than it was allowed."""


class Prover:
    """Proves boxes of one problem; ``check`` is called often and may raise OutOfTime.

    decided(share) is called often, with a function that returns the share of the pieces at hand
    that is proved. to_corner: runs end as soon as they are in the next hall's frame, and are to
    get there within the problem's steps; wide: whether errors are followed and divided like start
    positions, if that is not as the problem suggests; policy: when rows are accepted, if that is
    not as usual; most_rows: a proof that treats more of them raises TooManyRows. Raises
    disturbed.TooManyChoices.
    """

    def __init__(
        self,
        problem: Problem,
        wanted: float,
        check: Callable[[], None] = lambda: None,
        record: Record | None = None,
        decided: Callable[[Callable[[], float]], None] = lambda share: None,
        to_corner: bool = False,
        wide: bool | None = None,
        policy: Policy | None = None,
        most_rows: float = np.inf,
    ) -> None:
        self._problem = problem
        self._wide = problem.wide if wide is None else wide
        self._to_corner = to_corner
        #: Rows that came into the next hall's frame, if the runs are to end there.
        self.arrived: list[Rows] = []
        self._disturbance = problem.disturbance or Disturbance.model_construct(
            noise=0.0, missing=0, turn_only=True, choice="run"
        )
        self._missing = disturbed.cases(problem.disturbance, problem.plant.lidar.rays)
        self._policy = policy or (WIDE if self._wide else NARROW)
        self._most_rows, self._treated = most_rows, 0
        self._wanted = wanted
        self._check = check
        self._record = record
        self._decided = decided
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
        self._divider = Divider(record, self._wide)
        #: Error symbols that keep their meaning from step to step, and all of a row between steps.
        self._carried = KNOWN if self._wide else 0
        self._symbols = self._carried + len(ACTIVE)
        #: Seconds spent in enclosures of the network.
        self.network_time_s = 0.0

    @property
    def cuts(self) -> int:
        """How often a row was cut in two at a change of walls."""
        return self._divider.cuts

    def prove(
        self, box: Box, low: Array, high: Array, tolerance: float, case: int = 0, frame: int = 0
    ) -> Proof:
        """Prove pieces [low, high] of a box; tolerance: for the error of one step."""
        divider, steps = self._divider, self._problem.steps
        self._treated = 0
        divider.failed, divider.step, self.arrived = [], 0, []
        rows = start_rows(box, low, high, case, self._carried)
        rows = replace(rows, frame=np.full(len(low), frame))
        if self._record is not None:
            rows = replace(rows, node=self._record.roots(rows, low, high))
        queue = Queue(rows, steps, BATCH, GATHER if self._wide else 0)
        while queue:
            if (met := queue.together()) is not None:
                queue.put(met[0], self._gather(*met))
            step, rows = queue.take()
            divider.step = step
            self._decided(lambda: queue.finished(divider.failed))
            queue.done(step, self._step(rows, tolerance))
        if self._to_corner:
            for rows in queue.ended:
                divider.give_up(rows)
            queue.ended = []
        leaves = queue.ended + self.arrived
        bad = join(divider.failed) if divider.failed else rows.take(np.zeros(len(rows), bool))
        # low and high of a row are rounded anew at each of the restrictions that made it.
        pad = 8 * U * divider.restrictions
        ends = [r for r in (*leaves, bad) if len(r)]
        lost = uncovered(
            low, high, np.concatenate([r.low for r in ends]), np.concatenate([r.high for r in ends])
        )
        open_low = np.concatenate([bad.low, lost[0]]) - pad
        open_high = np.concatenate([bad.high, lost[1]]) + pad
        return Proof(
            np.maximum(open_low, -1),
            np.minimum(open_high, 1),
            min((float(r.least.min()) for r in leaves), default=np.inf),
            sum(map(len, leaves)),
        )

    def _anew(self, rows: Rows) -> Rows:
        """Describe rows anew, each by itself: their errors become first symbols."""
        each, step = [rows.take(np.array([i])) for i in range(len(rows))], self._divider.step
        return join([self._noted(step, row, gathered(row, self._symbols).rows) for row in each])

    def _noted(self, step: int, some: Rows, whole: Rows) -> Rows:
        if self._record is None:
            return whole
        return replace(whole, node=self._record.gathered(some, step, whole))

    def _gather(self, step: int, rows: Rows) -> Rows:
        """Put rows together that have grown together."""
        note = partial(self._noted, step)
        done: list[Rows] = []
        for frame, case in sorted(set(zip(rows.frame.tolist(), rows.case.tolist(), strict=True))):
            mine = rows.take((rows.frame == frame) & (rows.case == case))
            done += gather(mine, self._symbols, note)
        return join(done)

    def _step(self, rows: Rows, tolerance: float) -> Rows:
        """Take all rows through one control step."""
        todo, done = [rows], []
        while todo:
            self._check()
            batch = todo.pop()
            if len(batch) > BATCH:
                todo.append(batch.take(np.arange(BATCH, len(batch))))
                batch = batch.take(np.arange(BATCH))
            batch = self._usable(batch)
            if not len(batch):
                continue
            shapes = self._alike[batch.frame]
            if shapes.min() != shapes.max():
                todo += [batch.take(shapes == shape) for shape in np.unique(shapes)]
                continue
            self._treated += len(batch)
            if self._treated > self._most_rows:
                raise TooManyRows
            again, finished = self._attempt(batch, tolerance)
            # Joined, so that the next batches are full.
            again = [r for r in again if len(r)]
            if again:
                todo.append(join(again))
            if len(finished):
                done.append(finished)
        return join(done) if done else rows.take(np.zeros(len(rows), dtype=bool))

    def _usable(self, rows: Rows) -> Rows:
        """Give up rows that are too coarse; sin and cos are not known of a wild heading."""
        turned = norm(rows.state.c[:, THETA]) + rows.state.radius[THETA]
        fit = (turned < SIN_COS_RANGE) & (total_error(rows.state) <= self._policy.coarsest)
        if fit.all():
            return rows
        self._divider.give_up(rows.take(~fit))
        return rows.take(fit)

    def _attempt(self, rows: Rows, tolerance: float) -> tuple[list[Rows], Rows]:
        """Return rows that do the step again, and rows that have done it."""
        frame, divider, policy = int(rows.frame[0]), self._divider, self._policy
        came = total_error(rows.state)
        kink = max(0.1 * tolerance, policy.kink * float(came.max()))
        scan = self._scanners[frame].measure(rows, kink)
        region = self._region(rows)
        guards, unclear = _together(scan, region)
        blocked = unclear.copy()
        blocked[guards.row] = True
        again = divider.cut(rows, guards, unclear)
        clear = np.flatnonzero(~blocked)
        if not clear.size:
            return again, rows.take(clear)
        rows, came, inside = rows.take(clear), came[clear], region.inside[clear]
        with np.errstate(invalid="ignore", over="ignore"):  # rows too wide; sorted out below
            distance = scan.distance[:, clear]
            began = time.perf_counter()
            steering = self._steering(rows, distance, inside)
            self.network_time_s += time.perf_counter() - began
            path = self._motion.drive(rows.state, steering)
        error = new_error(path.state)
        error = np.where(np.isfinite(error), error, np.inf)
        # Splitting does not help where the errors are wider than the piece.
        dominated = (came > 0.5 * extent(rows.state)) & (not self._wide)
        kinks = np.minimum(policy.gain * rows.kink, policy.kinked * came)
        # What noise does in this step: symbols that the state did not come with.
        pushed = norm(path.state.c[len(rows.state.c) :]).max(axis=0)
        fine = error <= tolerance + kinks + policy.growth * came + policy.push * pushed
        # Errors that are there anyway are borne, unless they are worse than all before.
        most = policy.bearable * (came + pushed)
        bearable = np.isfinite(error) & ((error <= most) | (not self._wide))
        futile = bearable & ((error > policy.futile * rows.tried) | (error <= BORNE * rows.borne))
        forced = np.isinf(rows.kink)
        fine |= futile | (np.isfinite(error) & (dominated | forced))
        least = np.full(len(rows), -np.inf)
        clear = np.flatnonzero(fine)
        unsafe = self._problem.safety.unsafe[frame]
        least[clear] = least_margin(path.take(clear), unsafe, self._wanted)
        good = fine & (least > 0)
        lost = (dominated | forced) & ~good
        divider.give_up(rows.take(lost))
        retry = np.flatnonzero(~good & ~lost)
        again += self._finer(rows.take(retry), distance[:, retry], inside[retry], error[retry])
        rows = replace(rows, borne=np.where(futile, error, 0.0))
        return again, self._after(rows.take(good), path.state[:, np.flatnonzero(good)], least[good])

    def _region(self, rows: Rows) -> disturbed.Region:
        """Return where rays are missing."""
        given = self._disturbance
        missing = np.asarray(self._missing.any(axis=1))[rows.case]
        return disturbed.region(rows, missing, given.turn_only, self._problem.plant.track.width)

    def _steering(self, rows: Rows, distance: Models, inside: NDArray[np.bool_]) -> Models:
        given, reach = self._disturbance, self._problem.plant.lidar.range
        if given.missing and given.choice == "step":
            return disturbed.steering_of_choices(
                self._network, distance, inside, given.missing, given.noise, reach
            )
        if given.missing:
            gone = self._missing[rows.case].T & inside[None, :]
            distance = disturbed.without(distance, gone, reach)
        if self._wide:
            return disturbed.steering_apart(self._network, distance, given.noise)
        return self._network.steering(distance)

    def _finer(
        self, rows: Rows, distance: Models, inside: NDArray[np.bool_], error: Array
    ) -> list[Rows]:
        """Return rows in place of those whose step errs by too much: halves, or the same anew."""
        divider, along = self._divider, sharpest(distance)
        if not self._wide or not len(rows):
            return divider.halve(replace(rows, tried=error), along)
        # Either the symbol by which the scan is known least, or x, whichever helps the network;
        # if the last of these halves did not help, the widest.
        halves = [shrunk(distance, a) for a in (np.zeros_like(along), along)]
        left = [self._steering(rows, half, inside).radius for half in halves]
        along = np.where(left[0] < left[1], 0, along)
        along = np.where(error > self._policy.futile * rows.tried, widest(rows), along)
        old = stale(rows.state) & np.array([not d for d in rows.decisions])
        finer = divider.halve(replace(rows.take(~old), tried=error[~old]), along[~old])
        return [*finer, *([self._anew(rows.take(old))] if old.any() else [])]

    def _after(self, rows: Rows, state: Models, least: Array) -> Rows:
        """Return the rows that have done the step, in the frames that they are in now."""
        divider, count = self._divider, len(rows)
        if not count:
            return rows
        kinked = (rows.kink > 0) & (not self._wide)
        slack = np.where(kinked, KINK_SLACK, self._policy.slack)
        c = state.c.copy()
        c[len(rows.state.c) :] *= PUSH_SLACK
        state = Models(c, state.radius * slack + TAIL)
        rows = replace(
            rows,
            state=consolidate(state, list(ACTIVE), self._carried),
            least=np.minimum(rows.least, least),
            decisions=((),) * count,
            kink=np.zeros(count),
            tried=np.full(count, np.inf),
        )
        divider.step += 1
        if self._record is not None:
            rows = replace(rows, node=self._record.images(rows, divider.step))
        done: list[Rows] = []
        for index in np.unique(rows.frame):
            mine = rows.take(rows.frame == index)
            change = self._problem.plant.track.frames[index].advance
            for part in [mine] if change is None else divider.advance(mine, change):
                moved = self._to_corner and part.frame[0] != index
                (self.arrived if moved else done).append(part)
        divider.step -= 1
        return join(done) if done else rows.take(np.zeros(count, dtype=bool))


def _together(scan: Scan, region: disturbed.Region) -> tuple[Guards, NDArray[np.bool_]]:
    """Return the guards of scan and region, and the rows that have to be split."""
    unclear = scan.unclear | region.unclear
    if region.guards is None:
        return scan.guards, unclear
    parts = [scan.guards, region.guards]
    return Guards(
        Models(
            np.concatenate([p.models.c for p in parts], axis=-1),
            np.concatenate([p.models.radius for p in parts]),
        ),
        np.concatenate([p.fails for p in parts]),
        np.concatenate([p.row for p in parts]),
        tuple(d for p in parts for d in p.decisions),
    ), unclear


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
