"""Certificates of noisy instances that were proved in parts of the start range."""

from __future__ import annotations

import numpy as np
import pytest
from certified import Proof, proved, taken, write_instance

from verifier import halves
from verifier.certificate import ROOT

STEPS = 2


@pytest.fixture(scope="module")
def halved(tmp_path_factory) -> Proof:
    """Two halves: no attempt at the whole was allowed to come to its end."""
    folder = tmp_path_factory.mktemp("halved")
    start = {"s": [0.749, 0.751], "f": [4.0, 4.0], "v": [2.4, 2.4]}
    fault = {"noise": 0.001, "missing": 0, "turn_only": True, "choice": "run"}
    base = "TD3_L21_64x64_C1.quick.straight05.clearance"
    instance = write_instance(
        folder / "i.json", base, initial_set=start, steps=STEPS, disturbance=fault
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(halves, "MOST_HALVES", 1)
        patch.setattr(halves, "BOLD_ROWS", STEPS - 1)
        patch.setattr(halves, "USUAL_ROWS", STEPS - 1)
        return proved(instance, folder, "c")


def test_the_halves_together_are_a_proof(halved):
    cert = halved.certificate
    assert np.flatnonzero(cert.kind == ROOT).size == 2
    assert halved.fault(cert) == ""


@pytest.mark.parametrize("lost", [0, 1])
def test_one_half_is_not(halved, lost):
    cert = halved.certificate
    begins = [*np.flatnonzero(cert.kind == ROOT), len(cert)]
    rows = np.delete(np.arange(len(cert)), np.arange(begins[lost], begins[lost + 1]))
    assert "leave a gap" in halved.fault(taken(cert, rows))
