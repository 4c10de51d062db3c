"""Errors gathered between steps: every vector of errors stays in, in any frame."""

from __future__ import annotations

import numpy as np
import pytest
from exact_members import Place, arb, member, places, random_models
from hypothesis import given, settings
from hypothesis import strategies as st
from retraced import RetracingMonkeyPatch

from verifier import lohner as under_test
from verifier.arithmetic import total_size
from verifier.lohner import consolidate
from verifier.models import TERMS, Models
from verifier.rows import THETA, F, S, V

SEEDS = st.integers(0, 2**32 - 1)
ROWS = 3


def stretched(random: np.random.Generator, error: float, symbols: int) -> Models:
    """Return a state whose errors are as they are after a while."""
    state = random_models(random, (4, ROWS), 0.1, symbols, error)
    state.c[TERMS:, V] = 0.0
    state.c[TERMS:, S] *= 10 ** random.uniform(-3, 0)
    state.c[TERMS + 1 :: 2] *= random.choice([0.0, 1.0])
    return state


def contains(state: Models, row: int, place: Place, values: list[arb]) -> bool:
    """Tell whether a gathered state holds a vector at x for some values of its symbols.

    That is a linear programme; here the state's frame is square and well conditioned, so the
    symbols are solved for and what is left over is compared with the radius.
    """
    middle = [
        member(Models(state.c[:TERMS], state.radius), (i, row), Place(place.x, place.e[:0]))
        for i in range(len(values))
    ]
    off = np.array([float(v - m) for v, m in zip(values, middle, strict=True)])
    columns = state.c[TERMS::2, :, row].T + state.c[TERMS + 1 :: 2, :, row].T * place.x
    e = np.clip(np.linalg.lstsq(columns, off, rcond=None)[0], -1, 1)
    return bool((np.abs(off - columns @ e) <= state.radius[:, row] * (1 + 1e-3) + 1e-17).all())


@settings(max_examples=60)
@given(SEEDS, st.sampled_from([1e-6, 1e-2]), st.sampled_from([1, 2, 3, 7]))
def test_every_vector_of_errors_is_held(seed, error, symbols):
    random = np.random.default_rng(seed)
    state = stretched(random, error, symbols)
    result = consolidate(state, [S, F, THETA])
    assert result.symbols == 3
    assert (result.c[:TERMS] == state.c[:TERMS]).all()
    assert (result.radius[V] == state.radius[V]).all()
    for row in range(ROWS):
        for place in places(random, symbols):
            rests = random.choice([-1.0, 1.0], 4)
            values = [member(state, (i, row), place, float(rests[i])) for i in range(4)]
            assert contains(result, row, place, values)


def test_the_frame_is_orthogonal_and_the_result_is_as_small_as_before():
    """Next to nothing is lost to the radius; the longest direction is the first axis."""
    random = np.random.default_rng(0)
    for symbols in (1, 3, 7):
        state = stretched(random, 1e-3, symbols)
        state = Models(state.c, state.radius * 0.0)
        result = consolidate(state, [S, F, THETA])
        assert (result.radius < 1e-12 * np.abs(state.c[TERMS:]).max()).all()
        lengths = np.linalg.norm(state.c[TERMS::2][:, [S, F, THETA]], axis=1)
        for row in range(ROWS):
            column = state.c[TERMS + 2 * lengths[:, row].argmax(), [S, F, THETA], row]
            axis = result.c[TERMS, [S, F, THETA], row]
            cosine = column @ axis / np.linalg.norm(column) / np.linalg.norm(axis)
            assert abs(cosine) == pytest.approx(1, abs=1e-12)
            axes = result.c[TERMS::2, [S, F, THETA], row]
            axes = axes / np.maximum(np.linalg.norm(axes, axis=1)[:, None], 1e-300)
            assert np.allclose(axes @ axes.T, np.diag(np.diag(axes @ axes.T)), atol=1e-14)


def test_errors_of_no_length_and_of_one_direction():
    c = np.zeros((TERMS + 6, 4, 2))
    c[TERMS, [S, F, THETA], 1] = c[TERMS + 2, [S, F, THETA], 1] = 1e-3
    result = consolidate(Models(c, np.zeros((4, 2))), [S, F, THETA])
    assert (np.abs(result.c[TERMS:, :, 0]) == 0).all()
    assert (result.radius < 1e-15).all()
    assert np.abs(result.c[TERMS:, S, 1]).sum() == pytest.approx(2e-3, rel=1e-9)


def test_carried_symbols_stay():
    random = np.random.default_rng(1)
    state = stretched(random, 1e-3, 6)
    result = consolidate(state, [S, F, THETA], 2)
    assert result.symbols == 5
    assert (result.c[: TERMS + 4] == state.c[: TERMS + 4]).all()
    rest = Models(np.concatenate([state.c[:TERMS], state.c[TERMS + 4 :]]), state.radius)
    alone = consolidate(rest, [S, F, THETA])
    assert (result.c[TERMS + 4 :] == alone.c[TERMS:]).all()
    assert (result.radius == alone.radius).all()


def test_errors_of_other_components_are_kept():
    c = np.zeros((TERMS + 4, 4, 1))
    c[TERMS + 3, V] = 1e-3
    result = consolidate(Models(c, np.full((4, 1), 1e-6)), [S, F, THETA])
    assert result.radius[V, 0] >= 1e-3 + 1e-6


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_unknown_errors_stay_unknown(bad):
    for place in (0, TERMS, TERMS + 1, TERMS + 5):
        c = np.full((TERMS + 6, 4, 1), 1e-3)
        c[place, F] = bad
        result = consolidate(Models(c, np.zeros((4, 1))), [S, F, THETA])
        known = np.isfinite(result.radius[F, 0]) and np.isfinite(result.c[:, F, 0]).all()
        assert not known


def bend(patch: pytest.MonkeyPatch, bent: np.ndarray) -> None:
    """Let a matrix be the frame."""
    patch.setattr(
        under_test,
        "_frame",
        lambda columns, size, trace: [[trace.number(float(x)) for x in axis] for axis in bent.T],
    )


@settings(max_examples=40)
@given(SEEDS, st.sampled_from([[S, F, THETA], [S, F, V, THETA]]))
def test_any_frame(seed, active):
    """A frame that is not orthogonal at all costs size, never soundness: QR is not trusted."""
    random = np.random.default_rng(seed)
    k = len(active)
    state = random_models(random, (4, ROWS), 0.1, 5, 1e-3)
    if k == 3:
        state.c[TERMS:, V] = 0.0
    bent = np.eye(k) + random.choice([0.0, 1e-9, 0.3]) * random.normal(size=(k, k))
    with RetracingMonkeyPatch.context() as patch:
        bend(patch, bent)
        result = consolidate(state, active)
    for row in range(ROWS):
        for place in places(random, 5):
            off = np.array(
                [
                    float(member(state, (i, row), place, 1.0) - member(
                        Models(state.c[:TERMS], state.radius), (i, row), Place(place.x, place.e[:0])
                    ))
                    for i in active
                ]
            )  # fmt: skip
            # The member that the proof names: e = Q (Q^T off), the rest within the radius.
            turned = bent.T @ off
            size = result.c[TERMS::2, active, row] + result.c[TERMS + 1 :: 2, active, row] * place.x
            extent = np.diag(size) / np.diag(bent)  # symbol i along column i of the frame
            assert (np.abs(turned) <= np.abs(extent) * (1 + 1e-12)).all()
            rest = np.abs(off - bent @ turned)
            assert (rest <= result.radius[active, row] * (1 + 1e-9)).all()


BENT = np.array([[1.0, 0.3, 0.0], [0.0, 1.0, 0.2], [0.1, 0.0, 1.0]])


def rest_and_radius() -> tuple[np.ndarray, np.ndarray]:
    """Return what a bent frame leaves over of a vector of errors, and the radii that hold it."""
    c = np.zeros((TERMS + 6, 4, 1))
    c[TERMS::2, [S, F, THETA], 0] = 1e-3 * BENT
    result = consolidate(Models(c, np.zeros((4, 1))), [S, F, THETA])
    off = 1e-3 * BENT.sum(axis=0)
    return np.abs(off - BENT @ (BENT.T @ off)), result.radius[[S, F, THETA], 0]


def test_the_check_sees_a_frame_whose_lack_is_not_counted(monkeypatch):
    bend(monkeypatch, BENT)
    rest, radius = rest_and_radius()
    assert (rest <= radius).all()
    monkeypatch.setattr(
        under_test,
        "_radii",
        lambda frame, moving, first: [2.0**-40 * total_size(z.c) for z in moving],
    )
    rest, radius = rest_and_radius()
    assert (rest > radius).any()
