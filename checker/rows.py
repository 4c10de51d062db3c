"""What is proved of each row: its parts, its image, its clearance."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice

import numpy as np
from flint import arb
from numpy.typing import NDArray

from checker.balls import Balls
from checker.batch import of_models, of_rows
from checker.batch_inclusion import hold_images
from checker.batch_lidar import readings
from checker.batch_network import BatchNetwork
from checker.batch_step import Arcs
from checker.files import Certificate, GuardKind, Instance, Kind, Rejected, Row, Unreadable, require
from checker.forest import WIDER, Assumed, Forest
from checker.inclusion import (
    Cuts,
    models_of,
    prove_gathered,
    prove_image,
    prove_part,
    restricted,
    state_of,
)
from checker.models import (
    BASE,
    KNOWN,
    ONE,
    TERMS,
    ZERO,
    Model,
    bound,
    halves,
    line,
    magnitude,
    negative,
    plus,
    positive,
    restrict,
    symbols,
)
from checker.step import Motion, Network, Path, Sensors, View, choices, steering

#: Parts of a row whose step cannot be proved at once are halved, at most so many of them: enough
#: to come close to a kink that sits at an end of the row.
_HALVED = 40


class Checker:
    """Checks a certificate of an instance: ``check_all`` and then ``check_row`` of every row."""

    def __init__(self, cert: Certificate, instance: Instance) -> None:
        try:
            self.plant, self.unsafe = instance.data["plant"], instance.data["property"]["unsafe"]
            self.frames = self.plant["frames"]
            self.sensors, self.network = Sensors(instance.data), Network(instance.layers)
            self._batch, self._motion = BatchNetwork(instance.layers), Motion(self.plant)
            self.forest = Forest(cert, instance)
            self._check_instance()
        except (KeyError, TypeError, ValueError, IndexError) as error:
            raise Unreadable(f"the instance lacks something or has it wrong: {error}") from None
        self.rows, self.margin = cert.rows, cert.margin
        self.symbols = cert.symbols
        # All but the last three symbols mean the same from row to row.
        self.carried = max(cert.symbols - 3, 0)
        require(cert.instance_sha256 == instance.sha256, "it is of another instance")
        require(cert.weights_sha256 == instance.weights_sha256, "of another network")
        few = cert.symbols == 3 and not self.sensors.apart
        require(few or cert.symbols >= KNOWN + 3, f"{cert.symbols} symbols do not fit the instance")
        self.sensors.apart = not few
        m = cert.symbols + (self.sensors.rays.count if self.sensors.apart else 0)
        self._at_once = self._batch.at_once(TERMS + 2 * m + 1)
        require(self.margin > 0, "the claimed margin is not positive")
        unknown = sorted(self.sensors.unknown)
        require(not unknown, f"nothing can be proved of a disturbance by {', '.join(unknown)}")

    def _check_instance(self) -> None:
        for frame in self.frames:
            advance = frame["advance"]
            if advance is not None and abs(abs(float(advance["rotation"])) * 2 - 3.141592653589793):
                raise ValueError("a frame's rotation is not a quarter turn")
        ordered = all(low <= high for low, high in self.forest.box)
        if len(self.unsafe) != len(self.frames) or not ordered:
            raise ValueError("frames, unsafe sets or initial set do not fit together")
        if not (self.sensors.noise >= 0 and self.sensors.missing >= 0):
            raise ValueError("a disturbance is negative")
        if self.network.rays != self.sensors.rays.count:
            raise ValueError("the network reads another number of rays")

    def check_all(self) -> None:
        """Prove what takes little time: the rules that concern rows together."""
        self.forest.check()

    def check_rows(self, indices: list[int]) -> None:
        """Prove that what follows each of some rows contains all that may become of it, safely."""
        answers = self._answers([i for i in indices if self._drives(i)])
        proved = self._driven(answers)
        for i in indices:
            self.check_row(i, answers.get(i), i in proved)

    def check_row(self, i: int, answers: list[Model] | None = None, proved: bool = False) -> None:
        """Prove that what follows a row contains all that may become of it, safely.

        answers: of the network to the row's scans, if they are known; proved: whether they are
        known to take the row safely into its image.
        """
        row, children = self.rows[i], self.forest.children[i]
        try:
            if row.into >= 0:
                prove_gathered(models_of(row, apart=True), self.rows[row.into])
            elif self._drives(i):
                self._check_step(i, self.rows[children[0]], answers, proved)
            elif children:
                self._check_parts(row, [self.rows[c] for c in children])
        except (Rejected, ArithmeticError, ValueError) as error:  # whatever is not proved
            raise Rejected(f"row {i}: {error}") from None

    def _drives(self, i: int) -> bool:
        """Tell whether a row has an image."""
        children = self.forest.children[i]
        image = bool(children) and self.rows[children[0]].kind == Kind.IMAGE
        return image and self.rows[i].into < 0

    # --- parts -----------------------------------------------------------------------------

    def _check_parts(self, row: Row, children: list[Row]) -> None:
        state = models_of(row, apart=True)
        for c in children:
            _prove_piece(self._advanced(state, row) if c.kind == Kind.ADVANCE else state, c)
        if children[0].guard >= 0:
            self._check_guards(row, children)

    def _advanced(self, state: list[Model], row: Row) -> list[Model]:
        """Return a state in the next hall's frame."""
        change, (s, f, v, theta) = self.frames[row.frame]["advance"], state
        (a, b), (c, d) = change["matrix"]
        p, q = change["offset"]
        quarter = arb.pi() / 2 if change["rotation"] > 0 else -arb.pi() / 2
        return [line((a, b, -p), s, f), line((c, d, -q), s, f), v, plus(theta, quarter)]

    def _advance_value(self, state: list[Model], row: Row) -> Model:
        return line(self.frames[row.frame]["advance"]["guard"], state[0], state[1])

    def _view(self, row: Row, state: list[Model], assumed: Assumed) -> View:
        return View(self.sensors.rays, self.frames[row.frame]["obstacles"], state, assumed.crosses)

    def _guard_values(self, row: Row, index: int) -> list[Model]:
        """Return models of which a guard is the least."""
        guard, state = self.forest.guards[index], state_of(row)
        if guard.kind == GuardKind.ADVANCE:
            return [self._advance_value(state, row)]
        if guard.kind == GuardKind.TURN:
            return self.sensors.turn(state)
        front, back = ((guard.obstacle, k) for k in (guard.front, guard.back))
        view = self._view(row, state, Assumed())
        return [view.along(view.cross(front, back), guard.ray)]

    def _check_guards(self, row: Row, children: list[Row]) -> None:
        """Prove that outside of each sign's part the guard has the other sign."""
        guards = self.forest.guards
        values = self._guard_values(row, children[0].guard)
        pieces = {guards[c.guard].positive: c.piece.tolist() for c in children}
        for sign, word in ((True, "positive"), (False, "negative")):
            outside = [(0, -ONE, ONE)]
            if sign in pieces:
                outside = [(k, -ONE, arb(a)) for k, (a, _) in enumerate(pieces[sign]) if a > -1]
                outside += [(k, arb(b), ONE) for k, (_, b) in enumerate(pieces[sign]) if b < 1]
            for part in outside:
                proved = _has_sign([restrict(z, *part) for z in values], not sign)
                require(proved, f"its guard may be {word} outside of the part that assumes it")

    # --- steps -----------------------------------------------------------------------------

    def settled(self, i: int) -> bool:
        """Tell whether the members of a row are in the frame in which they drive."""
        row, assumed = self.rows[i], self.forest.assumptions(i)
        if self.frames[row.frame]["advance"] is None or row.step == 0 or assumed.settled:
            return True
        value = self._advance_value(state_of(row), row)
        if bound(value) <= 0 or positive(negative(value)):
            return True
        gathered = self.rows[assumed.origin].kind == Kind.GATHERED
        return gathered and all(map(self.settled, self.forest.sources[assumed.origin]))

    def _choices(self, i: int, state: list[Model]) -> list[list[int]]:
        """Return which rays may be missing together on (a part of) a row."""
        case = self.forest.missing[self.rows[i].case].nonzero()[0].tolist()
        assumed = self.forest.assumptions(i).turn
        return choices(
            self.sensors, case, self.sensors.active(state, assumed) if case else (False, True)
        )

    def _answers(self, indices: list[int]) -> dict[int, list[Model]]:
        """Return the network's answers to the scans of rows, of those for which it has bounds."""
        ahead, found, lost = self._scans_ahead(indices), dict[int, list[Model]](), set[int]()
        while batch := list(islice(ahead, self._at_once)):
            answers = self._batch.steering([scan for _, scan in batch])
            for (i, _), answer in zip(batch, answers, strict=True):
                if answer is None:
                    lost.add(i)
                else:
                    found.setdefault(i, []).append(answer)
        return {i: answers for i, answers in found.items() if i not in lost}

    def _scans_ahead(self, indices: list[int]) -> Iterator[tuple[int, Balls]]:
        """Yield what the network may read on rows, for all choices, if all of it has bounds."""
        for frame in {self.rows[i].frame for i in indices}:
            mine = [i for i in indices if self.rows[i].frame == frame]
            obstacles = self.frames[frame]["obstacles"]
            crosses = [self.forest.assumptions(i).crosses for i in mine]
            states = of_rows([self.rows[i] for i in mine])
            read, proved = readings(self.sensors.rays, obstacles, states, crosses)
            asked: dict[tuple[int, ...], list[int]] = {}
            for k, i in enumerate(mine):
                try:
                    self._complete(read.at(k), proved[k], i)
                    found = self._choices(i, state_of(self.rows[i]))
                except (Rejected, ArithmeticError, ValueError):
                    continue  # nor is it proved at once
                for gone in found:
                    asked.setdefault(tuple(gone), []).append(k)
            for choice, places in asked.items():
                scans = self.sensors.disturbed(read.at(places), list(choice))
                yield from ((mine[k], scans.at(n)) for n, k in enumerate(places))

    def _complete(self, scan: Balls, proved: NDArray, i: int) -> None:
        """Put in the readings of a row that are not proved in doubles."""
        if proved.all():
            return
        row = self.rows[i]
        view = self._view(row, state_of(row), self.forest.assumptions(i))
        for ray in np.flatnonzero(~proved).tolist():
            model = of_models([view.reading(ray)])
            scan.middle[ray], scan.radius[ray] = model.middle[0], model.radius[0]

    def _driven(self, answers: dict[int, list[Model]]) -> set[int]:
        """Return which rows' answers surely take them safely into their images, as doubles tell."""
        found: set[int] = set()
        if self._motion.slip:
            return found
        for frame in {self.rows[i].frame for i in answers}:
            mine = [i for i in answers if self.rows[i].frame == frame]
            states = of_rows([self.rows[i] for i in mine])
            with np.errstate(all="ignore"):
                deltas = of_models([steering(answers[i], self.symbols) for i in mine])
                arcs = Arcs(self._motion, states, deltas)
                images = [self.rows[self.forest.children[i][0]] for i in mine]
                proved = hold_images(arcs.end, images, self.carried)
                for polygon in self.unsafe[frame]:
                    proved &= arcs.clear(polygon, self.margin)
            found.update(i for i, sure in zip(mine, proved, strict=True) if sure)
        return found

    def _check_step(self, i: int, image: Row, answers: list[Model] | None, proved: bool) -> None:
        """Prove clearance and image of one period."""
        row, assumed = self.rows[i], self.forest.assumptions(i)
        require(self.settled(i), "it may have to change its frame before it drives")
        if proved:
            return
        if answers:
            try:
                self._check_period(row, state_of(row), answers, image, ())
            except (Rejected, ArithmeticError):
                pass  # as far as doubles tell
            else:
                return
        todo: list[tuple[Cuts, list[Model]]] = [((), state_of(row))]
        halved = 0
        while todo:
            cuts, state = todo.pop()
            try:
                view = self._view(row, state, assumed)
                read = [self.sensors.readings(view, gone) for gone in self._choices(i, state)]
                self._check_period(row, state, list(map(self.network.steering, read)), image, cuts)
            except (Rejected, ArithmeticError):
                if halved == _HALVED:
                    raise
                halved += 1
                k = _longest(state)
                for cut in ((k, -ONE, ZERO), (k, ZERO, ONE)):
                    todo.append(((*cuts, cut), restricted(state, (cut,))))

    def _check_period(
        self, row: Row, state: list[Model], answers: list[Model], image: Row, cuts: Cuts
    ) -> None:
        """Prove clearance and image of a part of a row, from the network's answers to its scans."""
        path = Path(self._motion, state, steering(answers, symbols(state[0])))
        for polygon in self.unsafe[row.frame]:
            path.clear(polygon, arb(self.margin))
        prove_image(path.end, image, self.carried, cuts)


def _longest(state: list[Model]) -> int:
    """Return which of x (0) and the first symbols (1, 2, ...) moves a state most."""
    sizes = [magnitude([c for z in state for c in z[1:TERMS]])]
    first = range(min(BASE, symbols(state[0])))
    sizes += [magnitude([z[TERMS + j] for z in state]) for j in first]
    return max(range(len(sizes)), key=lambda k: float(sizes[k].mid()))


def _prove_piece(state: list[Model], part: Row) -> None:
    """Prove that a row contains its piece of a state."""
    inner = outer = state
    for k, (a, b) in enumerate(part.piece.tolist()):
        low, high = arb(a), arb(b)
        inner = [restrict(z, k, low, high) for z in inner]
        more = (high - low) / 2 * (WIDER[0] - 1) + WIDER[1]
        if (a, b) != (-1.0, 1.0):
            outer = [restrict(z, k, low - more, high + more) for z in outer]
    try:
        prove_part(outer, part)
    except Rejected:
        prove_part(inner, part)


def _has_sign(values: list[Model], sign: bool, depth: int = 12) -> bool:
    """Tell whether the least of some models is proved to be > 0 (sign), or < 0, everywhere."""
    if sign:
        return all(map(positive, values))
    if any(positive(negative(z)) for z in values):
        return True
    if depth == 0 or len(values) == 1:
        return False
    parts = zip(*map(halves, values), strict=True)
    return all(_has_sign(list(part), sign, depth - 1) for part in parts)
