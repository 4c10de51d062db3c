"""The rules that concern rows together: kinds, cover by roots and by parts, cases, elsewhere."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field
from math import comb
from typing import Any

import numpy as np
from flint import arb

from checker.files import NAMES, Certificate, GuardKind, Instance, Kind, Rejected, Row, require
from checker.models import BASE, KNOWN, ONE, ZERO, magnitude

#: A part may be given with a half width that is larger by this, relative and absolute: room
#: for rounding. The parent's x is then (lo + hi) / 2 + half x with the larger half.
WIDER = arb(1) + arb(2) ** -40, arb(2) ** -50


@dataclass
class Assumed:
    """What a row assumes in its step: signs of crosses, being inside the turn or not, its frame.

    settled: the frame does not change in this step, or just has; origin: the first row of the step,
    before parts, or the advanced one.
    """

    crosses: dict[tuple[int, ...], bool] = field(default_factory=dict)
    turn: bool | None = None
    settled: bool = False
    origin: int = -1


def cover(intervals: Iterable[tuple[Any, Any]], low: Any, high: Any, what: str) -> None:
    """Prove that closed intervals cover [low, high]."""
    met = False
    for begin, end in sorted(intervals, key=lambda p: float(p[0])):
        if begin <= low and end >= low:
            met, low = True, end
    require(met and low >= high, f"{what} leave a gap")


class Forest:
    """Rows with what follows from each; ``check`` proves all rules that need no step.

    children: by parent; sources: the rows that go into a gathered one.
    """

    def __init__(self, cert: Certificate, instance: Instance) -> None:
        data = instance.data
        self.rows, self.guards, self.missing = cert.rows, cert.guards, cert.missing
        self.frames, self.steps = data["plant"]["frames"], int(data["steps"])
        self.box = [tuple(map(arb, data["initial_set"][name])) for name in NAMES]
        self.lead = cert.lead
        self._fault = data.get("disturbance") or {}
        self._rays = int(data["plant"]["lidar"]["rays"])
        self.children: list[list[int]] = [[] for _ in cert.rows]
        self.sources: list[list[int]] = [[] for _ in cert.rows]
        for i, row in enumerate(cert.rows):
            require(-1 <= row.parent < i, f"row {i}: its parent does not come before it")
            require(row.into < len(cert.rows), f"row {i}: it goes into a row that is not there")
            if row.parent >= 0:
                self.children[row.parent].append(i)
            if row.into >= 0:
                self.sources[row.into].append(i)

    def check(self) -> None:
        """Prove what takes little time; Rejected if that fails."""
        require(0 <= self.lead < len(NAMES), "there is no such lead component")
        spans: list[dict[int, tuple[arb, arb]]] = [{} for _ in self.missing]
        for i, row in enumerate(self.rows):
            try:
                self._check_place(i, row)
                self._check_followers(i, row)
                if row.kind == Kind.ROOT:
                    spans[row.case][i] = self._start(row)
            except Rejected as error:
                raise Rejected(f"row {i}: {error}") from None
        self._check_cases()
        for case, span in enumerate(spans):
            low, high = self.box[self.lead]
            cover(span.values(), low, high, f"the roots of case {case}")
        for i, row in enumerate(self.rows):
            if row.elsewhere:
                self._check_elsewhere(i, spans[row.case])

    def _check_place(self, i: int, row: Row) -> None:
        """Prove that a row fits its parent, and the row that it goes into."""
        low, high = row.piece.T
        require((low >= -1).all() and (high <= 1).all(), "its piece is not in [-1, 1]")
        require((low <= high).all(), "its piece is empty")
        require((row.radius >= 0).all(), "a radius is negative")
        limits = self.steps + 1, len(self.frames), len(self.missing)
        there = all(0 <= x < limit for x, limit in zip(row[:3], limits, strict=True))
        require(there, "its step, frame or case is not there")
        if row.into >= 0:
            whole = self.rows[row.into]
            fits = whole.kind == Kind.GATHERED and whole[:3] == row[:3]
            require(fits, "it goes into a row of another kind, step, frame or case")
            require(row.into > i, "it goes into a row that does not come after it")
        if row.parent < 0:
            require(row.kind in (Kind.ROOT, Kind.GATHERED), "it has no parent, but is no root")
            start = row.kind == Kind.GATHERED or (row.step, row.frame) == (0, 0)
            require(start and row.guard == -1, "it is not at the start, or assumes something")
            own = len(row.spread[0]) < KNOWN or not row.spread[:, BASE:KNOWN].any()
            require(own, "its symbols are products where they have to be its own")
            return
        kinds = Kind.PART, Kind.IMAGE, Kind.ADVANCE
        require(row.kind in kinds, "it has a parent, but its kind has none")
        parent = self.rows[row.parent]
        frame = parent.frame
        if row.kind == Kind.ADVANCE:
            require(self.frames[frame]["advance"] is not None, "its frame has no next one")
            frame = self.frames[frame]["advance"]["to"]
        place = parent.step + (row.kind == Kind.IMAGE), frame, parent.case
        require(row[:3] == place, f"its step, frame and case are not {place}")
        if row.kind == Kind.IMAGE:
            whole_image = (low == -1).all() and (high == 1).all() and row.guard == -1
            require(whole_image, "it is not a whole image")

    def _check_followers(self, i: int, row: Row) -> None:
        """Prove that a row is followed by what it has to be, and parts without guards cover it."""
        children = [self.rows[c] for c in self.children[i]]
        if row.elsewhere or row.into >= 0 or row.step == self.steps:
            require(not children, "rows follow where none should")
            return
        require(children, "nothing follows it")
        if any(c.kind == Kind.IMAGE for c in children):
            require(len(children) == 1, "it has an image and other children")
        elif any(c.guard != -1 for c in children):
            self._check_guarded(i, row, children)
        else:
            require(all(c.kind == Kind.PART for c in children), "it advances without a guard")
            pieces = [[(a, b) for a, b in c.piece.tolist()] for c in children]
            cut = {k for piece in pieces for k, ends in enumerate(piece) if ends != (-1, 1)}
            require(len(cut) <= 1, "its parts differ in more than one parameter")
            cover([piece[min(cut, default=0)] for piece in pieces], -1.0, 1.0, "its parts")

    def _check_guarded(self, i: int, row: Row, children: list[Row]) -> None:
        there = all(0 <= c.guard < len(self.guards) for c in children)
        require(there, "it has parts with a guard and without, or one that is not there")
        guards, frame = [self.guards[c.guard] for c in children], self.frames[row.frame]
        require(len({g[:5] for g in guards}) == 1, "its parts assume different guards")
        require(len({g.positive for g in guards}) == len(guards), "two parts assume the same sign")
        kind, ray, obstacle, front, back, _ = guards[0]
        if kind == GuardKind.CROSS:
            there = 0 <= ray < self._rays and 0 <= obstacle < len(frame["obstacles"])
            faces = range(len(frame["obstacles"][obstacle])) if there else ()
            there = front in faces and back in faces and front != back
            require(there, "a guard is of a ray or face that is not there")
        elif kind == GuardKind.ADVANCE:
            known = self.assumptions(i)
            fresh = not known.settled and self.rows[known.origin].kind != Kind.GATHERED
            due = frame["advance"] is not None and row.step > 0 and fresh
            require(due, "no frame is due to change")
        else:
            require(kind == GuardKind.TURN, "a guard is of no known kind")
        for c, guard in zip(children, guards, strict=True):
            fits = (c.kind == Kind.ADVANCE) == (kind == GuardKind.ADVANCE and guard.positive)
            require(fits, "it advances, or does not, against its guard")

    def assumptions(self, i: int) -> Assumed:
        """Return what a row and its ancestors in the same step (and frame) assume."""
        found, row = Assumed(), self.rows[i]
        while row.kind == Kind.PART:
            if row.guard >= 0:
                guard = self.guards[row.guard]
                if guard.kind == GuardKind.CROSS:
                    found.crosses.setdefault(guard[1:5], guard.positive)
                elif guard.kind == GuardKind.TURN:
                    found.turn = guard.positive
                else:
                    found.settled = True
            i = row.parent
            row = self.rows[i]
        found.settled |= row.kind == Kind.ADVANCE
        found.origin = i
        return found

    def _check_cases(self) -> None:
        """Prove that there is every case of missing rays that the instance allows.

        That each has roots follows from their cover of the start set.
        """
        most = int(self._fault.get("missing", 0))
        require(self.missing.shape[1] == self._rays, "the cases are of another number of rays")
        if most > 0 and self._fault.get("choice", "run") == "step":
            all_may = len(self.missing) == 1 and self.missing.all()
            require(all_may, "the case is not that all rays may be missing")
            return
        sets = {tuple(mask.nonzero()[0].tolist()) for mask in self.missing}
        wanted = sum(comb(self._rays, k) for k in range(most + 1))
        found = sum(len(x) <= most for x in sets)
        require(found == wanted, "a case of missing rays is left out")

    def _start(self, row: Row) -> tuple[arb, arb]:
        """Prove that a root covers all but the lead component; return the lead's interval."""
        bent, spread = row.centre[:, 1:].copy(), row.spread[:, :, 0]
        bent[self.lead, 0] = 0
        require(not bent.any() and not row.spread[:, :, 1].any(), "it is not an axis-aligned box")
        own = ((spread != 0).sum(axis=0) <= 1).all() and not spread[self.lead].any()
        require(own, "its symbols are mixed")
        arms = np.column_stack([row.centre[:, 1], row.radius, spread]).tolist()
        reach = [magnitude(list(map(arb, arm))) for arm in arms]
        spans = [
            (arb(c) - r, arb(c) + r) for c, r in zip(row.centre[:, 0].tolist(), reach, strict=True)
        ]
        for k, ((low, high), span) in enumerate(zip(self.box, spans, strict=True)):
            covers = k == self.lead or (span[0] <= low and span[1] >= high)
            require(covers, f"it does not cover the start set's {NAMES[k]}")
        return spans[self.lead][0].upper(), spans[self.lead][1].lower()

    def _check_elsewhere(self, i: int, spans: dict[int, tuple[arb, arb]]) -> None:
        """Prove that later roots cover what a row that is given up has of the lead component."""
        uncertain = sum(bool(low < high) for low, high in self.box)
        require(uncertain <= 1, f"row {i}: elsewhere, with an initial set not 1-D")
        root, pieces = i, []
        while self.rows[root].parent >= 0:
            pieces.append(self.rows[root].piece[0].tolist())
            root = self.rows[root].parent
        require(self.rows[root].kind == Kind.ROOT, f"row {i}: elsewhere, and in no root")
        middle, half = ZERO, ONE
        for low, high in reversed(pieces):
            if (low, high) != (-1, 1):
                exact = (arb(high) - low) / 2
                middle += half * (arb(low) + high) / 2
                half *= exact.union(exact * WIDER[0] + WIDER[1])  # whichever it is
        row = self.rows[root]
        (a, b, *_), radius = (
            map(arb, row.centre[self.lead].tolist()),
            arb(float(row.radius[self.lead])),
        )
        # Not as a ball: its radius would be rounded to 30 bits.
        ends = [a + b * x for x in (middle - half, middle + half)]
        begin = (ends[0].min(ends[1]) - radius).lower().max(self.box[self.lead][0])
        end = (ends[0].max(ends[1]) + radius).upper().min(self.box[self.lead][1])
        later = [span for k, span in spans.items() if k > root]
        cover(later, begin, end, f"row {i}: it is elsewhere, but later roots")
