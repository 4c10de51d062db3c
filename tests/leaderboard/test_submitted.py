"""Submissions in the place of runs: what `harness submit` writes gives the same site."""

import json

import pytest
from click.testing import CliRunner
from site_helpers import CLOSE, ROOT, build, contents, leaderboard

from harness.cli import main as harness_main

pytest.importorskip("harness.submission", reason="this harness cannot submit")


@pytest.fixture
def submissions(contest, tmp_path):
    folder = tmp_path / "submissions"
    folder.mkdir()
    for name in ("alpha", "beta", "gamma"):
        command = ["submit", contest / name, "-o", folder / f"{name}.tar.gz", "--author", "A. B."]
        options = ["--contact", "a@b.example", "--benchmarks", ROOT]
        result = CliRunner().invoke(harness_main, [str(x) for x in (*command, *options)])
        assert result.exit_code == 0, result.output
    return folder


def test_submissions_give_the_same_site_but_for_the_logs(submissions, contest, tmp_path):
    build(contest, "-o", tmp_path / "runs")
    build(submissions, "-o", tmp_path / "submitted")
    runs, submitted = (contents(tmp_path / name) for name in ("runs", "submitted"))
    assert runs.keys() == submitted.keys()
    differing = {name for name in runs if runs[name][0] != submitted[name][0]}
    assert all(name.startswith("instances/") and name.endswith(".html") for name in differing)
    assert json.loads(submitted["data/scores.json"][0])["rows"]
    assert b"0.28" in submitted[f"instances/{CLOSE}.html"][0]


def test_a_submission_that_was_touched_is_refused(submissions, tmp_path):
    path = submissions / "alpha.tar.gz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
    done = leaderboard("build", submissions, "-o", tmp_path / "site", "--benchmarks", ROOT)
    assert done.returncode == 2
    assert "alpha.tar.gz" in done.stderr
    assert not (tmp_path / "site").exists()
