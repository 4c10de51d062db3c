"""An executor for what the readers read: SciPy's DOP853, jumps at the end of clock invariants."""

import math

import numpy as np
from scipy.integrate import solve_ivp

_FUNCTIONS = {
    name: getattr(math, name) for name in ("sin", "cos", "tan", "atan", "tanh", "exp", "sqrt")
} | {"relu": lambda x: max(x, 0.0), "sigmoid": lambda x: 1 / (1 + math.exp(-x))}


def _ready(source, names="v"):
    return eval(f"lambda {names}: {source}", _FUNCTIONS)


_HOLDS = {
    "<=": lambda x, b: x <= b,
    ">=": lambda x, b: x >= b,
    "<": lambda x, b: x < b,
    ">": lambda x, b: x > b,
    "=": lambda x, b: x == b,
}


class Runner:
    """Runs a Read; clock: its clock variable; tolerance: of the integration."""

    def __init__(self, read, clock="clk", tolerance=1e-11, special=None):
        self.read, self.clock, self.tolerance = read, clock, tolerance
        self.special = special or {}
        self.flows, self.edges = {}, {mode: [] for mode in read.flows}
        for mode, flow in read.flows.items():
            moving = [name for name, rate in flow.items() if rate not in ("(0.0)", "(-0.0)")]
            at = {name: f"y[{i}]" for i, name in enumerate(moving)}
            sources = []
            for name in moving:
                source = flow[name]
                for other, place in at.items():
                    source = source.replace(f"v[{other!r}]", place)
                sources.append(source)
            self.flows[mode] = moving, _ready(f"[{', '.join(sources)}]", "y, v")
        for edge in read.edges:
            guard = [(_ready(source), relation, bound) for source, relation, bound in edge.guard]
            reset = {name: _ready(source) for name, source in edge.reset.items()}
            self.edges[edge.source].append((edge, guard, reset))

    def middle(self, **given):
        return {n: (low + high) / 2 for n, (low, high) in self.read.initial.items()} | given

    def dwell(self, mode):
        """Return how long a mode may last, from its invariant on the clock alone."""
        ends = [
            bound
            for source, relation, bound in self.read.invariants[mode]
            if source == f"v[{self.clock!r}]" and relation == "<="
        ]
        assert len(self.read.invariants[mode]) == len(ends)
        return min(ends, default=None)

    def flow(self, mode, values, time):
        moving, rate = self.flows[mode]
        if time == 0 or not moving:
            return values
        start = [values[name] for name in moving]
        if moving == [self.clock]:
            return values | {self.clock: start[0] + time}
        answer = solve_ivp(
            lambda _, y: rate(y.tolist(), values),
            (0, time),
            start,
            "DOP853",
            rtol=self.tolerance,
            atol=self.tolerance / 100,
        )
        assert answer.success
        return values | dict(zip(moving, np.asarray(answer.y)[:, -1].tolist(), strict=True))

    def open_edges(self, mode, values):
        return [
            (edge, reset)
            for edge, guard, reset in self.edges[mode]
            if all(_HOLDS[r](one(values), b) for one, r, b in guard)
        ]

    def run(self, values, mode=None, choose=None, spread=None):
        """Yield (mode, values on entry) until a mode without a clock invariant or without exits."""
        mode = mode or self.read.initial_mode
        yield mode, dict(values)
        while (dwell := self.dwell(mode)) is not None and self.edges[mode]:
            assert self.read.flows[mode][self.clock] == "(1.0)"
            values = self.flow(mode, values, dwell - values[self.clock]) | {self.clock: dwell}
            ways = self.open_edges(mode, values)
            assert ways, f"no jump is open in {mode}"
            edge, reset = choose(ways, values) if choose else ways[0]
            new = {name: one(values) for name, one in reset.items()}
            for name, (low, high) in edge.ranges.items():
                new[name] += spread(name, low, high)
            new |= self.special.get(edge.target, lambda _: {})(values)
            values, mode = values | new, edge.target
            yield mode, dict(values)


def periods(visits, counter="k"):
    """Yield the values with which each control period begins, and those after the last."""
    last = None
    for _, values in visits:
        if values[counter] != last:
            last = values[counter]
            yield values
