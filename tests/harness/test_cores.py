"""How cores are shared out among jobs."""

import os

import pytest
from hypothesis import given
from hypothesis import strategies as st

from harness.cores import share_out, usable_cores
from racecar.errors import BadInput

PAIRS = [(0, 4), (1, 5), (2, 6), (3, 7)]  # four physical cores with two threads each


def machine(sizes):
    """Return physical cores of so many logical cores each, numbered as they come."""
    starts = [sum(sizes[:i]) for i in range(len(sizes))]
    return [tuple(range(start, start + size)) for start, size in zip(starts, sizes, strict=True)]


machines = st.lists(st.integers(1, 3), min_size=1, max_size=8).map(machine)


@given(machines, st.integers(1, 9), st.none() | st.integers(1, 4))
def test_jobs_share_no_core_and_get_equally_many(physical, jobs, per_job):
    cores = {core for group in physical for core in group}
    if jobs * (per_job or 1) > len(cores):
        with pytest.raises(BadInput, match=f"only {len(cores)} cores"):
            share_out(jobs, per_job, physical)
        return
    places = share_out(jobs, per_job, physical)
    assert len(places) == jobs
    taken = [core for place in places for core in place]
    assert len(taken) == len(set(taken))
    assert set(taken) <= cores
    (each,) = {len(place) for place in places}
    assert each == (per_job or each) >= 1


@pytest.mark.parametrize(
    ("jobs", "per_job", "places"),
    [
        (1, None, [(0, 1, 2, 3, 4, 5, 6, 7)]),
        (2, None, [(0, 1, 4, 5), (2, 3, 6, 7)]),
        (3, None, [(0, 4), (1, 5), (2, 6)]),  # the fourth is left to the harness
        (4, 1, [(0,), (1,), (2,), (3,)]),  # no two on one physical core
        (2, 2, [(0, 1), (2, 3)]),  # of two physical cores rather than of one
        (8, None, [(0,), (4,), (1,), (5,), (2,), (6,), (3,), (7,)]),
    ],
)
def test_physical_cores_are_kept_apart(jobs, per_job, places):
    assert share_out(jobs, per_job, PAIRS) == places


def test_refusal_says_what_was_asked():
    with pytest.raises(BadInput, match="3 jobs at a time with 4 cores each: only 8 cores"):
        share_out(3, 4, PAIRS)


def test_usable_cores_are_those_of_this_process():
    assert sorted(core for group in usable_cores() for core in group) == sorted(
        os.sched_getaffinity(0)
    )
