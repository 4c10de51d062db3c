"""A proof and a witness against each other: by a verifier, and a checker, that lie."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import pytest
from click.testing import CliRunner
from quick_root import NAME, make_root

from generator.cli import main
from generator.reference import runs
from generator.reference.make import Contradiction, load_questions, make
from generator.reference.rows import REFERENCE
from generator.reference.runs import Outcome, Work
from harness.catalogue import load_category

REFUTED, BESIDE, SHORTER = (
    f"{NAME}.quick.{rest}.clearance" for rest in ("nose05", "beside", "shorter")
)


@dataclass(frozen=True)
class Liar(Work):
    """Says unsat of an instance, whatever is true, and accepts it if it is told to."""

    of: str = BESIDE
    accepts: bool = True
    checked: list[str] = field(default_factory=list)

    def prove(self, entries):
        found = super().prove(entries)
        if self.of in found:
            true = found[self.of]
            lie = true.record.model_copy(update={"verdict": "unsat"})
            self.certificate(self.of).write_bytes(b"a proof")
            found[self.of] = Outcome(lie, {"margin_lower": 0.1}, None)
        return found

    def check(self, entries):
        self.checked.extend(entry.id for entry in entries)
        found = super().check(entries)
        if self.of in found and self.accepts:
            lie = found[self.of].record.model_copy(update={"verdict": "unsat"})
            found[self.of] = Outcome(lie, {"verdict": "valid", "margin": 0.1, "rows": 1}, None)
        return found


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A root with a refuted instance, another from a wider start set, and a shorter one."""
    root = tmp_path_factory.mktemp("root")

    def derive(first):
        wider = first.initial_set.model_copy(update={"s": (0.5, 0.56)})
        return (
            first.model_copy(update={"id": BESIDE, "steps": 4, "initial_set": wider}),
            first.model_copy(update={"id": SHORTER, "steps": 1}),
        )

    make_root(root, dict.fromkeys((REFUTED, BESIDE, SHORTER), 60), REFUTED, derive)
    return root


def made(root: Path, *ids: str, **lie):
    """Return the results of instances in that order, and which certificates were checked."""
    work = Liar(root / "work" / "-".join(lie), root / "benchmarks", None, 60.0, **lie)
    entries = {entry.id: entry for entry in load_category(root / "benchmarks", "quick")}
    questions = load_questions(entries[id] for id in ids)
    return make(questions, work, lambda done, total: None), work.checked


@pytest.mark.parametrize("order", [(REFUTED, BESIDE), (BESIDE, REFUTED)])
def test_an_accepted_proof_against_a_witness_stops_everything(root, order):
    with pytest.raises(Contradiction, match=f"{BESIDE}: the witness of {REFUTED} holds"):
        made(root, *order)


def test_a_refuted_proof_that_is_not_accepted_is_named(root):
    results, checked = made(root, REFUTED, BESIDE, accepts=False)
    assert checked == [BESIDE]
    row = results.rows[BESIDE]
    assert (row.verdict, row.source) == ("sat", REFUTED)
    assert (
        row.method == "witness of another question, replayed, against a proof that was not accepted"
    )


def test_nothing_is_written_after_a_contradiction(root, monkeypatch):
    monkeypatch.setattr("generator.reference.command.Work", Liar, raising=False)
    monkeypatch.setattr(runs, "Work", Liar)
    place = root / "work" / "command"
    done = CliRunner().invoke(main, ["reference", f"--root={root}", f"--work={place}"])
    assert done.exit_code == 1
    assert "one of them is wrong: nothing was written" in done.output
    assert not (root / "benchmarks" / "quick" / REFERENCE).exists()
