"""Writing a proof down as a certificate."""

from __future__ import annotations

from pathlib import Path

from racecar.instance import Instance, read_text
from verifier.certificate import instance_sha256, write_certificate
from verifier.disturbed import cases
from verifier.problem import Problem
from verifier.record import Record

#: The margin is claimed by this much (m) less than it was proved: the checker bounds it in its
#: own way.
SLACK = 1e-6


def certify(
    record: Record, margin: float, problem: Problem, instance: Instance, source: Path, path: Path
) -> None:
    """Write the certificate of a proof to ``path``.

    margin: proved (m, > 0); source: the instance's file.
    """
    certificate = record.certificate(
        instance_sha256(read_text(source)),
        instance.controller.sha256,
        margin - SLACK if margin > 2 * SLACK else margin / 2,
        cases(problem.disturbance, problem.plant.lidar.rays),
    )
    write_certificate(certificate, path)
