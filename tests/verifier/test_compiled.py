"""Compiled kernels compute, bit for bit, what their traced programs say."""

from __future__ import annotations

import math
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from enclosed import one_row
from exact_members import random_models
from hypothesis import given, settings
from hypothesis import strategies as st

import verifier.compiled.kernel as under_test
from racecar.bicycle import Bicycle
from racecar.controller import Controller, Layer
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track
from verifier import arithmetic, chords, elementary, functions, motion
from verifier.clearance import least_margin
from verifier.compiled import native
from verifier.compiled.kernel import Kernel
from verifier.compiled.trace import (
    Trace,
    evaluate,
    maximum,
    minimum,
    power_of_two,
    rint,
    square_root,
    where,
)
from verifier.cuts import parts
from verifier.lohner import consolidate
from verifier.models import TERMS, Models, apply, substitute
from verifier.motion import Motion
from verifier.network import Network
from verifier.rows import THETA
from verifier.scan import Scanner

SEEDS = st.integers(0, 2**32 - 1)
#: Whole vectors, tails of all lengths, and less than one vector.
PLACES = st.sampled_from([1, 2, 3, 4, 5, 6, 7, 8, 9, 11, 15, 16, 17, 31])
SPECIAL = np.array(
    [0.0, -0.0, np.inf, -np.inf, np.nan, 5e-324, -5e-324, 2.0**-1022, 1e308, -1e308, 0.17, 1.0]
)


def same(a: np.ndarray, b: np.ndarray) -> bool:
    """Equal by their bits, but for the bits of NaN, of which nothing is promised."""
    unknown = np.isnan(a)
    return bool(
        (unknown == np.isnan(b)).all()
        and (a.view(np.uint64)[~unknown] == b.view(np.uint64)[~unknown]).all()
    )


def numbers(random: np.random.Generator, shape: tuple[int, ...], special: float) -> np.ndarray:
    """Return numbers of many sizes, a share of them special."""
    size = 10 ** random.choice([0.0, 0.0, -3.0, -8.0, 4.0, -300.0, 300.0], shape)
    found = random.normal(size=shape) * size
    odd = random.random(shape) < special
    return np.where(odd, random.choice(SPECIAL, shape), found)


def agrees(kernel: Kernel, seed: int, places: int, special: float) -> None:
    random = np.random.default_rng(seed)
    length = places + int(random.integers(0, 5))
    tables = [numbers(random, (table.width, length), special) for table in kernel.trace.tables]
    # Some of them parts of larger arrays: rows apart, the last axis contiguous.
    tables = [np.repeat(t, 2, axis=0)[::2] if random.random() < 0.3 else t for t in tables]
    indices = [random.integers(0, length, places) for _ in range(kernel.trace.indices)]
    tables = [
        t[:, :places] if given_by.index is None else t
        for t, given_by in zip(tables, kernel.trace.tables, strict=True)
    ]
    expected = evaluate(kernel.trace, kernel.values, tables, indices)
    out = np.full((kernel.outputs, places + 3), 7.0)
    found = kernel(places, tables, indices, out[:, :places])
    assert same(np.ascontiguousarray(found), np.ascontiguousarray(expected))
    assert (out[:, places:] == 7.0).all()  # nothing is written beyond


def mixed(trace: Trace):
    """Every operation there is."""
    index = trace.index()
    a, b = trace.table(2)
    c, d = trace.table(2, index)
    known = (a < b) & ~(c >= d) | (a <= c) | (b > d)
    return [
        a + b, a - b, c * b, a / b, -a, abs(b), 1.5 - a, 2 * a, 1 / b, 3.0 + c,
        where(known, a, d), where(a < b, 1.0, -0.0), maximum(a, b), minimum(a, c),
        power_of_two(rint(minimum(maximum(c, -1000.0), 1000.0))),
        square_root(a), rint(a), a * b + c,
        # What an optimiser with looser rules would simplify.
        d * b + c, (a + b) - b, a * 0.0, a - a, a / a, (a * b) * c, a + 0.0, where(a < a, b, c),  # noqa: PLR0124
    ]  # fmt: skip


@settings(max_examples=200)
@given(SEEDS, PLACES, st.sampled_from([0.0, 0.05, 0.5]))
def test_every_operation_agrees_with_numpy(seed, places, special):
    agrees(under_test.kernel(mixed)(), seed, places, special)


@pytest.fixture(scope="module")
def kernels() -> list[Kernel]:
    """Return all kernels that proofs use, with 1, 3 and 4 error symbols."""
    under_test.forget()
    random = np.random.default_rng(0)
    for symbols in (1, 3, 4):
        use_everything(random, symbols)
    return list(under_test._KNOWN.values())


def use_everything(random: np.random.Generator, symbols: int) -> None:
    a, b = (random_models(random, (5,), 1e-3, symbols, 1e-6, 0.3) for _ in range(2))
    for function in (
        functions.tanh, functions.sigmoid, functions.relu, functions.sine_cosine,
        functions.reciprocal, functions.tan, motion.sinc, motion.slip_pair,
        chords.tanh_line, chords.wide_tanh, chords.wide_sigmoid,
        arithmetic.bounds, arithmetic.spread, arithmetic.error_spread,
    ):  # fmt: skip
        apply(function, a)
    apply(chords.clipped_reciprocal, a, 5.0)
    for function in (elementary.exp_negative, elementary.tanh_pair, elementary.sin_cos):
        function(a.c[0])
    _ = a + b, a - b, a * b, a.plus(0.1), a.times(0.3), a.widen(0.1)
    parts(a)
    substitute(a, np.full(5, 0.1), 0.3)
    consolidate(Models(np.stack([a.c] * 4, axis=1), np.stack([a.radius] * 4)), [0, 1, 3])
    for activation in ("tanh", "sigmoid", "relu", "linear"):
        weights = np.full((1, 5), 0.1, np.float32)
        layer = Layer(weights, np.zeros(1, np.float32), activation)
        Network(Controller((layer,))).steering(a[:, None])
        # Symbols so large that lines are tried.
        Network(Controller((layer,))).steering(a[:, None].times(1e6))
    pose = random_models(random, (4, 3), 1e-6, symbols, 1e-9, 0.0)
    pose.c[0] += np.array([[1.0], [1.2], [2.0], [-0.5]])
    steering = random_models(random, (3,), 1e-6, symbols, 1e-9, 0.1)
    for slip in (False, True):
        path = Motion(Bicycle(slip=slip), 0.1).drive(pose, steering)
        unsafe = named_property("clearance", square_track()).unsafe[0]
        least_margin(path, unsafe, np.inf)
    scan(symbols)


def scan(symbols: int) -> None:
    """Measure a row one of whose rays passes the inner corner, and what it then assumes."""
    slopes = np.zeros((5, 4))
    slopes[0, THETA] = 0.05
    pose = np.array([0.7, 2.5, 1.0, math.atan2(0.7 - 1.5, 2.5 - 1.5)])
    row = one_row(pose, slopes, np.zeros((2 * symbols, 4)), 0.0)
    scanner = Scanner(Lidar(3, 0.2), square_track().frames[0].obstacles)
    found = scanner.measure(row, 1e-3)
    known = [d for d in found.guards.decisions if d is not None]
    assert known
    scanner.measure(replace(row, decisions=((known[0],),)), 1e-3)
    # A ray towards the corner of two outer walls, on a wide row.
    errors = np.full((2 * symbols, 4), 1e-3)
    row = one_row(np.array([0.7, 0.9, 1.0, math.atan2(0.7, 0.9)]), slopes, errors, 0.0)
    found = Scanner(Lidar(3, 0.2), square_track().frames[0].obstacles).measure(row, 1e3)
    assert not len(found.guards.row)


@settings(max_examples=8)
@given(SEEDS, PLACES, st.sampled_from([0.0, 0.02, 0.3]))
def test_every_kernel_of_a_proof_agrees_with_numpy(kernels, seed, places, special):
    assert len(kernels) > 100
    assert {"_bent", "_distance", "_neurons", "_range"} <= {k._name for k in kernels}
    for n, kernel in enumerate(kernels):
        agrees(kernel, seed + n, places, special)


def test_the_check_sees_a_fused_multiplication(monkeypatch):
    """With contraction allowed, a x b + c is rounded once: the comparison tells."""
    text = under_test.assembly

    def contracting(*arguments):
        return (
            text(*arguments).replace("fmul ", "fmul contract ").replace("fadd ", "fadd contract ")
        )

    if not processor_fuses():
        pytest.skip("the processor has no fused multiplication")
    monkeypatch.setattr(under_test, "assembly", contracting)
    with pytest.raises(AssertionError):  # noqa: PT012 (one of twenty samples is enough)
        for seed in range(20):
            agrees(under_test.kernel(mixed)(), seed, 16, 0.0)


def processor_fuses() -> bool:
    from llvmlite import binding

    features = binding.get_host_cpu_features()
    return features.get("fma", False) or "arm" in binding.get_default_triple()


def test_arrays_that_do_not_fit_are_refused():
    kernel = under_test.kernel(mixed)()
    table, index = np.zeros((2, 5)), np.zeros(5, dtype=np.intp)
    assert kernel(5, [table, table], [index]).shape == (26, 5)
    assert kernel(0, [table, table], [index[:0]]).shape == (26, 0)
    for places, tables, indices in [
        (6, [table, table], [np.zeros(6, dtype=np.intp)]),
        (5, [table, table[:, :4]], [index + 4]),
        (5, [table, table], [index - 1]),
        (5, [table[:1], table], [index]),
        (5, [table], [index]),
        (5, [table, table], []),
        (5, [table, table], [index.astype(np.int32)]),
        (5, [table, table], [np.zeros(10, dtype=np.intp)[::2]]),
    ]:
        with pytest.raises(ValueError, match="kernel"):
            kernel(places, tables, indices)
    with pytest.raises(ValueError, match="output"):
        kernel(5, [table, table], [index], np.zeros((26, 6)))
    with pytest.raises(ValueError, match="output"):
        kernel(5, [table, table], [index], np.zeros((26, 10))[:, ::2])


def test_arrays_in_any_order_are_read_rightly():
    kernel = under_test.kernel(mixed)()
    random = np.random.default_rng(0)
    table, index = random.normal(size=(2, 5)), random.integers(0, 5, 5)
    straight = kernel(5, [table, table], [index])
    assert same(kernel(5, [np.asfortranarray(table), table.T.copy().T], [index]), straight)


COLD = """
import time
import numpy as np
from verifier.compiled import native
from verifier.functions import tanh
from verifier.models import Models
c = np.zeros((12, 5)); c[0] = 0.3; c[1] = 0.01
found = tanh(Models(c, np.zeros(5)))
print(repr((found.c.sum(), found.radius.sum())))
"""


def run_with_cache(value: str) -> str:
    environment = {**os.environ, native.CACHE_VARIABLE: value}
    done = subprocess.run(
        [sys.executable, "-c", COLD], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout


def test_object_code_is_kept_and_mended(tmp_path):
    """A second run reads it; damaged files, and a directory that is none, do no harm."""
    first = run_with_cache(str(tmp_path / "cache"))
    (kept,) = (tmp_path / "cache").iterdir()
    content = kept.read_bytes()
    kept.write_bytes(content[:100])
    assert run_with_cache(str(tmp_path / "cache")) == first
    assert kept.read_bytes() == content
    stamp = kept.stat().st_mtime_ns
    assert run_with_cache(str(tmp_path / "cache")) == first
    assert kept.stat().st_mtime_ns == stamp
    assert run_with_cache("") == first
    (tmp_path / "file").write_text("")
    assert run_with_cache(str(tmp_path / "file" / "beneath")) == first


def test_the_cache_has_its_place(monkeypatch, tmp_path):
    monkeypatch.setenv(native.CACHE_VARIABLE, "")
    assert native.cache_directory() is None
    monkeypatch.setenv(native.CACHE_VARIABLE, str(tmp_path))
    assert native.cache_directory() == tmp_path
    monkeypatch.delenv(native.CACHE_VARIABLE)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    if sys.platform.startswith("linux"):
        assert native.cache_directory() == tmp_path / "closedlap" / "kernels"


def test_nothing_stays_behind_of_a_file_that_cannot_be_written(monkeypatch, tmp_path):
    def full(self, data):
        self.touch()
        raise OSError("no space left on device")

    monkeypatch.setattr(native.Path, "write_bytes", full)
    native._write(tmp_path / "x.o", b"code")
    assert not list(tmp_path.iterdir())


def test_coefficients_beyond_a_model_are_not_read():
    """A batch of one place: all lanes of a vector repeat it."""
    c = np.zeros((TERMS + 2, 1))
    c[0] = 0.5
    z = Models(c, np.zeros(1))
    many = Models(np.repeat(c, 9, axis=1), np.zeros(9))
    one, nine = functions.tanh(z), functions.tanh(many)
    assert (nine.c == one.c).all()
    assert (nine.radius == one.radius).all()
