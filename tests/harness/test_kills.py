"""A small version of bench.kills: runs that are killed at random come to their end, whole."""

import os

import pytest

from bench.kills import storm


def test_a_run_survives_kills_of_the_harness():
    jobs = min(2, len(os.sched_getaffinity(0)))
    tally = storm(dask=False, kills=4, count=51, jobs=jobs, every=6, seed=1)
    assert tally.total == 4
    assert tally.instances <= tally.starts <= tally.instances + 2 * jobs * tally.total


def test_a_run_on_a_cluster_survives_kills():
    pytest.importorskip("distributed")
    tally = storm(dask=True, kills=4, count=30, jobs=1, every=5, seed=2)
    assert tally.total == 4
    assert set(tally.kills) >= {"harness", "worker"}
