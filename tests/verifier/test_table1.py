"""``verifier table1``: subset widths, what a row sums up, the paper's figures, the command."""

from __future__ import annotations

import json
import re
import time
from decimal import Decimal
from pathlib import Path

import pytest
from enclosed import zero_controller
from instances import least_simulated

from generator.partition import tile
from racecar.controller import save_controller
from racecar.errors import BadInput
from verifier import table1
from verifier.cli import main
from verifier.paper_table1 import CRASH, DNF, PAPER, PARTLY, VERIFIED, PaperRow
from verifier.proof import Prover
from verifier.result import Result
from verifier.scan import Scanner
from verifier.table1 import Settings, make_row, subset_width, subsets, whole_range

ROOT = Path(__file__).parents[2]
TRAINED = ROOT / "onnx" / "TD3_L21_128x128_C1.onnx"
PAPER_TEX = ROOT.parent / "shared" / "paper.tex"

FIELDS = {
    "controller", "verdict", "decided", "width", "network_time_s", "time_s", "paths", "leaves",
    "margin_lower", "margin_upper", "paper",
}  # fmt: skip


@pytest.fixture
def straight(tmp_path) -> Path:
    """A controller that goes straight on: safe until the front wall, 9.9 m away, comes near."""
    save_controller(zero_controller(5), tmp_path / "straight.onnx")
    return tmp_path / "straight.onnx"


# The paper's figures


def printed_table() -> dict[str, PaperRow]:
    """Read Table 1 from the paper's source."""
    if not PAPER_TEX.exists():
        pytest.skip("the paper is not beside the repository")
    text = PAPER_TEX.read_text()
    end = text.index(r"\label{tab:verification}")
    lines = text[text.rindex(r"\begin{tabular}", 0, end) : end].splitlines()
    rows = {}
    for line in lines:
        cells = [c.strip() for c in line.replace(r"\\ \hline", "").split("&")]
        if cells[0] not in {"DDPG", "TD3"}:
            continue
        hidden = cells[1].replace(r" \times ", "x").strip("$")
        name = f"{cells[0]}_L{cells[2]}_{hidden}_C{cells[3]}"
        failed = re.search(r"\\multicolumn\{4\}\{c\|\}\{(.*)\}", line)
        if failed:
            rows[name] = PaperRow(failed[1])
            continue
        size = Decimal(cells[4].removesuffix("*").removesuffix("cm")) / 100
        outcome = PARTLY if cells[4].endswith("*") else VERIFIED
        rows[name] = PaperRow(outcome, float(size), *map(float, cells[5:8]))
    return rows


def test_the_papers_figures_are_those_printed():
    assert printed_table() == PAPER


def test_the_paper_has_sixteen_setups():
    outcomes = [row.outcome for row in PAPER.values()]
    assert len(outcomes) == 16
    # "half of its networks": 7 DNF and a crash.
    assert [outcomes.count(o) for o in (VERIFIED, PARTLY, CRASH, DNF)] == [7, 1, 1, 7]
    assert all((row.width is None) == (row.outcome in {CRASH, DNF}) for row in PAPER.values())


# Subsets


@pytest.mark.parametrize("width", ["0.2", "0.005", "0.002", "0.001", "0.04"])
def test_subsets_are_those_of_the_benchmark(width):
    expected = [(float(a), float(b)) for a, b in tile("0.65", "0.85", width)]
    assert subsets(subset_width(width)) == expected


@pytest.mark.parametrize(
    "text", ["0.3", "0.15", "0.003", "0", "-0.005", "nan", "inf", "wide", "1e-9", ""]
)
def test_widths_that_do_not_tile_the_range_are_refused(text):
    with pytest.raises(BadInput, match="width"):
        subset_width(text)


# Rows, with a verifier whose answers are known


def result(verdict: str, low: float = 0.0, **extra) -> Result:
    values = {
        "verdict": verdict, "margin_lower": 0.01 + low if verdict == "unsat" else None,
        "margin_upper": 0.02 + low, "decided": float(verdict != "unknown"), "leaves": 3,
        "paths": 2, "time_s": 0.0, "witness": None, "network_time_s": 0.5,
    }  # fmt: skip
    return Result(**(values | extra))


class Answers:
    """Stands for the verifier: answers by the subset's bounds, and remembers what it was asked."""

    def __init__(self, monkeypatch, answer):
        self.asked: list[tuple[float, float]] = []
        self.limits: list[float] = []
        self._answer = answer
        monkeypatch.setattr(table1, "verify", self)

    def __call__(self, problem, steer, timeout, report):
        low, high = float(problem.lower[0]), float(problem.upper[0])
        assert (problem.lower[1:] == [9.9, 0, 0]).all()
        assert (problem.upper[1:] == [9.9, 0, 0]).all()
        self.asked.append((low, high))
        self.limits.append(timeout)
        report(0.5)
        return self._answer(low, high)


def test_the_widest_subsets_that_are_decided_are_reported(monkeypatch, straight):
    def answer(low, high):
        return result("unsat" if high - low < 0.003 else "unknown", low, decided=0.25)

    asked = Answers(monkeypatch, answer).asked
    row = make_row(straight, Settings())
    assert row.width == 0.002
    # The whole range, the first of 5 mm, then all of 2 mm; never 1 mm.
    assert asked[:2] == [(0.65, 0.85), (0.65, 0.655)]
    assert asked[2:] == [(float(a), float(b)) for a, b in tile("0.65", "0.85", "0.002")]
    assert [a.width for a in row.tried] == [0.2, 0.005, 0.002]
    assert [a.decided for a in row.tried] == [0.25, 0.25 / 40, 1.0]
    best = row.best
    assert (best.verdict, best.subsets, best.leaves, best.paths) == ("unsat", 100, 300, 200)
    assert best.network_time_s == 50.0
    assert best.margin_lower == 0.01 + 0.65
    assert best.margin_upper == 0.02 + 0.65


def test_one_undecided_subset_is_too_many(monkeypatch, straight):
    last = float(tile("0.65", "0.85", "0.001")[-1][0])
    Answers(monkeypatch, lambda low, _: result("unknown" if low == last else "unsat"))
    row = make_row(straight, Settings(widths=(Decimal("0.001"),)))
    assert row.width is None
    assert row.best.verdict == "unknown"
    assert row.best.decided == pytest.approx(199 / 200, abs=1e-12)
    assert row.best.margin_lower is None


def test_an_unsafe_subset_refutes_the_range(monkeypatch, straight):
    def answer(low, high):
        return result("sat" if low < 0.664 < high else "unsat", margin_upper=0.5 - low)

    asked = Answers(monkeypatch, answer).asked
    row = make_row(straight, Settings(widths=(Decimal("0.005"), Decimal("0.001"))))
    assert (row.width, row.best.verdict, row.best.decided) == (0.005, "sat", 1.0)
    assert len(asked) == 3
    assert row.best.margin_lower is None
    assert row.best.margin_upper == 0.5 - 0.66
    assert row.best.paths == 6


def test_of_undecided_widths_the_one_that_got_furthest_is_reported(monkeypatch, straight):
    def answer(low, high):
        return result("unknown", decided=0.75 if high - low > 0.1 else 1.0)

    Answers(monkeypatch, answer)
    row = make_row(straight, Settings())
    assert row.width is None
    assert (row.best.width, row.best.decided) == (0.2, 0.75)
    assert len(row.tried) == 4


def test_a_width_has_its_time_limit_for_all_subsets_together(monkeypatch, straight):
    def answer(low, high):
        time.sleep(0.02)
        return result("unsat")

    answers = Answers(monkeypatch, answer)
    row = make_row(straight, Settings(widths=(Decimal("0.002"),), timeout=0.1))
    assert row.width is None
    # 100 subsets of 20 ms each would take 2 s.
    assert 1 <= len(answers.asked) <= 5
    assert answers.limits[0] <= 0.1
    assert all(a - b >= 0.02 for a, b in zip(answers.limits, answers.limits[1:], strict=False))
    assert row.best.decided == len(answers.asked) / 100


def test_progress_is_the_share_of_the_width(monkeypatch, straight):
    told = []
    Answers(monkeypatch, lambda low, high: result("unsat" if high - low < 0.1 else "unknown"))
    settings = Settings(widths=(Decimal("0.2"), Decimal("0.05")))
    make_row(straight, settings, lambda *what: told.append(what))
    assert told == [
        ("straight", 0.2, 0.5),
        *(("straight", 0.05, share) for share in (0.125, 0.375, 0.625, 0.875)),
    ]


# Rows, with the verifier itself


def test_a_safe_range_is_decided_at_once(straight):
    """Going straight on for 0.5 s, the nearest wall stays where it was: 0.65 m on either side."""
    row = make_row(straight, Settings(steps=5))
    assert (row.width, row.best.subsets, row.best.verdict) == (0.2, 1, "unsat")
    assert row.best.margin_lower is not None
    assert 0.35 - 1e-4 <= row.best.margin_lower <= 0.35
    assert row.best.margin_upper == pytest.approx(0.35, abs=1e-9)
    assert row.paper is None
    assert 0 < row.best.network_time_s < row.best.time_s


def test_an_unsafe_range_is_refuted_at_once(straight):
    """At up to 2.4 m/s the car reaches the front wall within 7 s."""
    row = make_row(straight, Settings())
    assert (row.width, row.best.verdict, row.best.decided) == (0.2, "sat", 1.0)
    assert row.best.margin_upper is not None
    assert row.best.margin_upper <= 0


def test_subsets_and_the_whole_range_agree_with_simulation():
    """A trained controller until it turns, in one piece and in two."""
    at_once, parts = (
        make_row(TRAINED, Settings(widths=(Decimal(width),), steps=45)) for width in ("0.2", "0.1")
    )
    assert (at_once.best.subsets, parts.best.subsets) == (1, 2)
    simulated = least_simulated(whole_range(TRAINED, Settings(steps=45)))
    for row in (at_once, parts):
        assert row.best.verdict == "unsat"
        assert row.best.margin_lower is not None
        assert simulated - 1e-4 <= row.best.margin_lower <= simulated
    assert parts.best.paths >= 2


def test_a_time_limit_leaves_the_range_undecided(straight):
    row = make_row(straight, Settings(steps=5, timeout=1e-6))
    assert row.width is None
    assert row.best.verdict == "unknown"
    assert row.best.decided < 1
    assert len(row.tried) == 4


def test_network_time_is_that_of_the_network_alone(monkeypatch, straight):
    """Slow the network, then the scan: only the first shows in the network's time."""
    calls = 0

    def slowed(method):
        def slow(*arguments):
            nonlocal calls
            calls += 1
            time.sleep(0.05)
            return method(*arguments)

        return slow

    with monkeypatch.context() as patch:
        patch.setattr(Prover, "_steering", slowed(Prover._steering))
        best = make_row(straight, Settings(steps=5)).best
    assert calls >= 5
    assert 0.05 * calls <= best.network_time_s <= best.time_s
    calls = 0
    with monkeypatch.context() as patch:
        patch.setattr(Scanner, "measure", slowed(Scanner.measure))
        best = make_row(straight, Settings(steps=5)).best
    assert calls >= 5
    assert best.network_time_s <= best.time_s - 0.05 * calls


# The command


def run(capsys, *arguments: str) -> tuple[int, str, str]:
    with pytest.raises(SystemExit) as stop:
        main(["table1", *arguments])
    out, err = capsys.readouterr()
    status = stop.value.code
    assert isinstance(status, int)
    return status, out, err


@pytest.fixture
def root(tmp_path) -> Path:
    """A root with two controllers, one under the name of a setup of the paper."""
    for name in ("mine", "TD3_L21_64x64_C1"):
        save_controller(zero_controller(21), tmp_path / "onnx" / f"{name}.onnx")
    (tmp_path / "onnx" / "mine.json").write_text("{}")
    return tmp_path


@pytest.mark.parametrize("jobs", ["1", "2"])
def test_all_controllers_of_a_root_as_json(root, capsys, jobs):
    status, out, err = run(capsys, "--root", str(root), "--json", "--jobs", jobs)
    assert (status, err) == (0, "")
    rows = [json.loads(line) for line in out.splitlines()]
    assert [row["controller"] for row in rows] == ["TD3_L21_64x64_C1", "mine"]
    for row in rows:
        assert set(row) >= FIELDS
        assert (row["verdict"], row["width"], row["decided"]) == ("sat", 0.2, 1.0)
        assert row["margin_lower"] is None
        assert row["margin_upper"] <= 0
        assert row["time_s"] > 0
    # As the paper prints it: 0.5cm, 553, 4731, 2.2.
    assert rows[0]["paper"] == {
        "outcome": "verified", "width": 0.005, "mean_network_time_s": 553, "mean_time_s": 4731,
        "mean_paths": 2.2,
    }  # fmt: skip
    assert rows[1]["paper"] is None


def test_a_trained_controller_as_a_table(capsys):
    status, out, err = run(capsys, str(TRAINED), "--property", "hscc20")
    assert (status, err) == (0, "")
    assert "7 s, hscc20" in out
    (row,) = (line for line in out.splitlines() if "TD3_L21_128x128_C1" in line)
    assert "unsat" in row
    assert "20 cm, at once" in row
    assert "100 %" in row
    (paper,) = (line for line in out.splitlines() if "paper, per subset" in line)
    cells = [cell.strip() for cell in paper.strip("│").split("│")]
    assert cells[1:7] == ["verified", "5 mm", "", "197", "3760", "1.6"]
    assert "not as ground truth" in " ".join(out.split())


def test_the_papers_note_stands_only_under_the_papers_rows(root, capsys):
    _, out, _ = run(capsys, str(root / "onnx" / "mine.onnx"))
    assert "sat" in out
    assert "paper" not in out


def test_an_undecided_range_says_what_was_tried(capsys):
    given = (str(TRAINED), "--width", "0.005", "--width", "0.2", "--width", "0.005")
    _, out, _ = run(capsys, *given, "--timeout", "1e-6")
    assert "undecided at" in out
    assert "unknown" in out
    assert "100 %" not in out
    _, out, _ = run(capsys, *given, "--timeout", "1e-6", "--json")
    row = json.loads(out)
    assert row["width"] is None
    # Each once, the widest first.
    assert [a["width"] for a in row["tried"]] == [0.2, 0.005]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--width", "0.003"], "0.003"),
        (["--width", "wide"], "wide"),
        (["--root", "empty"], "there is no controller"),
        (["nowhere.onnx"], "nowhere.onnx"),
        (["onnx/mine.onnx", "onnx/broken.onnx"], "broken.onnx"),
        (["--property", "kindness"], "kindness"),
        (["--timeout", "0"], "timeout"),
    ],
)
def test_bad_input_gives_one_line_and_status_2(root, capsys, monkeypatch, arguments, words):
    monkeypatch.chdir(root)
    (root / "empty").mkdir()
    (root / "onnx" / "broken.onnx").write_bytes(b"\x00")
    status, out, err = run(capsys, *arguments, "--json")
    assert status == 2
    assert not out
    (line,) = err.splitlines()
    assert line.startswith("error: ")
    assert words in line
