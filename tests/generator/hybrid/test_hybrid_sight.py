"""Zones and faces: together they say what every ray meets first, as the simulator's LiDAR does."""

import math

import numpy as np
import pytest

from generator.hybrid.sight import alike, check_walls_unsafe, zones
from racecar.errors import BadInput
from racecar.instance import FrameData, frames_data
from racecar.lidar import Lidar
from racecar.safety import named_property
from racecar.track import square_track, track_from_turns

TRACKS = {
    "square": square_track(),
    "narrow": square_track(length=9.0, width=1.0),
    "short": square_track(length=6.0),
    "left": track_from_turns(["left"] * 4, closed=True),
    "winding": track_from_turns(["left", "right", "right"]),
}


def holds(value, relation, bound):
    return {"<=": value <= bound, "<": value < bound, ">": value > bound, ">=": value >= bound}[
        relation
    ]


def zone_of(found, s, f):
    inside = [z for z in found if all(holds(a * s + b * f, r, c) for a, b, r, c in z.where)]
    assert len(inside) == 1, (s, f)
    return inside[0]


def reading(zone, s, f, course, reach):
    """Return the distance found face by face, written from the module's first lines."""
    toward = math.sin(course), math.cos(course)

    def gap(row):
        return row[0] * s + row[1] * f - row[2]

    def approach(row):
        return row[0] * toward[0] + row[1] * toward[1]

    n, z = reach, 1.0
    for face in zone.faces:
        g, h = gap(face.face), approach(face.face)
        if not face.outside and g <= 0:
            continue
        if any(gap(m) * h - approach(m) * g > 0 for m in face.others):
            continue
        if g * z - n * h <= 0:
            n, z = g, h
    return n / z


def bounding_box(frame):
    """Return the corners of a track, from its walls that are half-planes."""
    low, high = [-math.inf] * 2, [math.inf] * 2
    for wall in frame.obstacles:
        if len(wall) == 1:
            axis = 0 if wall[0][0] else 1
            if wall[0][axis] > 0:
                low[axis] = wall[0][2]
            else:
                high[axis] = -wall[0][2]
    return low, high


@pytest.mark.parametrize("name", TRACKS)
@pytest.mark.parametrize("reach", [5.0, 12.0])
def test_every_place_is_in_one_zone_and_its_faces_give_the_reading(name, reach):
    track = TRACKS[name]
    random = np.random.default_rng(5)
    lidar = Lidar(rays=7, range=reach)
    for frame, data in zip(track.frames, frames_data(track), strict=True):
        found = zones(data, reach)
        low, high = bounding_box(data)
        poses = random.uniform([*low, -4], [*high, 4], size=(1500, 3))
        # Near the zones' and walls' own lines as well.
        poses[:500, :2] = np.round(poses[:500, :2] * 2) / 2 + random.normal(
            scale=0.01, size=(500, 2)
        )
        clear = np.all([p.separation(*poses[:, :2].T) > 0 for p in frame.obstacles], axis=0)
        poses = poses[clear]
        assert len(poses) > 20
        scans = lidar.scan(frame.obstacles, *poses.T)
        for (s, f, theta), scan in zip(poses, scans, strict=True):
            zone = zone_of(found, s, f)
            mine = [reading(zone, s, f, theta + angle, reach) for angle in lidar.angles]
            assert mine == pytest.approx(scan.tolist(), abs=1e-9)


def test_few_faces_are_looked_at_where_little_is_in_reach():
    frame = frames_data(square_track())[0]
    found = zones(frame, 5.0)
    # Far from both corners a ray meets the two side walls or nothing.
    assert len(zone_of(found, 0.75, 9.9).faces) == 2
    # In the corner also the front wall and the second face of the inner block.
    assert len(zone_of(found, 0.75, 2.0).faces) == 4


def test_a_track_that_is_not_closed_in_is_refused():
    frame = frames_data(square_track())[0]
    open_ = FrameData(obstacles=frame.obstacles[:2], advance=frame.advance)
    with pytest.raises(BadInput, match="do not close the track in"):
        zones(open_, 5.0)


def test_frames_are_alike_if_all_that_follows_is():
    square = frames_data(square_track())
    assert alike(square, [[]] * 4) == [0, 0, 0, 0]
    # One other unsafe set ahead makes all four differ: they are 0 to 3 halls away from it.
    assert len(set(alike(square, [[], [], [], [1]]))) == 4
    assert alike(square, [[], [1], [], [1]]) == [0, 1, 0, 1]


@pytest.mark.parametrize("name", TRACKS)
@pytest.mark.parametrize("safety", ["clearance", "hscc20"])
def test_the_named_properties_include_the_walls(name, safety):
    track = TRACKS[name]
    unsafe = [[p.to_constraints() for p in f] for f in named_property(safety, track).unsafe]
    check_walls_unsafe(frames_data(track), unsafe)


def test_a_property_without_a_wall_is_refused():
    track = square_track()
    unsafe = [[p.to_constraints() for p in f] for f in named_property("clearance", track).unsafe]
    for wrong in (unsafe[0][1:], [[[1.0, 0.0, -0.1]], *unsafe[0][1:]]):
        with pytest.raises(BadInput, match="frame 0 has a wall"):
            check_walls_unsafe(frames_data(track), [wrong, *unsafe[1:]])
