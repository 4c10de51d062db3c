"""Polygons of the reach tube enclose what the certificate's rows enclose."""

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from site_helpers import ROOT, STRAIGHT

from leaderboard.traces import drive
from leaderboard.tube import MOST, _few, hull, read_tube, rectangles
from racecar.controller import RuntimeSteer
from racecar.errors import BadInput
from racecar.instance import controller_path, load_instance

SPEC = ROOT / f"quick/json/{STRAIGHT}.json"


def inside(polygon, point):
    """Whether a point lies in a convex polygon, whichever way round its corners are."""
    following = np.roll(polygon, -1, axis=0)
    edge, to = following - polygon, point - polygon
    cross = edge[:, 0] * to[:, 1] - edge[:, 1] * to[:, 0]
    return (cross >= -1e-12).all() or (cross <= 1e-12).all()


def numbers(shape, size):
    values = st.floats(-size, size, width=32)
    return arrays(np.float64, shape, elements=values)


@settings(max_examples=60)
@given(
    centre=numbers((2, 6), 3.0),
    spread=numbers((2, 3, 2), 0.5),
    radius=numbers(2, 0.125).map(np.abs),
    x=st.floats(-1, 1),
    e=numbers(3, 1.0),
    rest=numbers(2, 1.0),
)
def test_a_rectangle_encloses_every_member_of_a_row(centre, spread, radius, x, e, rest):
    (corners,) = rectangles(centre[None], spread[None], radius[None])
    powers = x ** np.arange(6)
    member = centre @ powers + (spread[..., 0] + spread[..., 1] * x) @ e + radius * rest
    assert inside(corners, member)


@settings(max_examples=30)
@given(points=st.lists(st.tuples(st.floats(-5, 5), st.floats(-5, 5)), min_size=3, max_size=40))
def test_a_hull_encloses_its_points_and_turns_one_way(points):
    corners = hull(np.array(points))
    if len(corners) < 3:
        return  # all on one line
    following = np.roll(corners, -1, axis=0)
    edges = following - corners
    for point in points:
        to = np.array(point) - corners
        assert (edges[:, 0] * to[:, 1] - edges[:, 1] * to[:, 0] >= -1e-9).all()


def test_many_rows_become_few_polygons_that_cover_them():
    random = np.random.default_rng(0)
    middles = np.column_stack([np.linspace(0, 1, 200), random.normal(0, 0.01, 200)])
    size = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * 0.01
    corners = middles[:, None] + size
    few = _few(corners)
    assert len(few) == MOST
    for rectangle in corners:
        assert any(all(inside(polygon, corner) for corner in rectangle) for polygon in few)


@pytest.fixture
def certificate(certificates, tmp_path):
    return shutil.copy(certificates / f"{STRAIGHT}.h5", tmp_path)


def arguments():
    data = json.loads(SPEC.read_bytes())
    return data, data["controller"]["sha256"], load_instance(SPEC).make_plant().track


def test_simulated_runs_lie_in_the_tube(certificate):
    instance = load_instance(SPEC)
    starts = np.tile([0.0, 9.9, 0.0, 0.0], (21, 1))
    starts[:, 0] = np.linspace(*instance.initial_set.s, 21)
    traces = drive(
        instance.make_plant(),
        RuntimeSteer(controller_path(instance, SPEC)),
        instance.make_property(),
        starts,
        instance.steps,
    )
    tube = read_tube(certificate, *arguments())
    assert len(tube.steps) == instance.steps + 1
    for trace in traces:
        for polygons, x, y in zip(tube.steps, trace.x, trace.y, strict=True):
            assert any(inside(polygon, np.array([x, y])) for polygon in polygons)
        assert trace.margin.min() > tube.margin
    # And it is no wider than it has to be, but for a slack of 0.1 mm and the errors' bounds.
    ys = np.array([trace.y for trace in traces])
    for polygons, simulated in zip(tube.steps, np.ptp(ys, axis=0), strict=True):
        assert simulated < np.ptp(np.vstack(polygons)[:, 1]) < simulated + 0.001


def test_a_certificate_of_another_instance_is_refused(certificate):
    data, onnx, track = arguments()
    with pytest.raises(BadInput, match="another instance"):
        read_tube(certificate, data | {"steps": 6}, onnx, track)
    with pytest.raises(BadInput, match="another controller"):
        read_tube(certificate, data, "0" * 64, track)


@pytest.mark.parametrize("harm", ["text", "format", "radius"])
def test_a_broken_certificate_is_refused(certificate, harm):
    if harm == "text":
        Path(certificate).write_text("no HDF5")
    else:
        with h5py.File(certificate, "r+") as file:
            if harm == "format":
                file.attrs["format"] = "something"
            else:
                del file["rows/radius"]
    with pytest.raises(BadInput, match="certificate"):
        read_tube(certificate, *arguments())
