"""Environments of tools: where they are kept, made once, never taken for complete when not."""

import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from harness import environments
from harness.environments import (
    cache_folder,
    ensure_environment,
    environment_folder,
    is_installed,
)
from racecar.errors import BadInput


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("CLOSEDLAP_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def test_cache_follows_the_variables(monkeypatch, cache):
    assert cache_folder() == cache
    monkeypatch.delenv("CLOSEDLAP_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", "/var/here")
    assert cache_folder() == Path("/var/here/closedlap")
    monkeypatch.setenv("XDG_CACHE_HOME", "not/absolute")
    monkeypatch.setenv("HOME", "/home/me")
    assert cache_folder() == Path("/home/me/.cache/closedlap")


def test_other_packages_get_another_folder():
    one, two = environment_folder("a", [["p==1"]]), environment_folder("a", [["p==2"]])
    assert one != two
    assert one == environment_folder("a", [["p==1"]])
    assert one.name.startswith("a-")


def test_it_is_made_once_whoever_asks(monkeypatch):
    # A real one is made where a shipped tool is tried (test_shipped_verifiers.py).
    calls = []

    def call(command, timeout_s):
        calls.append(command[1:])
        time.sleep(0.02)
        if "venv" in command:
            Path(command[-1]).mkdir()

    monkeypatch.setattr(environments, "_call", call)
    installs = [["torch==2"], ["torch==2", "tool==1"]]
    with ThreadPoolExecutor(4) as threads:
        folders = set(threads.map(lambda _: ensure_environment("a", installs, 60), range(4)))
    (folder,) = folders
    assert is_installed(folder)
    pip = ["-m", "pip", "install", "--no-input"]
    assert calls == [
        ["-m", "venv", str(folder)],
        [*pip, "torch==2"],
        [*pip, "torch==2", "tool==1"],
    ]


def test_what_a_killed_one_left_is_made_anew(monkeypatch):
    folder = environment_folder("a", [["p==1"]])
    (folder / "bin").mkdir(parents=True)
    monkeypatch.setattr(
        environments, "_call", lambda command, timeout_s: folder.mkdir(exist_ok=True)
    )
    assert ensure_environment("a", [["p==1"]], 60) == folder
    assert not (folder / "bin").exists()


def test_a_failure_leaves_nothing_that_counts(monkeypatch):
    installs = [["there-is-no-such-package"]]
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(BadInput, match="ended with status 1"):
        ensure_environment("a", installs, 60)
    assert not is_installed(environment_folder("a", installs))


def test_it_gives_up_after_its_time(monkeypatch):
    monkeypatch.setattr(sys, "executable", "/bin/false")
    with pytest.raises(BadInput, match=r"took longer than 0\.05 s"):
        environments._call(["sleep", "5"], 0.05)
