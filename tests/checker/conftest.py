from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from certified import QUICK, Proof, added, descendants, gathered, proved, taken, write_instance

from verifier import halves
from verifier.certificate import IMAGE


@pytest.fixture(scope="session")
def turn(tmp_path_factory) -> Proof:
    """Two steps into the turn from 30 cm at once: rays pass the inner corner."""
    folder = tmp_path_factory.mktemp("turn")
    start = {"s": [0.6, 0.9], "f": [2.6, 2.6], "v": [2.4, 2.4]}
    base = "DDPG_L21_64x64_C1.quick.turn10.clearance"
    return proved(write_instance(folder / "i.json", base, initial_set=start, steps=2), folder, "c")


@pytest.fixture(scope="session")
def drive(tmp_path_factory) -> Proof:
    """70 steps, into the next hall's frame."""
    folder = tmp_path_factory.mktemp("drive")
    return proved(QUICK / "DDPG_L21_64x64_C1.quick.drive70.clearance.json", folder, "c")


@pytest.fixture(scope="session")
def heap(tmp_path_factory) -> Proof:
    """Five steps, two neighbours gathered before the last, whose image is wide."""
    folder = tmp_path_factory.mktemp("heap")
    proof = proved(QUICK / "DDPG_L21_64x64_C1.quick.straight05.hscc20.json", folder, "c")
    late = np.flatnonzero((proof.certificate.step == 4) & (proof.certificate.kind == IMAGE))
    late = late[np.argsort(proof.certificate.centre[late, 0, 0])][:2]
    kept = np.ones(len(proof.certificate), dtype=bool)
    for row in late:
        kept &= ~descendants(proof.certificate, row)
    cert = taken(proof.certificate, np.flatnonzero(kept))
    cert = gathered(cert, np.searchsorted(np.flatnonzero(kept), late).tolist())
    wide = {"spread": np.zeros_like(cert.spread[0]), "radius": np.array([0.1, 0.5, 0.5, 0.5])}
    cert = added(cert, len(cert) - 1, parent=len(cert) - 1, kind=IMAGE, step=5, **wide)
    # The gathered row holds more than was driven: its margin is less.
    return replace(proof, certificate=replace(cert, margin=cert.margin - 1e-2))


@pytest.fixture(scope="session")
def missing(tmp_path_factory) -> Proof:
    """One missing ray in the turn: 22 cases."""
    folder = tmp_path_factory.mktemp("missing")
    start = {"s": [0.749, 0.75], "f": [2.51, 2.51], "v": [2.4, 2.4]}
    fault = {"noise": 0.0, "missing": 1, "turn_only": True, "choice": "run"}
    base = "TD3_L21_64x64_C1.quick.straight05.clearance"
    instance = write_instance(
        folder / "i.json", base, initial_set=start, steps=2, disturbance=fault
    )
    return proved(instance, folder, "c")


@pytest.fixture(scope="session")
def noisy(tmp_path_factory) -> Proof:
    """Five steps with noise at full speed: symbols with products, rows described anew."""
    folder = tmp_path_factory.mktemp("noisy")
    start = {"s": [0.735, 0.765], "f": [4.0, 4.0], "v": [2.3, 2.35]}
    fault = {"noise": 0.002, "missing": 0, "turn_only": True, "choice": "run"}
    base = "TD3_L21_64x64_C1.quick.straight05.clearance"
    instance = write_instance(folder / "i.json", base, initial_set=start, disturbance=fault)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(halves, "BOLD_ROWS", 0)  # a bold proof has nothing of that
        return proved(instance, folder, "c")
