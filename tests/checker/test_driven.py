"""Periods of many rows at once, in doubles, against the same periods in Arb."""

from __future__ import annotations

import numpy as np
import pytest
from certified import SOME, changed
from hypothesis import given
from hypothesis import strategies as st

from checker.files import Rejected
from checker.inclusion import state_of
from checker.rows import Checker
from verifier.certificate import IMAGE


def answers(checker: Checker):
    """Return the network's answers to the scans of all rows that drive."""
    return checker._answers([i for i in range(len(checker.rows)) if checker._drives(i)])


@pytest.mark.parametrize("name", ["turn", "drive", "noisy"])
def test_nearly_all_periods_are_proved_in_doubles(name, request):
    proof = request.getfixturevalue(name)
    checker = proof.checker(proof.certificate)
    known = answers(checker)
    assert len(checker._driven(known)) >= 0.95 * len(known) > 0


@pytest.mark.parametrize("name", ["drive", "noisy"])
@SOME
@given(st.integers(0, 2**32), st.sampled_from([1e-1, 1e-3, 1e-6]))
def test_nothing_is_proved_in_doubles_that_is_not_in_arb(name, request, seed, size):
    """Images and the margin are moved by just so much that about half of the rows fail."""
    proof, random = request.getfixturevalue(name), np.random.default_rng(seed)
    cert = proof.certificate
    images = np.flatnonzero(cert.kind == IMAGE)
    factors = 1 + size * random.uniform(-1, 1, (2, len(images)))
    spread = cert.spread[images] * factors[0][:, None, None, None]
    checker = proof.checker(
        changed(cert, images, spread=spread, radius=cert.radius[images] * factors[1][:, None])
    )
    checker.margin += size * random.choice([0, 0.3])
    known = answers(checker)
    found = checker._driven(known)
    for i in sorted(found)[:: max(1, len(found) // 20)]:
        row, image = checker.rows[i], checker.rows[checker.forest.children[i][0]]
        checker._check_period(row, state_of(row), known[i], image, ())
    for i in [i for i in known if i not in found][:5]:  # nor is much more proved in Arb
        row, image = checker.rows[i], checker.rows[checker.forest.children[i][0]]
        with pytest.raises((Rejected, ArithmeticError)):
            checker._check_period(row, state_of(row), known[i], image, ())
