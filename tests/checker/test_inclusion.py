"""Inclusion of models in rows: tight, and never of what sticks out."""

from __future__ import annotations

import numpy as np
import pytest
from flint import arb
from hypothesis import given
from hypothesis import strategies as st

from checker.balls import Balls
from checker.batch import of_models
from checker.batch_inclusion import hold_images
from checker.files import Kind, Rejected, Row
from checker.inclusion import (
    models_of,
    prove_gathered,
    prove_image,
    prove_part,
    restricted,
    state_of,
)
from checker.models import TERMS, UNIT, Model

SEEDS = st.integers(0, 2**32)


def prove_in_doubles(inner: list[Model], row: Row, carried: int) -> None:
    """Prove the same as ``prove_image``, among the images of other rows."""
    images, gone = of_models(inner), of_models(inner)
    gone.middle[:, 0] += 10 * np.abs(row.spread).sum() + 10 * row.radius.max()
    both = Balls(*(np.stack(pair) for pair in zip(images, gone, strict=True)))
    found = hold_images(both, [row, row], carried)
    assert not found[1]
    if not found[0]:
        raise Rejected("not in doubles")


#: How small a radius may be, and how small a gap, for symbols whose lengths differ by 1e6.
WAYS = pytest.mark.parametrize(
    ("prove", "least", "gap"), [(prove_image, 1e-15, 1e-9), (prove_in_doubles, 1e-13, 1e-7)]
)


def made(centre: np.ndarray, spread: np.ndarray, radius: np.ndarray) -> Row:
    piece = np.tile([-1.0, 1.0], (1 + spread.shape[1], 1))
    return Row(0, 0, 0, -1, Kind.ROOT, -1, False, -1, centre, spread, radius, piece)


def skew(random: np.random.Generator, least: float = 1e-15) -> Row:
    """Return a row with skew symbols of very different lengths."""
    centre = random.normal(size=(4, TERMS))
    lengths = 10.0 ** random.uniform(-9, -3, 3)
    spread = np.zeros((4, 3, 2))
    spread[[0, 1, 3], :, 0] = np.linalg.qr(random.normal(size=(3, 3)))[0] * lengths
    spread[:, :, 1] = spread[:, :, 0] * random.uniform(-0.8, 0.8, 3)
    return made(centre, spread, least + 1e-12 * random.uniform(size=4))


def within(random: np.random.Generator, row: Row, share: float) -> list[Model]:
    """Return models that fill a share of the row, with symbols of their own.

    Two new symbols for each old one, with signs at random: e_j = (+-w e + (1 - w) e').
    """
    w = random.uniform(size=3)[:, None]
    sign = random.choice([-1.0, 1.0], 3)[:, None]
    new = np.concatenate([row.spread * w * sign, row.spread * (1 - w)], axis=1)
    return models_of(row._replace(spread=share * new))


def outside(inner: list[Model], row: Row) -> bool:
    """Tell whether some member is outside of the row: looked for at x = -1, 0, 1 by hand."""
    frame = row.spread[[0, 1, 3], :, 0]
    for x in (-1.0, 0.0, 1.0):
        m = (len(inner[0]) - TERMS - 1) // 2
        errors = np.array(
            [[float(z[TERMS + j] + x * z[TERMS + m + j]) for j in range(m)] for z in inner]
        )
        shift = np.array([sum(float(z[k]) * x**k for k in range(TERMS)) for z in inner])
        shift -= row.centre @ x ** np.arange(TERMS)
        ends = np.linalg.solve(frame, np.column_stack([shift[[0, 1, 3]], errors[[0, 1, 3]]]))
        scale = 1 + x * row.spread[0, :, 1] / row.spread[0, :, 0]
        slack = np.abs(np.linalg.inv(frame)) @ row.radius[[0, 1, 3]]
        if (np.abs(ends).sum(axis=1) > scale + slack + 1e-6).any():
            return True
    return False


@WAYS
@given(SEEDS)
def test_what_fills_a_row_is_inside(prove, least, gap, seed):
    random = np.random.default_rng(seed)
    row = skew(random, least)
    prove(within(random, row, 1 - gap), row, 0)


@WAYS
@given(SEEDS)
def test_what_is_larger_than_a_row_is_not(prove, least, gap, seed):
    random = np.random.default_rng(seed)
    row = skew(random, least)
    inner = within(random, row, 1.01)
    if not outside(inner, row):
        return  # the radius has room for it
    with pytest.raises(Rejected):
        prove(inner, row, 0)


@WAYS
@given(SEEDS, st.integers(0, 3), st.sampled_from([0.99, 1.01]))
def test_a_rest_needs_room_in_the_radius_where_no_symbol_is(
    prove, least, gap, seed, component, share
):
    random = np.random.default_rng(seed)
    radius = 1e3 * least * 10.0 ** random.uniform(0, 8, 4)
    row = made(random.normal(size=(4, TERMS)), np.zeros((4, 3, 2)), radius)
    inner = models_of(row)
    inner[component][-1] = arb(float(radius[component]) * share) * UNIT
    if share < 1:
        prove(inner, row, 0)
    else:
        with pytest.raises(Rejected):
            prove(inner, row, 0)


@WAYS
@given(SEEDS, st.integers(0, 2), st.integers(0, 3))
def test_a_carried_symbol_stays_itself(prove, least, gap, seed, symbol, component):
    """Beside carried symbols as large as the row nothing has to be left over."""
    row = skew(np.random.default_rng(seed), least)
    prove(models_of(row), row, 3)
    more = row.spread.copy()
    more[component, symbol, 0] += 3 * row.radius[component]
    with pytest.raises(Rejected):
        prove(models_of(row._replace(spread=more)), row, 3)


@pytest.mark.parametrize("size", [5e-324, 1e-310, 1e-290, 1e290, 1e308])
@pytest.mark.parametrize("column", [0, 2])
def test_symbols_of_extreme_lengths_prove_nothing_in_doubles(size, column):
    row = skew(np.random.default_rng(4))
    inner = of_models(models_of(row._replace(spread=1.1 * row.spread)))
    spread = row.spread.copy()
    spread[:, column, 0] = size
    with np.errstate(all="ignore"):
        found = hold_images(Balls(*(x[None] for x in inner)), [row._replace(spread=spread)], 0)
    assert not found.any()


@given(SEEDS, st.integers(0, 3), st.floats(-1, 0.4), st.sampled_from([3, 12]))
def test_a_part_of_the_domain_is_held_against_the_same_part_of_the_image(
    seed, parameter, low, count
):
    """Of x or of a symbol; with 12 symbols some are products, and three are free."""
    random = np.random.default_rng(seed)
    row = skew(random)
    if count > 3:
        products = 1e-10 * random.normal(size=(4, 6, 2))
        spread = np.concatenate([row.spread, products, 1e-3 * row.spread], axis=1)
        row = made(row.centre, spread, row.radius)
    cuts = ((parameter, arb(low), arb(low + 0.5)),)
    full = row.spread.copy()
    full[:, 9:] *= 1 - 1e-9
    inner = restricted(models_of(row._replace(spread=full)), cuts)
    carried = 3 if count == 3 else 9
    prove_image(inner, row, carried, cuts)
    other = ((parameter, arb(low + 0.1), arb(low + 0.5)),)
    with pytest.raises(Rejected):
        prove_image(inner, row, carried, other)


@given(SEEDS, st.floats(-1, 0.9))
def test_what_fills_a_part_of_a_row_is_inside(seed, low):
    random = np.random.default_rng(seed)
    row = skew(random)
    cuts = ((0, arb(low), arb(low + 0.1)),)
    prove_image(restricted(within(random, row, 1 - 1e-9), cuts), row, 0, cuts)


@given(SEEDS, st.integers(1, 3))
def test_a_symbol_that_is_not_carried_is_divided_in_the_row_alone(seed, parameter):
    row = skew(np.random.default_rng(seed))
    twice = row.spread * (1 - 1e-9)
    twice[:, parameter - 1] *= 2
    inner = models_of(row._replace(spread=twice))
    half = ((parameter, arb(-0.5 * (1 - 1e-9)), arb(0.5 * (1 - 1e-9))),)
    prove_image(restricted(inner, half), row, 0, half)
    more = ((parameter, arb(-0.5), arb(0.51)),)
    with pytest.raises(Rejected):
        prove_image(restricted(inner, more), row, 0, more)


@given(SEEDS, st.integers(0, 3), st.sampled_from([0.999, 1.001]))
def test_a_part_needs_room_for_every_difference(seed, component, share):
    row = skew(np.random.default_rng(seed))
    inner = models_of(row._replace(radius=row.radius * 0.5), apart=True)
    for k, sign in ((1, 1), (2, -1)):
        inner[component][k] += sign * arb(share * 0.25 * float(row.radius[component]))
    if share < 1:
        prove_part(inner, row)
    else:
        with pytest.raises(Rejected):
            prove_part(inner, row)


def test_a_part_may_be_the_whole_row():
    row = skew(np.random.default_rng(1))
    prove_part(models_of(row, apart=True), row)


def upright(random: np.random.Generator) -> tuple[Row, np.ndarray]:
    """Return a row of kind gathered, with directions of different lengths, and these."""
    frame = np.linalg.qr(random.normal(size=(4, 4)))[0] * 10.0 ** random.uniform(-6, -1, 4)
    centre, spread = np.zeros((4, TERMS)), np.zeros((4, 6, 2))
    centre[:, 0] = random.normal(size=4)
    centre[:, 1], spread[:, :3, 0] = frame[:, 0], frame[:, 1:]
    return made(centre, spread, np.full(4, 1e-14)), frame


def inhabitant(random: np.random.Generator, whole: Row, frame: np.ndarray, far: int) -> Row:
    """Return a row in the box of another: at x = 1 it is one part in 1e9 from its side ``far``.

    In the coordinates of the frame each of its own parts takes a share of what room there is.
    """
    shares = random.dirichlet(np.ones(12), 4)  # middle, x to x^5, e and x e of three symbols
    signs = random.choice([-1.0, 1.0], shares.shape)
    shares[:, [2, 4]] *= random.uniform(size=(4, 2))  # even powers fill one side only
    shares[far] /= shares[far].sum()
    signs[far] = signs[far, 0]
    places = frame @ (shares * signs * (1 - 1e-9))
    centre, spread = places[:, :6], np.zeros((4, 6, 2))
    centre[:, 0] += whole.centre[:, 0]
    spread[:, :3] = places[:, 6:].reshape(4, 3, 2)
    return made(centre, spread, np.full(4, 1e-18))


@given(SEEDS, st.integers(0, 3))
def test_what_lies_in_a_gathered_row_is_found_there(seed, far):
    random = np.random.default_rng(seed)
    whole, frame = upright(random)
    source = inhabitant(random, whole, frame, far)
    prove_gathered(models_of(source, apart=True), whole)
    # A millionth less in the direction that it needs to the end.
    small = 1 - 1e-6
    if far == 0:
        centre = whole.centre.copy()
        centre[:, 1] *= small
        less = whole._replace(centre=centre)
    else:
        spread = whole.spread.copy()
        spread[:, far - 1] *= small
        less = whole._replace(spread=spread)
    if np.abs(frame[:, far]).max() * 1e-6 < 1e-11:
        return  # its radius may have room
    with pytest.raises(Rejected, match="sticks out of"):
        prove_gathered(models_of(source, apart=True), less)


@given(SEEDS)
def test_a_gathered_row_is_a_parallelotope(seed):
    random = np.random.default_rng(seed)
    whole, frame = upright(random)
    source = models_of(inhabitant(random, whole, frame, 1), apart=True)
    centre, spread = whole.centre.copy(), whole.spread.copy()
    centre[1, 3], spread[2, 1, 1] = 1e-9, 1e-9
    for bent in (whole._replace(centre=centre), whole._replace(spread=spread)):
        with pytest.raises(Rejected, match="bent"):
            prove_gathered(source, bent)


def test_a_flat_gathered_row_holds_what_its_radius_holds():
    """No direction along v: a source that differs there needs the radius."""
    whole, _ = upright(np.random.default_rng(3))
    centre, spread = whole.centre.copy(), whole.spread * 0.0
    centre[:, 1:] = 0
    flat = whole._replace(centre=centre, spread=spread, radius=np.array([0, 0, 1e-9, 0]))
    for shift, fits in ((0.0, True), (0.9e-9, True), (1.1e-9, False)):
        moved = centre.copy()
        moved[2, 0] += shift
        source = flat._replace(centre=moved, radius=np.zeros(4))
        if fits:
            prove_gathered(models_of(source, apart=True), flat)
        else:
            with pytest.raises(Rejected, match="rest of v"):
                prove_gathered(models_of(source, apart=True), flat)


def test_the_models_of_a_row_hold_its_radius():
    row = skew(np.random.default_rng(5))
    for z, size in zip(state_of(row), row.radius, strict=True):
        assert z[-1].contains(float(size))
        assert z[-1].contains(-float(size))
        assert float(z[-1].rad()) < 1.001 * size
