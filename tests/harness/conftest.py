"""Fixtures: a small benchmarks folder, tools made of shell scripts, and no process left."""

import stat
import uuid

import pytest
from harness_helpers import Benchmarks, carriers

from harness.catalogue import select
from harness.runner import Runner
from harness.tool import find_tool


@pytest.fixture
def benchmarks(tmp_path):
    return Benchmarks(tmp_path / "set")


@pytest.fixture
def marker(monkeypatch):
    """A word in the environment of all that a test starts; in the end nothing may carry it."""
    word = uuid.uuid4().hex
    monkeypatch.setenv("HARNESS_TEST_MARKER", word)
    yield word
    assert carriers(word) == []


@pytest.fixture
def make_tool(tmp_path):
    """Return a function that makes a tool folder from the bodies of its scripts.

    In them $RESULTS is the result file, $ID the instance's ID, $LIMIT the timeout.
    """

    def make(run, prepare="", install=None, name="fake"):
        folder = tmp_path / "tools" / name
        folder.mkdir(parents=True)
        head = '#!/bin/bash\nID=$(basename "${4:-}" .json)\n'
        (folder / "run_instance.sh").write_text(f'{head}RESULTS="$5" LIMIT="$6"\n{run}\n')
        (folder / "prepare_instance.sh").write_text(f"{head}{prepare}\n")
        if install is not None:
            (folder / "install_tool.sh").write_text(f"#!/bin/bash\n{install}\n")
        for script in folder.iterdir():
            assert not script.stat().st_mode & stat.S_IXUSR  # bash runs them all the same
        return folder

    return make


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """The folder in which scratch folders are made; in the end it must be empty."""
    folder = tmp_path / "t"
    folder.mkdir()
    monkeypatch.setenv("TMPDIR", str(folder))
    monkeypatch.setattr("tempfile.tempdir", str(folder))
    yield folder
    assert list(folder.iterdir()) == []


@pytest.fixture
def make_runner(benchmarks, make_tool, temporary, marker):
    """Return a function that makes a Runner and an entry for one script."""
    runners = []

    def make(run, timeout=30.0, prepare="", **options):
        benchmarks.add("one", (0.25, 0.5), timeout=timeout)
        tool = find_tool(str(make_tool(run, prepare)))
        runners.append(Runner(tool, benchmarks.root, **options))
        return runners[-1], select(benchmarks.root, (), ("one",))[0]

    yield make
    for runner in runners:
        runner.close()
