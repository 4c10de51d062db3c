"""tanh, sigmoid, relu, sin, cos, tan and 1 / z of Taylor models hold every member's exact value."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import arb, random_models, worst_excess
from hypothesis import given, settings
from hypothesis import strategies as st

from verifier import functions as under_test
from verifier.arithmetic import KNOWN
from verifier.elementary import SIN_COS_RANGE
from verifier.functions import reciprocal, relu, sigmoid, sine_cosine, tan, tanh
from verifier.models import TERMS, Models

SEEDS = st.integers(0, 2**32 - 1)
WIDTHS = st.sampled_from([0.0, 1e-12, 1e-6, 1e-3, 3e-2, 0.3])
ERRORS = st.sampled_from([0.0, 1e-14, 1e-6, 1e-2])
ROWS = 4


def exact_relu(z: arb) -> arb:
    return z if z > 0 else arb(0)


def exact_sigmoid(z: arb) -> arb:
    return 1 / (1 + (-z).exp())


#: The function on models and on exact numbers, and where its arguments lie.
FUNCTIONS = {
    "tanh": (tanh, lambda z: z.tanh(), [0.0, 0.1, 1.0, 10.0, 300.0]),
    "sigmoid": (sigmoid, exact_sigmoid, [0.0, 0.1, 1.0, 10.0, 300.0]),
    "relu": (relu, exact_relu, [0.0, 1e-3, 1.0, 100.0]),
    "sin": (lambda z: sine_cosine(z)[0], lambda z: z.sin(), [0.0, 1.0, 30.0]),
    "cos": (lambda z: sine_cosine(z)[1], lambda z: z.cos(), [0.0, 1.0, 30.0]),
    "tan": (tan, lambda z: z.tan(), [0.0, 0.1, 0.3]),
    "reciprocal": (reciprocal, lambda z: 1 / z, [0.1, 1.0, 30.0]),
}
NAMES = sorted(FUNCTIONS)


def sample(name: str, seed: int, width: float, error: float) -> float:
    """Return the worst excess of one function on random models."""
    function, exact, centres = FUNCTIONS[name]
    random = np.random.default_rng(seed)
    centre = random.choice(centres)
    symbols = int(random.choice([2, KNOWN, KNOWN + 2]))
    z = random_models(random, (ROWS,), width, symbols, error, centre)
    with np.errstate(invalid="ignore", over="ignore"):
        result = function(z)
    finite = np.isfinite(result.radius)
    return worst_excess([z[finite]], result[finite], exact, random)


@pytest.mark.parametrize("name", NAMES)
@settings(max_examples=50)
@given(SEEDS, WIDTHS, ERRORS)
def test_every_member_is_held(name, seed, width, error):
    assert sample(name, seed, width, error) <= 1


@pytest.mark.parametrize("name", NAMES)
def test_narrow_models_give_finite_and_tight_results(name):
    """So that the test above does not pass by empty promises."""
    function, _, centres = FUNCTIONS[name]
    random = np.random.default_rng(0)
    z = random_models(random, (ROWS,), 1e-6, 2, 1e-9, 0.0)
    z.c[0] = min(centres[-1], 0.9)
    assert (function(z).radius < 1e-8).all()


def scaled(monkeypatch, name: str, factor: float) -> None:
    """Make one of the bounds that a function's result is assembled from too small."""
    original = under_test._assemble

    def assemble(
        z, value, slope, slope_size, slope_rest, curve, curve_most, third_most, remainder, size
    ):
        given = {
            "curve": curve_most, "third": third_most, "remainder": remainder, "rest": slope_rest,
            "size": size,
        }  # fmt: skip
        given[name] = given[name] * factor
        return original(
            z, value, slope, slope_size, given["rest"], curve, given["curve"], given["third"],
            given["remainder"], given["size"],
        )  # fmt: skip

    monkeypatch.setattr(under_test, "_assemble", assemble)


def bound_of(name: str, part: str) -> tuple[Models, Models]:
    """Return arguments at which one part of the radius is nearly all of it, and the result.

    remainder: a wide polynomial without errors; curve: one large error on a constant; third: the
    same where its square is known.
    """
    function, _, _ = FUNCTIONS[name]
    centre = {"tanh": 0.65, "sin": 1.57, "cos": 0.0, "tan": 0.4, "reciprocal": 0.7}[name]
    if (name, part) == ("tanh", "third"):
        centre = 0.0
    c = np.zeros((TERMS + 2 * (KNOWN if part == "third" else 1), ROWS))
    c[0] = centre
    if part == "remainder":
        c[1] = [0.2, 0.1, -0.2, 0.05]
    elif part in {"curve", "third"}:
        c[TERMS] = [0.1, 0.03, 0.01, 1e-3]
    elif part == "rest":
        # The part of slope(x) error beyond the linear one: x^2 times the error.
        c[1], c[TERMS] = 0.2, 1e-7
    z = Models(c, np.zeros(ROWS))
    return z, function(z)


@pytest.mark.parametrize(
    ("name", "part"),
    # cos(0.2 x) has an odd remainder of order 7: a tenth of its bound is not reached.
    [(n, "remainder") for n in ("tanh", "sin", "tan", "reciprocal")]
    + [(n, "curve") for n in ("tanh", "sin", "cos", "tan", "reciprocal")]
    # sin has none at its top, nor cos.
    + [(n, "third") for n in ("tanh", "tan", "reciprocal")],
)
def test_the_check_sees_a_bound_ten_times_too_small(monkeypatch, name, part):
    random, exact = np.random.default_rng(0), FUNCTIONS[name][1]
    z, result = bound_of(name, part)
    assert worst_excess([z], result, exact, random) <= 1
    scaled(monkeypatch, part, 0.1)
    z, result = bound_of(name, part)
    assert worst_excess([z], result, exact, random) > 1


@pytest.mark.parametrize("name", ["tanh", "sin", "tan", "reciprocal"])
def test_the_check_sees_a_slope_ten_times_too_short(monkeypatch, name):
    """g'(p(x)) beyond its first two coefficients, on a narrow error: nothing else is as large."""
    random, exact = np.random.default_rng(0), FUNCTIONS[name][1]

    def worst() -> float:
        c = np.zeros((TERMS + 2, 1))
        c[0] = {"tanh": 0.4, "sin": 0.1, "tan": 0.3, "reciprocal": 0.7}[name]
        c[1], c[TERMS] = 0.01, 1e-7
        z = Models(c, np.zeros(1))
        return worst_excess([z], FUNCTIONS[name][0](z), exact, random)

    assert worst() <= 1
    scaled(monkeypatch, "rest", 0.1)
    assert worst() > 1


@pytest.mark.parametrize("name", ["tanh", "sin", "cos", "tan", "reciprocal"])
def test_the_check_sees_missing_rounding(monkeypatch, name):
    function, exact, _centres = FUNCTIONS[name]
    random = np.random.default_rng(0)
    z = random_models(random, (ROWS,), 0.0, 0, 0.0, 1.0)
    z.c[0] = np.array([0.3, 0.5, 0.6, 0.7])
    assert worst_excess([z], function(z), exact, random) <= 1
    monkeypatch.setattr(under_test, "ROUNDING", 0.0)
    assert worst_excess([z], function(z), exact, random) > 1


@pytest.mark.parametrize("name", ["tanh", "sin", "cos", "tan", "reciprocal"])
def test_rounding_stays_below_a_tenth_of_its_bound(name):
    """The bound is derived by hand (docs/soundness.md); no member should come near it."""
    function, exact, centres = FUNCTIONS[name]
    worst = 0.0
    for seed in range(30):
        random = np.random.default_rng(seed)
        z = random_models(random, (ROWS,), 1e-4, 0, 0.0, random.choice(centres))
        z.c[1], z.c[2:] = 1e-4 * np.minimum(z.c[0], 1.0), 0.0  # the remainder is below 1e-22
        result = function(z)
        finite = np.isfinite(result.radius)
        worst = max(worst, worst_excess([z[finite]], result[finite], exact, random))
    assert worst < 0.1


@settings(max_examples=50)
@given(SEEDS, st.sampled_from([0.0, 1e-9, 1e-2, 1.0]))
def test_relu_at_the_kink(seed, error):
    """Rows whose sign is open by all amounts, and rows that just touch 0."""
    random = np.random.default_rng(seed)
    z = random_models(random, (ROWS,), 10 ** random.uniform(-6, 1), 2, error, 0.0)
    z.c[0] = np.array([0.0, 1.0, -1.0, 0.3]) * np.abs(z.c[1:]).sum(axis=0)
    assert worst_excess([z], relu(z), exact_relu, random) <= 1


def test_relu_is_exact_where_the_sign_is_known():
    z = Models(np.array([[1.0, -1.0]] + [[0.0, 0.0]] * 5), np.array([0.5, 0.5]))
    result = relu(z)
    assert result.c[0].tolist() == [1.0, 0.0]
    assert result.radius[0] == pytest.approx(0.5, abs=1e-11)
    assert result.radius[1] < 1e-100


@pytest.mark.parametrize(
    ("function", "centre"), [(tan, 0.95), (reciprocal, 0.05), (sine_cosine, SIN_COS_RANGE)]
)
def test_nothing_is_claimed_beyond_the_domain(function, centre):
    c = np.zeros((TERMS, 1))
    c[0], c[1] = centre, 0.1
    with np.errstate(invalid="ignore"):
        result = function(Models(c, np.zeros(1)))
    results = result if isinstance(result, tuple) else (result,)
    assert all(not np.isfinite(r.radius[0]) for r in results)


@pytest.mark.parametrize("name", NAMES)
def test_unknown_arguments_give_nothing_finite(name):
    c = np.zeros((TERMS, 3))
    c[0] = [np.nan, 0.5, 0.5]
    c[1] = [0.0, np.inf, 0.0]
    with np.errstate(invalid="ignore", over="ignore"):
        result = FUNCTIONS[name][0](Models(c, np.array([0.0, 0.0, np.inf])))
    assert not np.isfinite(result.radius).any()
