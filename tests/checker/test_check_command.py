"""The command ``verifier check``: exit statuses and what it says."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
from certified import Proof
from click.testing import CliRunner

from verifier.certificate import instance_sha256, write_certificate
from verifier.cli import main


def run(*arguments: object) -> tuple[int, str]:
    result = CliRunner().invoke(main, ["check", *map(str, arguments)])
    return result.exit_code, result.output


@pytest.fixture
def certificate(turn: Proof, tmp_path):
    write_certificate(turn.certificate, tmp_path / "c.h5")
    return tmp_path / "c.h5"


@pytest.mark.parametrize("jobs", [1, 2])
def test_a_valid_certificate(turn: Proof, certificate, jobs):
    status, said = run(certificate, turn.instance, "--jobs", jobs)
    assert status == 0
    assert said.startswith("valid")
    assert repr(turn.certificate.margin) in said
    assert len(said.splitlines()) == 1


def test_a_sample_is_never_called_valid(turn: Proof, certificate):
    status, said = run(certificate, turn.instance, "--rows", 2, "--seed", 3)
    assert status == 0
    assert "valid" not in said
    assert said.startswith("sampled")
    assert "no proof" in said
    _, said = run(certificate, turn.instance, "--rows", 2, "--json")
    found = json.loads(said)
    assert (found["verdict"], found["checked"]) == ("sampled", 2)


def test_a_rejected_certificate(turn: Proof, tmp_path):
    write_certificate(replace(turn.certificate, margin=1.0), tmp_path / "c.h5")
    status, said = run(tmp_path / "c.h5", turn.instance)
    assert status == 1
    assert said.startswith("rejected: row")
    assert len(said.splitlines()) == 1
    status, said = run(tmp_path / "c.h5", turn.instance, "--json")
    assert status == 1
    assert json.loads(said)["verdict"] == "rejected"


def test_a_proof_says_nothing_of_walls_that_mirror(turn: Proof, tmp_path):
    """The rows are those of the same question without mirrors, where they are valid."""
    data = json.loads(turn.instance.read_bytes())
    wall = {"hall": 0, "begin": [0.0, 1.0], "end": [0.0, 2.0]}
    data["disturbance"] = {
        "noise": 0.0, "missing": 0, "turn_only": False, "choice": "run",
        "mirrors": {"segments": [wall], "incidence": 0.7},
    }  # fmt: skip
    # Beside the other, as its controller is found from there.
    mirrored = turn.instance.with_name("mirrored.json")
    mirrored.write_text(json.dumps(data))
    signed = replace(turn.certificate, instance_sha256=instance_sha256(mirrored.read_bytes()))
    write_certificate(signed, tmp_path / "c.h5")
    status, said = run(tmp_path / "c.h5", mirrored)
    assert status == 1
    assert said.startswith("rejected: nothing can be proved of a disturbance by mirrors")


def test_inputs_that_cannot_be_read(turn: Proof, certificate, tmp_path):
    (tmp_path / "i.json").write_text("{}")
    for arguments in (
        (tmp_path / "none.h5", turn.instance),
        (turn.instance, turn.instance),
        (certificate, tmp_path / "i.json"),
        (certificate, certificate),
    ):
        status, said = run(*arguments)
        assert status == 2
        assert said.startswith("error: ")
        assert len(said.splitlines()) == 1
