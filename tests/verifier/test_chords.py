"""Lines instead of series: tanh, sigmoid and the clipped 1 / u hold every member at any width."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import Place, arb, excess, member, places, random_models, worst_excess
from hypothesis import given, settings
from hypothesis import strategies as st

from verifier import chords as under_test
from verifier.chords import clipped_reciprocal, tanh_line, wide_sigmoid, wide_tanh
from verifier.elementary import tanh_pair
from verifier.functions import reciprocal, tanh
from verifier.models import TERMS, Models, apply, bounds

SEEDS = st.integers(0, 2**32 - 1)
WIDTHS = st.sampled_from([0.0, 1e-9, 1e-3, 0.1, 1.0, 5.0])
CENTRES = st.sampled_from([0.0, 1e-3, 0.3, 1.0, 3.0, 20.0])
ROWS = 5
FUNCTIONS = {
    "line": (tanh_line, lambda z: z.tanh()),
    "tanh": (wide_tanh, lambda z: z.tanh()),
    "sigmoid": (wide_sigmoid, lambda z: 1 / (1 + (-z).exp())),
}


def sample(name: str, seed: int, width: float, error: float, centre: float) -> float:
    function, exact = FUNCTIONS[name]
    random = np.random.default_rng(seed)
    z = random_models(random, (ROWS,), width, 2, error, centre)
    return worst_excess([z], function(z), exact, random)


@pytest.mark.parametrize("name", FUNCTIONS)
@settings(max_examples=150)
@given(SEEDS, WIDTHS, WIDTHS, CENTRES)
def test_every_member_is_held(name, seed, width, error, centre):
    assert sample(name, seed, width, error, centre) <= 1


def one_symbol(centre: float, width: float) -> Models:
    c = np.zeros((TERMS + 2, 1))
    c[0], c[TERMS] = centre, width
    return Models(c, np.zeros(1))


def reached(z: Models, result: Models, exact) -> float:
    """Return how much of the radius is used along the symbol, on a fine grid."""
    grid = [Place(0.0, np.array([e])) for e in np.linspace(-1, 1, 401)]
    return max(excess(result, (0,), p, exact(member(z, (0,), p))) for p in grid)


@pytest.mark.parametrize("centre", [-2.0, -0.7, -0.1, 0.0, 0.05, 0.5, 1.5, 3.0])
@pytest.mark.parametrize("width", [0.05, 0.3, 1.0, 3.0])
def test_lines_touch_the_graph(centre, width):
    """What they claim is used up: a bound a little smaller would be wrong."""
    z = one_symbol(centre, width)
    result = tanh_line(z)
    assert 0.99 < reached(z, result, lambda v: v.tanh()) <= 1


@pytest.mark.parametrize("width", [0.05, 0.3, 1.0, 3.0])
@pytest.mark.parametrize("centre", [-1.0, 0.0, 0.4, 2.0])
def test_lines_beat_series_and_range(centre, width):
    z = one_symbol(centre, width)
    low, high = bounds(z)
    ends = (tanh_pair(high)[0] - tanh_pair(low)[0]) / 2
    line, series, both = tanh_line(z), tanh(z), wide_tanh(z)
    assert both.radius[0] == min(line.radius[0], series.radius[0])
    assert line.radius[0] < ends[0]
    assert centre == 0.0 or line.radius[0] < 0.75 * series.radius[0]


def test_the_check_sees_a_tangent_in_the_wrong_place(monkeypatch):
    """Bounds are taken at the place that the slope belongs to: elsewhere they are wrong."""
    line = under_test._line
    monkeypatch.setattr(under_test, "_line", lambda z, slope, *rest: line(z, slope * 0.9, *rest))
    z = one_symbol(0.5, 1.0)
    assert reached(z, apply(tanh_line.__wrapped__, z), lambda v: v.tanh()) > 1


@settings(max_examples=200)
@given(SEEDS, st.sampled_from([1e-9, 1e-3, 0.02, 0.1, 0.3, 1.0]), st.sampled_from([0.0, 1e-3, 0.2]))
def test_clipped_reciprocals_hold_every_member_beyond_the_clip(seed, width, error):
    """Where u is below 1 / reach, what is promised is of numbers v >= 1 / reach near it only."""
    random, reach = np.random.default_rng(seed), 5.0
    u = random_models(random, (ROWS,), width, 2, error, 0.0)
    u.c[0] = random.choice([0.2, 0.21, 0.3, 1.0, 4.0], ROWS)
    result = apply(clipped_reciprocal, u, reach)
    for row in range(ROWS):
        for place in places(random, 2):
            v = member(u, (row,), place, float(random.choice([-1.0, 0.0, 1.0])))
            if v >= 1 / arb(reach):
                assert excess(result, (row,), place, 1 / v) <= 1
    finite = np.isfinite(reciprocal(u).radius)
    assert (result.radius[finite] <= reciprocal(u).radius[finite]).all()
    assert (result.radius < 2.5 * (1 + 1e-9)).all()
