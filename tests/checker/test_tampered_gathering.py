"""Rows in which others are gathered, tampered with: whatever makes one untrue is noticed."""

from __future__ import annotations

import numpy as np
import pytest
from certified import SOME, Proof, changed, descendants, gathered, joined, taken
from hypothesis import given
from hypothesis import strategies as st

from verifier.certificate import ADVANCE, GATHERED, IMAGE, PART, Certificate


def only_gathered(cert: Certificate) -> tuple[int, list[int]]:
    """Return the first gathered row, and those that go into it."""
    whole = int(np.flatnonzero(cert.kind == GATHERED)[0])
    return whole, np.flatnonzero(cert.into == whole).tolist()


def one_source(proof: Proof) -> tuple[Certificate, int]:
    """Return a certificate that ends in a gathered row of one source, and the source."""
    row = int(np.flatnonzero(proof.certificate.kind == IMAGE)[40])
    kept = np.flatnonzero(~descendants(proof.certificate, row))
    index = int(np.flatnonzero(kept == row)[0])
    return gathered(taken(proof.certificate, kept), [index]), index


@pytest.mark.parametrize("direction", [0, 1, 2, 3])
def test_a_smaller_gathered_row_is_noticed(heap: Proof, direction):
    cert = heap.certificate
    whole, sources = only_gathered(cert)
    assert heap.fault(cert, sources) == ""
    centre, spread = cert.centre[whole].copy(), cert.spread[whole].copy()
    column = centre[:, 1] if direction == 0 else spread[:, direction - 1, 0]
    if np.abs(column).max() < 1e-9:
        return  # the direction of the speed, which is known: the radius has room
    column *= 0.9
    less = changed(cert, whole, centre=centre, spread=spread)
    assert "sticks out" in heap.fault(less, sources)


@SOME
@given(st.integers(0, 3), st.sampled_from([-1.0, 1.0]))
def test_a_shifted_gathered_row_is_noticed(heap: Proof, component, sign):
    cert = heap.certificate
    whole, sources = only_gathered(cert)
    centre = cert.centre[whole].copy()
    centre[component, 0] += sign * 1e-2
    assert "sticks out" in heap.fault(changed(cert, whole, centre=centre), sources)


def test_a_bent_gathered_row_is_noticed(heap: Proof):
    cert = heap.certificate
    whole, sources = only_gathered(cert)
    centre, spread = cert.centre[whole].copy(), cert.spread[whole].copy()
    centre[0, 2], spread[0, 0, 1] = 1e-9, 1e-9
    for bent in ({"centre": centre}, {"spread": spread}):
        assert "bent" in heap.fault(changed(cert, whole, **bent), sources)


def test_a_gathered_row_of_another_step_frame_case_or_kind_is_noticed(drive: Proof):
    cert, index = one_source(drive)
    whole = len(cert) - 1
    assert drive.fault(cert, []) == f"row {whole}: nothing follows it"
    for name, value in (("step", cert.step[index] + 1), ("frame", 1), ("case", 1), ("kind", PART)):
        fault = drive.fault(changed(cert, whole, **{name: value}), [])
        assert fault.startswith((f"row {index}:", f"row {whole}: its step, frame or case"))
    assert drive.fault(changed(cert, whole, parent=index), [])
    assert "assumes" in drive.fault(changed(cert, whole, guard=0), [])


def test_a_row_that_goes_elsewhere_than_into_a_later_gathered_row_is_noticed(drive: Proof):
    last = np.flatnonzero(drive.certificate.step == drive.certificate.step.max()).tolist()
    cert = gathered(drive.certificate, last)
    whole = len(cert) - 1
    assert drive.fault(cert, last) == ""
    row = last[0]
    for into in (row, row - 1, 0, last[-1] if last[-1] != row else 1, whole + 1):
        assert drive.fault(changed(cert, row, into=into), [])
    # What goes into a gathered row ends there.
    inside = int(np.flatnonzero(cert.step == 3)[0])
    both = changed(changed(cert, whole, step=3, frame=cert.frame[inside]), inside, into=whole)
    both = changed(both, np.array(last), into=-1)
    assert "rows follow where none should" in drive.fault(both, [])


def test_a_source_left_out_is_noticed(heap: Proof):
    cert = heap.certificate
    sources = np.flatnonzero(cert.into >= 0)
    for row in sources.tolist():
        assert "nothing follows it" in heap.fault(changed(cert, row, into=-1), [])
        left = taken(cert, np.flatnonzero(np.arange(len(cert)) != row))
        assert heap.fault(left, [])
    # Without what follows the gathered row its sources lead nowhere.
    whole = int(cert.into[sources[0]])
    left = taken(cert, np.flatnonzero(~descendants(cert, whole)))
    assert "nothing follows it" in heap.fault(left, [])


def test_below_a_gathered_row_nothing_lies_elsewhere(drive: Proof):
    cert, _ = one_source(drive)
    cert = joined(changed(cert, len(cert) - 1, elsewhere=True), drive.certificate)
    assert "in no root" in drive.fault(cert, [])


def test_a_gathered_row_is_in_its_frame_if_what_goes_into_it_is(drive: Proof):
    cert = drive.certificate
    beyond = int(np.flatnonzero(cert.kind == ADVANCE)[0])
    before = int(cert.parent[beyond])
    for row, settled in ((beyond, True), (before, False)):
        more = gathered(cert, [row])
        whole = len(more) - 1
        # A wide box: it reaches across both lines.
        more = changed(more, whole, radius=np.full(4, 30.0))
        checker = drive.checker(more)
        assert checker.settled(whole) == settled
        assert checker.settled(row) == settled


def test_a_gathered_row_does_not_change_its_frame_once_more(drive: Proof):
    cert = drive.certificate
    before = int(cert.parent[np.flatnonzero(cert.kind == ADVANCE)[0]])
    children = np.flatnonzero(cert.parent == before)
    kept = np.flatnonzero(~descendants(cert, before))
    more = gathered(taken(cert, kept), [int(np.flatnonzero(kept == before)[0])])
    below = taken(cert, children)
    below = changed(below, np.arange(len(below)), parent=-1)
    whole, count = len(more) - 1, len(more)
    both = joined(more, below)
    both = changed(both, np.arange(count, len(both)), parent=whole)
    assert f"row {whole}: no frame is due to change" in drive.fault(both, [])
