"""``leaderboard build``: what is in a site, and that only what changed is touched."""

import csv
import hashlib
import json
import re
import shutil

import pytest
from click.testing import CliRunner
from site_helpers import (
    CLOSE,
    DRIVE,
    ROOT,
    STRAIGHT,
    Answer,
    build,
    contents,
    leaderboard,
    write_contest,
    write_run,
)

from harness.cli import main as harness_main


@pytest.fixture
def runs(contest, tmp_path):
    """Return a copy of the runs that a test may change."""
    return shutil.copytree(contest, tmp_path / "runs")


def script(path):
    """Return the data in a script that assigns it."""
    text = "".join(
        line for line in path.read_text().splitlines(keepends=True) if not line.startswith("//")
    )
    return json.loads(text.partition(" = ")[2].rstrip().removesuffix(";"))


def test_scores_are_the_harness_s(site, contest):
    runs = [str(contest / name) for name in ("alpha", "beta", "gamma")]
    arguments = ["score", *runs, "--benchmarks", str(ROOT), "--json"]
    result = CliRunner().invoke(harness_main, arguments)
    expected = [json.loads(line) for line in result.stdout.splitlines()]
    rows = json.loads((site / "data/scores.json").read_text())["rows"]
    assert len(rows) == len(expected) == 6
    for row, wanted in zip(rows, expected, strict=True):
        for name in ("tool", "category", "score", "sat", "unsat", "incorrect", "timeout"):
            assert row[name] == wanted[name]
        assert row["percent"] == pytest.approx(wanted["percent"], abs=1e-3)
        assert row["unique"] == len(wanted["unique"])


def test_points_follow_from_the_evidence(site):
    """By the rules: alpha 3 x 10; beta -150 + 10 (refuted by alpha's witness); gamma -150."""
    rows = json.loads((site / "data/scores.json").read_text())["rows"]
    quick = {row["tool"]: row for row in rows if row["category"] == "quick"}
    assert {tool: row["score"] for tool, row in quick.items()} == {
        "alpha": 30,
        "beta": -140,
        "gamma": -150,
    }
    assert quick["gamma"]["missing"] == 1


def test_downloads_name_the_run_that_each_result_came_from(site):
    data = json.loads((site / "data/results/alpha.json").read_text())
    (run,) = data["runs"]
    with (site / "data/results/alpha.csv").open(newline="") as file:
        lines = list(csv.DictReader(file))
    assert {line["instance"] for line in lines} == {CLOSE, STRAIGHT, DRIVE}
    assert {line["run_sha256"] for line in lines} == {run["run_sha256"]}
    assert {r["run_sha256"] for r in data["results"]} == {run["run_sha256"]}
    assert run["limits"]["Wall time given to the tool"] == "20 s"
    assert "host" not in run["machine"]


def test_the_hash_of_a_run_can_be_made_from_its_records(site, contest):
    """As the page of data says: the run, then each record and the check of its witness."""
    from harness.store import RunFolder

    folder = RunFolder.open(contest / "alpha")
    digest = hashlib.sha256(folder.info().model_dump_json().encode() + b"\n")
    for record in folder.records():
        digest.update(record.model_dump_json().encode() + b"\n")
        if record.instance == CLOSE:
            digest.update(folder.check(CLOSE).model_dump_json().encode() + b"\n")
    data = json.loads((site / "data/results/alpha.json").read_text())
    assert data["runs"][0]["run_sha256"] == digest.hexdigest()


def test_nothing_is_touched_when_nothing_changed(runs, tmp_path):
    build(runs, "-o", tmp_path / "site")
    before = contents(tmp_path / "site")
    said = build(runs, "-o", tmp_path / "site")
    assert (said["written"], said["removed"]) == (0, 0)
    assert contents(tmp_path / "site") == before


def test_the_same_runs_give_the_same_bytes_anywhere(runs, tmp_path):
    build(runs, "-o", tmp_path / "one")
    build(runs / "alpha", runs / "beta", runs / "gamma", "-o", tmp_path / "two")
    one, two = contents(tmp_path / "one"), contents(tmp_path / "two")
    assert {name: content for name, (content, _) in one.items()} == {
        name: content for name, (content, _) in two.items()
    }


def test_a_new_run_leaves_what_it_does_not_concern(runs, tmp_path):
    site = tmp_path / "site"
    build(runs, "-o", site)
    before = contents(site)
    write_run(runs / "delta", "delta", {STRAIGHT: Answer("unsat", 4.0)})
    build(runs, "-o", site)
    after = contents(site)
    touched = {name for name in after if after[name] != before.get(name)}
    assert f"instances/{STRAIGHT}.html" in touched
    assert "tools/delta.html" in touched
    # Pictures, other instances' pages and other tools' results are as they were.
    pages = (f"instances/{DRIVE}.html", f"instances/{CLOSE}.html")
    pictures = (f"instances/{CLOSE}.js", f"instances/{STRAIGHT}.js")
    for name in (*pages, *pictures, "data/results/alpha.json", "assets/site.css"):
        assert name not in touched


def test_what_is_no_longer_part_of_the_site_is_removed(runs, tmp_path):
    site = tmp_path / "site"
    build(runs, "-o", site)
    (site / "CNAME").write_text("mine")  # whatever a host wants there is left alone
    shutil.rmtree(runs / "gamma")
    said = build(runs, "-o", site)
    assert said["removed"] == 4  # its page, its results as script, CSV and JSON
    assert not (site / "tools/gamma.html").exists()
    assert (site / "CNAME").exists()


def test_a_folder_with_something_else_is_refused_and_left_alone(contest, tmp_path):
    (tmp_path / "thesis.txt").write_text("years of work")
    done = leaderboard("build", contest, "-o", tmp_path, "--benchmarks", ROOT)
    assert done.returncode == 2
    assert "not empty and not a site" in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.txt"]


def test_a_listing_that_names_files_elsewhere_is_refused(contest, tmp_path):
    victim = tmp_path / "victim"
    victim.write_text("keep")
    site = tmp_path / "site"
    site.mkdir()
    listing = {"format": "closedlap-site", "version": "1.0", "files": ["../victim"]}
    (site / "files.json").write_text(json.dumps(listing))
    done = leaderboard("build", contest, "-o", site, "--benchmarks", ROOT)
    assert done.returncode == 2
    assert "outside of the site" in done.stderr
    assert victim.read_text() == "keep"


def test_a_build_that_was_stopped_is_continued(runs, tmp_path, monkeypatch):
    import leaderboard.build

    def stop(*arguments):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(leaderboard.build, "downloads", stop)
        assert leaderboard_status("build", runs, "-o", tmp_path / "site") == 130
    assert build(runs, "-o", tmp_path / "site")["tools"] == 3


def leaderboard_status(*arguments):
    return leaderboard(*arguments, "--benchmarks", ROOT).returncode


@pytest.mark.parametrize("what", ["nothing", "empty", "file"])
def test_what_is_no_run_is_refused(what, tmp_path):
    path = tmp_path / what
    if what == "empty":
        path.mkdir()
    if what == "file":
        path.write_text("no run")
    done = leaderboard("build", path, "-o", tmp_path / "site", "--benchmarks", ROOT)
    assert done.returncode == 2
    assert str(path) in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert not (tmp_path / "site").exists()


def test_two_runs_of_one_tool_on_an_instance_are_refused(contest, tmp_path):
    write_contest(tmp_path / "again")
    done = leaderboard("build", contest, tmp_path / "again", "-o", tmp_path / "site")
    assert done.returncode == 2
    assert "already has a result" in done.stderr
    assert not (tmp_path / "site").exists()


def test_logs_are_shown_shortened(tmp_path):
    log = "begin\n" + "x" * 20_000 + "\nend\n"
    write_run(tmp_path / "run", "talker", {STRAIGHT: Answer("unknown", log=log)})
    build(tmp_path / "run", "-o", tmp_path / "site", "--log-bytes", 100)
    page = (tmp_path / f"site/instances/{STRAIGHT}.html").read_text()
    assert f"log of {len(log)} bytes" in page
    assert f"[... {len(log) - 100} bytes left out ...]" in page
    assert "begin" in page
    assert "\nend\n" in page
    assert "x" * 100 not in page


def test_pages_have_no_inline_script_or_style_and_refer_to_nothing_outside(site):
    for path in site.rglob("*.html"):
        page = path.read_text()
        assert "default-src 'none'; script-src 'self'; style-src 'self'" in page
        assert not re.search(r"<script(?![^>]*\bsrc=)", page)
        assert not re.search(r"<style|\sstyle=|\son\w+=|javascript:", page)
        for address in re.findall(r'(?:src|href)="([^"]*)"', page):
            # The paper's DOI is a link that a reader may follow; nothing is loaded from there.
            if address.startswith("https://doi.org/"):
                continue
            assert not re.match(r"[a-z]+:|//", address)
            target = address.partition("#")[0]
            assert not target or (path.parent / target).resolve().is_file(), (path, address)


def test_the_paper_s_second_table_is_as_printed(paper_text):
    """Compared with the paper's own source, where that is beside the repository."""
    from leaderboard.history import TABLE2

    pattern = r"^(DDPG|TD3) & \$(\d+) \\times (\d+)\$ & (\d+) & (\d) & (\d+)/10 & (\d+)/10"
    rows = re.findall(pattern, paper_text, re.MULTILINE)
    assert len(rows) == 12
    found = {
        f"{algorithm}_L{rays}_{a}x{b}_C{index}": (int(modified), int(unmodified))
        for algorithm, a, b, rays, index, modified, unmodified in rows
    }
    assert found == {name: (row.modified, row.unmodified) for name, row in TABLE2.items()}


@pytest.fixture
def paper_text():
    from pathlib import Path

    path = Path(__file__).parents[2].parent / "shared" / "paper.tex"
    if not path.exists():
        pytest.skip("the paper's text is not beside the repository")
    return path.read_text()


def test_history_is_shown_and_not_ranked(site):
    page = (site / "index.html").read_text()
    assert "history, not ranked" in page
    assert page.index('id="history"') > page.index('id="scores-1"')
    ranked = page[: page.index('id="history"')]
    assert "Verisig" not in ranked


def test_pictures_hold_what_was_proved_and_found(site):
    close, straight = (script(site / f"instances/{name}.js") for name in (CLOSE, STRAIGHT))
    assert close["witness"]["tool"] == "alpha"
    assert close["witness"]["start"] == [0.28, 9.9, 0.0, 0.0]
    assert close["witness"]["crashed"]
    assert close["tube"] is None
    assert straight["witness"] is None
    assert straight["tube"]["margin"] > 0
    assert len(straight["tube"]["steps"]) == 6  # 5 steps and the start
    assert not any(trace["crashed"] for trace in straight["traces"])
