"""One control period of the closed loop on Taylor models: steering, arc, clearance."""

from __future__ import annotations

from itertools import combinations
from typing import Any

from flint import arb, arb_mat

from checker import models
from checker.balls import Balls
from checker.batch_lidar import followed, without
from checker.files import Layer, Rejected
from checker.lidar import Rays, View
from checker.models import ZERO, Model, add, bound, multiply, negative, plus, scale, split, subtract

#: What may disturb the readings.
_FAULTS = {"noise", "missing", "turn_only", "choice"}
_ACTIVATIONS = {"Tanh": models.tanh, "Sigmoid": models.sigmoid, "Relu": models.relu}
#: An arc is halved at most so often to show its clearance.
_DEPTH = 7


class Network:
    """The real-valued function of the float32 weights."""

    def __init__(self, layers: list[Layer]) -> None:
        self._layers = [
            (arb_mat(x.weights.tolist()), list(map(arb, x.biases.tolist())), x.activation)
            for x in layers
        ]
        self.rays = layers[0].weights.shape[1]

    def steering(self, scan: list[Model]) -> Model:
        """Return the steering (rad) for readings (m)."""
        z = scan
        for weights, biases, activation in self._layers:
            rows = (weights * arb_mat(z)).tolist()
            z = [plus(row, b) for row, b in zip(rows, biases, strict=True)]
            z = list(map(_ACTIVATIONS[activation], z)) if activation else z
        return z[0]


class Sensors:
    """LiDAR and disturbance: from a row's view of the walls to the network's input."""

    def __init__(self, data: dict[str, Any]) -> None:
        fault = data.get("disturbance") or {}
        self.rays = Rays(data["plant"]["lidar"])
        self.width = arb(data["plant"]["width"])
        self.noise = arb(fault.get("noise", 0.0))
        self.missing = int(fault.get("missing", 0))
        self.turn_only = bool(fault.get("turn_only", False))
        self.each_step = fault.get("choice", "run") == "step" and self.missing > 0
        #: What else the instance says may happen, which is not covered here.
        self.unknown = {k for k, v in fault.items() if v is not None} - _FAULTS
        uncertain = sum(a < b for a, b in data["initial_set"].values())
        #: Whether the errors of readings matter so much that they are followed one by one.
        self.apart = self.noise > 0 or self.each_step or uncertain > 1

    def turn(self, state: list[Model]) -> list[Model]:
        """Return models that are all positive (the last: at least 0) in the turn."""
        s, f, *_ = state
        return [s, plus(negative(s), self.width), plus(negative(f), self.width + 1)]

    def active(self, state: list[Model], assumed: bool | None) -> tuple[bool, bool]:
        """Tell whether missing rays can be missing, and whether they can be there, on a row."""
        if not (self.missing and self.turn_only):
            return self.missing > 0, self.missing == 0
        values = self.turn(state)
        inside = assumed is True or all(map(models.positive, values))
        outside = assumed is False or any(models.positive(negative(z)) for z in values)
        return not outside, not inside

    def readings(self, view: View, gone: list[int]) -> list[Model]:
        """Return the models of all readings; rays in ``gone`` read the range.

        With noise n a reading is clip(d + n, 0, range), within |n| of d, as d is in [0, range].
        Noise and rest of each are a symbol more, if they are to be followed one by one.
        """
        away, n = models.constant(self.rays.reach, view.symbols), self.rays.count
        scan = [away if ray in gone else view.reading(ray) for ray in range(n)]
        if not self.apart:
            return scan
        out = []
        for ray, z in enumerate(scan):
            (middle, *p), a, b, rest = split(z)
            own, size = [ZERO] * n, ZERO if ray in gone else self.noise + rest.rad()
            flat = all(x == 0 for x in z[1:-1])
            if ray not in gone and flat and not bound(z) < self.rays.reach:  # cut off there
                ball = (bound(z) - self.noise).lower().union(self.rays.reach)
                size, middle = ball.rad(), ball.mid()
            own[ray] = size
            out.append([middle, *p, *a, *own, *b, *[ZERO] * n, ZERO])
        return out

    def disturbed(self, scans: Balls, gone: list[int]) -> Balls:
        """The same in doubles: from scans ``[..., rays, entries]`` without disturbance."""
        reach = float(self.rays.reach)
        if gone:
            scans = without(scans, gone, reach)
        return followed(scans, gone, reach, float(self.noise)) if self.apart else scans


def gathered(z: Model, m: int) -> Model:
    """Return a model of m + 1 symbols: the last is all others and the rest."""
    p, a, b, rest = split(z)
    last = models.magnitude(a[m:]) + models.magnitude(b[m:]) + rest.rad()
    return [*p, *a[:m], last, *b[:m], ZERO, ZERO]


def choices(sensors: Sensors, case: list[int], active: tuple[bool, bool]) -> list[list[int]]:
    """Return which rays may be missing on a row together, each choice that its case allows.

    case: the rays that are, or (chosen at each step) may be, missing; active: whether they
    can be missing, and whether they can be there.
    """
    gone, there = (case if active[0] else []), active[1] or sensors.each_step
    found: list[list[int]] = [[]] if there else []
    if not sensors.each_step:
        return found + ([gone] if gone or not there else [])
    return found + [list(c) for k in range(sensors.missing) for c in combinations(gone, k + 1)]


def steering(answers: list[Model], m: int) -> Model:
    """Return the steering of a row of m symbols from the network's answers to all its scans.

    It has one symbol more than the row.
    """
    first, *others = answers
    stray = ZERO
    for other in others:
        stray = stray.union(bound(subtract(other, first)))
    return gathered(plus(first, stray), m)


class Motion:
    """What of a period's arc depends on the car alone: constants, known in balls."""

    def __init__(self, plant: dict[str, Any]) -> None:
        car = {k: arb(v) for k, v in plant["bicycle"].items() if k != "slip"}
        period = arb(plant["period"])
        top = car["motor"] * (car["throttle"] - car["hysteresis"])
        self.slip, self.rear = bool(plant["bicycle"]["slip"]), car["rear"]
        self.base = car["front"] + car["rear"]
        #: The speed after a period: decay v + gained; the distance: gone v + pushed.
        self.decay = (-car["acceleration"] * period).exp()
        self.gone = (1 - self.decay) / car["acceleration"]
        self.gained, self.pushed = top * (1 - self.decay), top * (period - self.gone)


class Path:
    """The arc that a row drives in one period, exactly as in docs/certificates.md."""

    def __init__(self, motion: Motion, state: list[Model], delta: Model) -> None:
        parts = map(split, state)
        self._s, self._f, speed, self._theta = (
            [*p, *a, ZERO, *b, ZERO, rest] for p, a, b, rest in parts
        )  # delta has one symbol more
        slope = models.tan(delta)
        self.curvature, self._slip = scale(slope, 1 / motion.base), None
        if motion.slip:
            tangent = scale(slope, motion.rear / motion.base)
            cos = models.cosine_of_slope(tangent)
            self._slip = cos, multiply(cos, tangent)
            self.curvature = multiply(self.curvature, cos)
        self.distance = plus(scale(speed, motion.gone), motion.pushed)
        after = plus(scale(speed, motion.decay), motion.gained)
        self._turned = multiply(self.curvature, self.distance)
        self._points = {0.0: (self._s, self._f)}
        self.end = [*self.point(1.0), after, add(self._theta, self._turned)]

    def point(self, share: float) -> tuple[Model, Model]:
        """Return s and f after a share of the arc: a chord of direction theta + turned / 2."""
        if share not in self._points:
            part = arb(share)
            half = scale(self._turned, part * models.HALF)
            chord = multiply(scale(self.distance, part), models.sinc(half))
            course = add(self._theta, half)
            sin, cos = models.sine(course), models.cosine(course)
            if self._slip:
                c, s = self._slip
                sin, cos = (
                    add(multiply(sin, c), multiply(cos, s)),
                    subtract(multiply(cos, c), multiply(sin, s)),
                )
            s, f = subtract(self._s, multiply(chord, sin)), subtract(self._f, multiply(chord, cos))
            self._points[share] = s, f
        return self._points[share]

    def clear(self, polygon: list[list[float]], margin: arb) -> None:
        """Prove that the whole arc misses a polygon by ``margin``; Rejected if that fails.

        The largest miss is at least any mean of two of them; on a piece of the arc a linear
        function is at least its lesser end value less curvature length^2 / 8 times the length
        of its normal.
        """
        curvature, length = abs(bound(self.curvature)).upper(), abs(bound(self.distance)).upper()
        lengths = [models.length(face) for face in polygon]
        todo = [(0.0, 1.0, 0)]
        while todo:
            start, end, depth = todo.pop()
            bulge = curvature * (length * (end - start)) ** 2 / 8
            ends = [[self._miss(x, face) for face in polygon] for x in (start, end)]
            least = _least_miss(ends[0], ends[1], [bulge * x for x in lengths], margin)
            if least >= margin:
                continue
            if depth == _DEPTH:
                short = float((margin - least).mid())
                raise Rejected(f"the margin is not proved, by {short:.3g} m")
            middle = (start + end) / 2
            todo += [(start, middle, depth + 1), (middle, end, depth + 1)]

    def _miss(self, share: float, face: list[float]) -> Model:
        return models.line(face, *self.point(share))


def _least_miss(first: list[Model], last: list[Model], bulges: list[arb], enough: arb) -> arb:
    """Return a lower bound of the largest miss on a piece of arc, from those at its ends."""
    best = arb("-inf")
    for a, b, bulge in zip(first, last, bulges, strict=True):
        best = best.max(bound(a).lower().min(bound(b).lower()) - bulge).lower()
        if best >= enough:
            return best
    for i, j in combinations(range(len(first)), 2):
        rise, other = (float((last[k][0] - first[k][0]).mid()) for k in (i, j))
        if rise * other >= 0:
            continue
        w = arb(other / (other - rise))
        means = [add(scale(end[i], w), scale(end[j], 1 - w)) for end in (first, last)]
        low = bound(means[0]).lower().min(bound(means[1]).lower())
        best = best.max(low - bulges[i].max(bulges[j])).lower()
    return best
