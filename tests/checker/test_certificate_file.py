"""Certificate files: written whole, read strictly."""

from __future__ import annotations

from dataclasses import fields, replace

import h5py
import numpy as np
import pytest
from certified import Proof

from racecar.errors import BadInput
from verifier.certificate import Certificate, instance_sha256, read_certificate, write_certificate


def test_what_is_written_is_read(turn: Proof, tmp_path):
    write_certificate(turn.certificate, tmp_path / "c.h5")
    again = read_certificate(tmp_path / "c.h5")
    for field in fields(Certificate):
        a, b = getattr(turn.certificate, field.name), getattr(again, field.name)
        assert np.array_equal(a, b), field.name
    write_certificate(again, tmp_path / "d.h5")
    assert (tmp_path / "c.h5").read_bytes() == (tmp_path / "d.h5").read_bytes()


def test_every_dataset_says_what_it_is(turn: Proof, tmp_path):
    write_certificate(turn.certificate, tmp_path / "c.h5")
    seen = []
    with h5py.File(tmp_path / "c.h5") as file:
        file.visititems(lambda _, x: seen.append(x.attrs) if isinstance(x, h5py.Dataset) else None)
        assert len(seen) == 19
        assert all(a["units"] and a["description"] for a in seen)


def test_arrays_that_do_not_fit_are_not_written(turn: Proof, tmp_path):
    cert = turn.certificate
    for wrong in (
        replace(cert, step=cert.step[1:]),
        replace(cert, spread=cert.spread[:, :, :, 0]),
        replace(cert, step=cert.step + 0.5),
        replace(cert, frame=cert.frame.astype(int) - 1),
    ):
        with pytest.raises(ValueError, match="certificate"):
            write_certificate(wrong, tmp_path / "c.h5")
    assert list(tmp_path.iterdir()) == []


def test_other_files_are_refused_in_one_line(turn: Proof, tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as file:
        file["x"] = [1.0]
    write_certificate(turn.certificate, tmp_path / "old.h5")
    with h5py.File(tmp_path / "old.h5", "a") as file:
        file.attrs["version"] = "0.9"
    write_certificate(turn.certificate, tmp_path / "kind.h5")
    with h5py.File(tmp_path / "kind.h5", "a") as file:
        values = file["rows/step"][()].astype(float)
        del file["rows/step"]
        file["rows/step"] = values
    (tmp_path / "text.h5").write_text("no")
    for name in ("other.h5", "old.h5", "kind.h5", "text.h5", "missing.h5"):
        with pytest.raises(BadInput) as caught:
            read_certificate(tmp_path / name)
        assert name in str(caught.value)
        assert "\n" not in str(caught.value)


def test_the_hash_of_an_instance_does_not_depend_on_its_layout():
    assert instance_sha256(b'{"a": 1, "b": [0.1]}') == instance_sha256(b'{"b":[0.1],\n"a":1}')
    assert instance_sha256(b'{"a": 1}') != instance_sha256(b'{"a": 2}')
