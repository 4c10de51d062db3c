"""Proofs for controllers of 61 rays, whose kinks and gaps lie close together."""

from __future__ import annotations

from certified import ROOT, proved

JSON = ROOT / "benchmarks"


def test_a_kink_at_the_end_of_a_row_is_left_to_a_small_part(tmp_path):
    """Two rays reach their range within a ten-millionth of this row: halves do not help."""
    name = "TD3_L61_64x64_C1.closed_loop.w1mm.052.clearance"
    proof = proved(JSON / "closed_loop" / "json" / f"{name}.json", tmp_path, "c")
    assert proof.fault(proof.certificate) == ""


def test_later_roots_cover_what_many_divisions_gave_up(tmp_path):
    """Every division may be wider by rounding: what is covered again has to be wider by all."""
    name = "TD3_L61_64x64_C1.full_range.clearance"
    proof = proved(JSON / "full_range" / "json" / f"{name}.json", tmp_path, "c")
    assert proof.certificate.elsewhere.any()
    proof.checker(proof.certificate).check_all()
