"""What the verifier says of an instance, and the file in which it says it."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from racecar.controller import write_whole


@dataclass(frozen=True)
class Result:
    """A verdict and what stands behind it.

    verdict: "unsat", "sat" or "unknown"; margin_lower: proved lower bound of the margin (m),
    None unless all of the start set is proved; margin_upper: the least margin seen in
    simulation (m); decided: share of the start set that is proved safe, 1 for sat; leaves:
    pieces of the start set at the end; paths: 1 more than the times a piece was cut at a
    change of walls; witness: start state (s, f, v, theta) if sat; network_time_s: seconds that the
    proof spent in enclosures of the network, summed over its workers; None: not measured (proofs
    for ever).
    """

    verdict: str
    margin_lower: float | None
    margin_upper: float | None
    decided: float
    leaves: int
    paths: int
    time_s: float
    witness: dict[str, float] | None
    note: str = ""
    network_time_s: float | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the result as plain data."""
        return asdict(self)

    def write(self, path: Path) -> None:
        """Write the result file of the harness: the verdict, then the witness as JSON."""
        lines = [self.verdict]
        if self.witness is not None:
            lines.append(json.dumps(self.witness))
        write_whole(path, ("\n".join(lines) + "\n").encode())
