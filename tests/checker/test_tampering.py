"""Certificates that hold are accepted; whatever makes one untrue is noticed."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from certified import SOME, Proof, changed, descendants, joined, taken
from hypothesis import given, settings
from hypothesis import strategies as st

from checker.files import Rejected, Unreadable, read_certificate, read_instance
from checker.models import BASE, KNOWN
from verifier.certificate import (
    ADVANCE,
    CROSS,
    IMAGE,
    PART,
    Certificate,
    write_certificate,
)

ROWS = st.integers(0, 10**6)


def pick(cert: Certificate, where: np.ndarray, number: int) -> int:
    """Return one of the rows where something holds."""
    found = np.flatnonzero(where)
    assert found.size
    return int(found[number % found.size])


def around(cert: Certificate, row: int) -> list[int]:
    """Return the row, its parent, and what follows from it in the same step."""
    near = np.flatnonzero(descendants(cert, row) & (cert.step == cert.step[row]))
    parent = int(cert.parent[row])
    return [row, *([parent] if parent >= 0 else []), *near.tolist()]


@pytest.mark.parametrize("name", ["turn", "drive", "missing", "heap", "noisy"])
def test_certificates_of_the_verifier_are_accepted(request, name):
    proof = request.getfixturevalue(name)
    rows = None if name in {"turn", "heap", "noisy"} else list(range(0, len(proof.certificate), 7))
    assert proof.fault(proof.certificate, rows) == ""


def test_the_certificates_tampered_with_here_have_all_there_is(
    turn: Proof, drive: Proof, missing: Proof, heap: Proof
):
    guards = turn.certificate.guard
    assert (turn.certificate.guard_kind[guards[guards >= 0]] == CROSS).any()
    assert set(drive.certificate.kind) >= {PART, IMAGE, ADVANCE}
    assert len(missing.certificate.missing) == 22
    assert (heap.certificate.into >= 0).sum() == 2


@SOME
@given(ROWS, st.integers(0, 3), st.sampled_from([-1.0, 1.0]))
def test_a_shifted_row_is_noticed(drive: Proof, number, component, sign):
    cert = drive.certificate
    row = pick(cert, cert.kind != 0, number)
    width = np.abs(cert.spread[row, component]).sum() + cert.radius[row, component]
    centre = cert.centre[row].copy()
    centre[component, 0] += sign * 4 * width
    assert drive.fault(changed(cert, row, centre=centre), around(cert, row))


@SOME
@given(ROWS, st.integers(0, 5))
def test_a_changed_coefficient_of_the_start_position_is_noticed(drive: Proof, number, order):
    cert = drive.certificate
    row = pick(cert, cert.kind != 0, number)
    centre = cert.centre[row].copy()
    centre[0, order] += 1e-3
    assert drive.fault(changed(cert, row, centre=centre), around(cert, row))


@SOME
@given(ROWS)
def test_a_shrunk_row_is_noticed(drive: Proof, number):
    cert = drive.certificate
    row = pick(cert, cert.kind == IMAGE, number)
    less = changed(cert, row, spread=cert.spread[row] * 1e-3, radius=cert.radius[row] * 1e-3)
    assert drive.fault(less, [int(cert.parent[row])])


@SOME
@given(ROWS)
def test_a_narrowed_part_of_a_guard_is_noticed(turn: Proof, number):
    cert = turn.certificate
    cut = (cert.kind == PART) & (cert.guard >= 0)
    cut &= (np.abs(cert.piece) != 1).any(axis=(1, 2))
    row = pick(cert, cut, number)
    piece = cert.piece[row].copy()
    side = 0 if piece[0, 0] > -1 else 1
    piece[0, side] += 0.05 if side == 0 else -0.05
    assert turn.fault(changed(cert, row, piece=piece), [int(cert.parent[row])])


@SOME
@given(ROWS, st.sampled_from([(1.0, 1.0), (-1.0, -1.0), (-1.0, 0.99), (0.5, -0.5), (-1.0, 1.5)]))
def test_a_piece_that_is_less_or_none_is_noticed(turn: Proof, number, ends):
    cert = turn.certificate
    row = pick(cert, cert.kind != 0, number)
    piece = cert.piece[row].copy()
    if tuple(piece[0]) == ends:
        return
    piece[0] = ends
    narrower = ends[0] > cert.piece[row, 0, 0] or ends[1] < cert.piece[row, 0, 1]
    fault = turn.fault(changed(cert, row, piece=piece), [int(cert.parent[row])])
    assert fault or not (narrower or cert.kind[row] == IMAGE)


@pytest.mark.parametrize("name", ["turn", "drive"])
@SOME
@given(ROWS)
def test_a_part_left_out_is_noticed(request, name, number):
    proof = request.getfixturevalue(name)
    cert = proof.certificate
    row = pick(cert, cert.kind == PART, number)
    gone = descendants(cert, row)
    gone[row] = True
    left = taken(cert, np.flatnonzero(~gone))
    parent = int(np.flatnonzero(np.flatnonzero(~gone) == cert.parent[row])[0])
    assert proof.fault(left, [parent])


@SOME
@given(ROWS)
def test_a_row_that_nothing_follows_is_noticed(drive: Proof, number):
    cert = drive.certificate
    row = pick(cert, cert.step < cert.step.max(), number)
    left = taken(cert, np.flatnonzero(~descendants(cert, row)))
    assert "nothing follows it" in drive.fault(left, [])


@SOME
@given(ROWS, st.data())
def test_another_parent_is_noticed(drive: Proof, number, data):
    cert = drive.certificate
    row = pick(cert, cert.parent > 0, number)
    other = data.draw(st.integers(-1, row - 1).filter(lambda p: p != cert.parent[row]))
    rows = [int(cert.parent[row]), *([other] if other >= 0 else [])]
    assert drive.fault(changed(cert, row, parent=other), rows)


@SOME
@given(ROWS, st.sampled_from(["step", "frame", "kind"]), st.integers(0, 3))
def test_another_step_frame_or_kind_is_noticed(drive: Proof, number, name, value):
    cert = drive.certificate
    row = pick(cert, getattr(cert, name) != value, number)
    assert drive.fault(changed(cert, row, **{name: value}), around(cert, row))


@SOME
@given(ROWS)
def test_a_guard_taken_away_is_noticed(turn: Proof, number):
    cert = turn.certificate
    row = pick(cert, cert.guard >= 0, number)
    assert turn.fault(changed(cert, row, guard=-1), around(cert, row))


@SOME
@given(ROWS, st.sampled_from(["positive", "ray", "obstacle", "front", "back", "guard_kind"]))
def test_a_changed_guard_is_noticed(turn: Proof, number, name):
    cert = turn.certificate
    guard = int(cert.guard[pick(cert, cert.guard >= 0, number)])
    old = getattr(cert, name)[guard]
    value = not old if name == "positive" else (int(old) + 1) % 3
    rows = [i for r in np.flatnonzero(cert.guard == guard) for i in around(cert, int(r))]
    assert turn.fault(changed(cert, guard, **{name: value}), rows)


@SOME
@given(ROWS)
def test_an_unfounded_elsewhere_is_noticed(drive: Proof, number):
    cert = drive.certificate
    row = pick(cert, cert.step < cert.step.max(), number)
    assert drive.fault(changed(cert, row, elsewhere=True), [])
    left = taken(cert, np.flatnonzero(~descendants(cert, row)))
    index = int(np.flatnonzero(np.flatnonzero(~descendants(cert, row)) == row)[0])
    assert "later roots" in drive.fault(changed(left, index, elsewhere=True), [])


@SOME
@given(ROWS)
def test_what_lies_elsewhere_may_be_proved_by_later_roots_only(drive: Proof, number):
    cert = drive.certificate
    row = pick(cert, cert.step < cert.step.max(), number)
    kept = np.flatnonzero(~descendants(cert, row))
    index = int(np.flatnonzero(kept == row)[0])
    given_up = changed(taken(cert, kept), index, elsewhere=True)
    assert drive.fault(joined(given_up, cert), []) == ""
    assert "later roots" in drive.fault(joined(cert, given_up), [])


def test_a_root_that_is_too_small_is_noticed(drive: Proof):
    cert = drive.certificate
    for name, value in (("centre", 0.9), ("centre", 1.1)):
        array = getattr(cert, name)[0].copy()
        array[cert.lead, 1 if value < 1 else 0] *= value
        assert drive.fault(changed(cert, 0, **{name: array}), [])


def test_another_lead_component_is_noticed(drive: Proof):
    for lead in (-1, 1, 2, 3, 4):
        assert drive.fault(replace(drive.certificate, lead=lead), [])


def test_a_larger_margin_is_noticed(turn: Proof):
    assert "margin" in turn.fault(replace(turn.certificate, margin=turn.certificate.margin + 1e-4))
    assert "margin" in turn.fault(replace(turn.certificate, margin=0.0), [])


def test_a_missing_case_is_noticed(missing: Proof):
    cert = missing.certificate
    assert "case" in missing.fault(taken(cert, np.flatnonzero(cert.case != 5)), [])
    masks = cert.missing.copy()
    masks[3] = masks[4]
    assert "case" in missing.fault(replace(cert, missing=masks), [])


@SOME
@given(ROWS)
def test_another_case_is_noticed(missing: Proof, number):
    cert = missing.certificate
    row = pick(cert, cert.kind != 0, number)
    other = (cert.case[row] + 1) % len(cert.missing)
    assert missing.fault(changed(cert, row, case=other), around(cert, row))


def test_the_rays_of_a_case_matter_to_the_image(missing: Proof):
    cert = missing.certificate
    order = np.roll(np.arange(len(cert.missing)), 1)
    assert missing.fault(replace(cert, missing=cert.missing[order])) != ""


def test_other_hashes_are_noticed(turn: Proof):
    for name in ("instance_sha256", "weights_sha256"):
        assert turn.fault(replace(turn.certificate, **{name: "0" * 64}), [])


def test_another_instance_is_noticed(turn: Proof, tmp_path):
    data = json.loads(turn.instance.read_text())
    data["plant"]["frames"][0]["obstacles"][0][0][2] -= 0.01
    (tmp_path / "i.json").write_text(json.dumps(data))
    other = Proof(tmp_path / "i.json", turn.certificate, tmp_path)
    assert "another instance" in other.fault(turn.certificate, [])


def test_nothing_is_proved_of_a_disturbance_that_is_not_known(turn: Proof, tmp_path):
    """The certificate is in order but for the walls that mirror, which the instance has."""
    data = json.loads(turn.instance.read_text())
    wall = {"hall": 0, "begin": [0.0, 0.0], "end": [0.0, 1.0]}
    quiet = {"noise": 0.0, "missing": 0, "turn_only": True, "choice": "run"}
    for fault, reason in (
        (quiet, ""),
        (quiet | {"mirrors": None}, ""),
        (quiet | {"mirrors": {"segments": [wall], "incidence": 0.8}}, "mirrors"),
        (quiet | {"rain": 0}, "rain"),
    ):
        path = tmp_path / "i.json"
        path.write_text(json.dumps(data | {"disturbance": fault}))
        own = replace(turn.certificate, instance_sha256=read_instance(path).sha256)
        found = Proof(path, own, tmp_path).fault(own, [])
        assert found == reason if not reason else reason in found


def test_another_network_file_is_noticed(turn: Proof, tmp_path):
    data = json.loads(turn.instance.read_text())
    (tmp_path / "n.onnx").write_bytes(b"x")
    data["controller"]["file"] = "n.onnx"
    (tmp_path / "i.json").write_text(json.dumps(data))
    with pytest.raises(Unreadable, match="sha256"):
        read_instance(tmp_path / "i.json")


def test_numbers_that_are_not_finite_or_radii_below_zero_are_noticed(turn: Proof):
    cert = turn.certificate
    assert "negative" in turn.fault(changed(cert, 3, radius=-1e-9), [])
    write_certificate(changed(cert, 3, radius=np.inf), turn.folder / "inf.h5")
    with pytest.raises(Unreadable, match="finite"):
        read_certificate(turn.folder / "inf.h5")


def test_a_row_at_the_end_may_be_wider(turn: Proof):
    cert = turn.certificate
    row = int(np.flatnonzero(cert.step == cert.step.max())[0])
    wider = changed(cert, row, radius=cert.radius[row] * 2 + 1e-9)
    assert turn.fault(wider, around(cert, row)) == ""


def test_files_cut_short_are_unreadable(turn: Proof, tmp_path):
    write_certificate(turn.certificate, tmp_path / "c.h5")
    content = (tmp_path / "c.h5").read_bytes()
    for size in (0, 100, len(content) // 2):
        (tmp_path / "c.h5").write_bytes(content[:size])
        with pytest.raises(Unreadable):
            read_certificate(tmp_path / "c.h5")


@SOME
@given(ROWS, st.integers(0, 3), st.integers(BASE, KNOWN - 1))
def test_symbols_that_are_products_are_no_symbols_of_their_own(noisy: Proof, number, place, symbol):
    """Of roots and gathered rows: nothing would say that their members are products."""
    cert = noisy.certificate
    row = pick(cert, cert.parent < 0, number)
    spread = cert.spread[row].copy()
    spread[place, symbol, 0] = 1e-3
    assert "products" in noisy.fault(changed(cert, row, spread=spread), [])


@SOME
@given(ROWS, st.integers(BASE, KNOWN - 1))
def test_a_changed_product_is_noticed(noisy: Proof, number, symbol):
    cert = noisy.certificate
    row = pick(cert, cert.kind == IMAGE, number)
    spread = cert.spread[row].copy()
    spread[0, symbol, 0] += 0.1
    assert noisy.fault(changed(cert, row, spread=spread), around(cert, row))


def test_a_product_is_not_divided(noisy: Proof):
    cert = noisy.certificate
    row = pick(cert, cert.kind == PART, 0)
    piece = cert.piece[row].copy()
    piece[:] = [-1.0, 1.0]
    piece[1 + BASE] = [-1.0, 0.0]
    assert noisy.fault(changed(cert, row, piece=piece), around(cert, row))


def inside(point: np.ndarray, cuts) -> bool:
    """Tell whether a point (x, e_0, e_1, e_2) is in a part of the domain."""
    point = point.copy()
    for parameter, low, high in cuts:
        middle, half = float(low + high) / 2, float(high - low) / 2
        point[parameter] = (point[parameter] - middle) / half
    return bool((np.abs(point) <= 1).all())


@settings(SOME, max_examples=5)
@given(number=ROWS, seed=ROWS)
def test_the_parts_into_which_a_step_is_divided_are_the_whole(noisy: Proof, number, seed):
    """Every place of the row's domain is in a part that was proved, or the row is rejected."""
    random = np.random.default_rng(seed)
    checker = noisy.checker(noisy.certificate)
    image = pick(noisy.certificate, noisy.certificate.kind == IMAGE, number)
    row = int(noisy.certificate.parent[image])
    shown = []

    def period(row, state, assumed, image, cuts):
        if len(cuts) < 4 and random.random() < 0.6:
            raise Rejected("too wide")
        shown.append(cuts)

    checker._check_period = period
    checker.check_row(row)
    for point in random.uniform(-1, 1, (200, 4)):
        assert sum(inside(point, cuts) for cuts in shown) >= 1

    def never(row, state, assumed, image, cuts):
        if inside(np.array([0.3, 0.3, 0.3, 0.3]), cuts):
            raise Rejected("not at all")

    checker._check_period = never
    with pytest.raises(Rejected, match="not at all"):
        checker.check_row(row)


def test_symbols_have_to_fit_the_instance(noisy: Proof):
    """With fewer, symbols of readings would be taken for products."""
    cert = noisy.certificate
    few = replace(
        cert,
        spread=np.ascontiguousarray(cert.spread[:, :, -3:]),
        piece=np.ascontiguousarray(np.concatenate([cert.piece[:, :1], cert.piece[:, -3:]], axis=1)),
    )
    assert "symbols" in noisy.fault(few, [])
