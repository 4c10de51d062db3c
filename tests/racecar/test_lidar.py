"""The LiDAR, against rays cast on the plane and against the paper's formulas."""

from __future__ import annotations

import math

import numpy as np
import pytest
from global_geometry import TRACKS, cast, lay_out, outline
from hypothesis import given, settings
from hypothesis import strategies as st

from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.polygon import Polygon
from racecar.track import square_track

RANGE = 5.0
#: 1e-12 of the range.
AGREED = 1e-12 * RANGE
LIDARS = st.sampled_from(
    [Lidar(21), Lidar(61, math.radians(270)), Lidar(7, 2 * math.pi), Lidar(1081, math.radians(270))]
)


@settings(max_examples=60)
@given(TRACKS, LIDARS, st.integers(0, 2**32 - 1), st.sampled_from([1, 5, 100]))
def test_scans_agree_with_rays_cast_on_the_plane(track, lidar, seed, batch):
    """Cars anywhere in a hall, 5 cm or more from the walls, headed anywhere."""
    random = np.random.default_rng(seed)
    places = lay_out(track)
    segments = outline(places)
    index = int(random.integers(len(places)))
    place = places[index]
    # Spread out, or close together as the cars of a batch usually are.
    spread = random.choice([1e-3, 0.1, 1.0])
    s = place.width * (0.5 + spread * random.uniform(-0.5, 0.5, batch))
    f = place.length * np.clip(random.random() + spread * random.uniform(-0.5, 0.5, batch), 0, 1)
    s, f = np.clip(s, 0.05, place.width - 0.05), np.clip(f, 0.05, place.length - 0.05)
    theta = random.uniform(-math.pi, math.pi) + spread * random.uniform(-3, 3, batch)
    scan = lidar.scan(track.frames[index].obstacles, s, f, theta)
    for i in range(min(batch, 5)):
        angles = place.angle + theta[i] + lidar.angles
        expected, from_corner = cast(segments, *place.point(s[i], f[i]), angles, RANGE)
        clear = from_corner > 1e-9  # elsewhere the distance may jump
        assert np.abs(scan[i] - expected)[clear].max(initial=0.0) < AGREED


def convex(random: np.random.Generator) -> tuple[Polygon, np.ndarray]:
    """Return a convex polygon with 3 to 5 sides, and its sides as segments."""
    sides = random.integers(3, 6)
    corner = np.sort(random.uniform(0, 2 * math.pi, sides))
    centre, radius = random.uniform(-4, 4, 2), 10 ** random.uniform(-1, 0.5)
    corners = centre + radius * np.stack([np.cos(corner), np.sin(corner)], axis=1)
    along = np.roll(corners, -1, axis=0) - corners
    outward = np.stack([along[:, 1], -along[:, 0]], axis=1)
    offsets = np.sum(outward * corners, axis=1)
    return Polygon(outward, offsets), np.stack([corners, np.roll(corners, -1, axis=0)], axis=1)


@settings(max_examples=100)
@given(LIDARS, st.integers(0, 2**32 - 1), st.sampled_from([1, 100]))
def test_scans_of_scattered_polygons_agree_with_rays_cast_at_their_sides(lidar, seed, batch):
    """Walls of any shape and slant, seen from all around, near, far and edge on."""
    random = np.random.default_rng(seed)
    made = [convex(random) for _ in range(random.integers(1, 6))]
    segments = np.concatenate([sides for _, sides in made])
    spread = random.choice([1e-3, 0.1, 3.0])
    s, f = random.uniform(-4, 4, (2, 1)) + spread * random.uniform(-1, 1, (2, batch))
    theta = random.uniform(-math.pi, math.pi) + spread * random.uniform(-1, 1, batch)
    scan = lidar.scan([polygon for polygon, _ in made], s, f, theta)
    for i in range(min(batch, 5)):
        away = min(float(polygon.separation(s[i], f[i]).max()) for polygon, _ in made)
        if away <= 0:
            assert not scan[i].any()
            continue
        # A step along the ray is (-sin, -cos) in (s, f): as an angle, 270 degrees less psi.
        angles = 1.5 * math.pi - theta[i] - lidar.angles
        expected, from_corner = cast(segments, s[i], f[i], angles, RANGE)
        # A ray that nearly follows a side ends where rounding says.
        sides = segments[:, 1] - segments[:, 0]
        slant = np.abs(np.sin(angles[:, None] - np.arctan2(sides[:, 1], sides[:, 0])))
        clear = (from_corner > 1e-9) & (slant > 1e-3).all(axis=1)
        assert np.abs(scan[i] - expected)[clear].max(initial=0.0) < AGREED


@settings(max_examples=60)
@given(TRACKS, LIDARS, st.integers(0, 2**32 - 1))
def test_a_place_has_the_same_scan_in_the_frames_of_two_halls(track, lidar, seed):
    random = np.random.default_rng(seed)
    for index, frame in enumerate(track.frames):
        change = frame.advance
        if change is None:
            continue
        # In the next hall, from the corner on.
        width, length = track.width, track.halls[change.to].length
        s2 = random.uniform(0.05, width - 0.05, 20)
        f2 = random.uniform(0.05, length - 0.05, 20)
        theta2 = random.uniform(-math.pi, math.pi, 20)
        inverse = np.linalg.inv(np.array(change.matrix))
        s, f = inverse @ (np.stack([s2, f2]) - np.array(change.offset)[:, None])
        ours = lidar.scan(frame.obstacles, s, f, theta2 - change.rotation)
        theirs = lidar.scan(track.frames[change.to].obstacles, s2, f2, theta2)
        place = lay_out(track)[index]
        segments = outline(lay_out(track))
        for i in range(3):
            angles = place.angle + theta2[i] - change.rotation + lidar.angles
            _, from_corner = cast(segments, *place.point(s[i], f[i]), angles, RANGE)
            clear = from_corner > 1e-9
            assert np.abs(ours[i] - theirs[i])[clear].max(initial=0.0) < AGREED


def papers_formulas(s: float, f: float, psi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return distances by the paper's case distinction (HSCC 2020, section 3.2), and jumps.

    The paper states Region 2, the corner square, with angles in degrees: right wall up to
    theta_r, bottom wall up to -90, top (front) wall up to theta_l, then the left wall; the
    other regions are its special cases. psi: ray angles in the hall. The second answer is
    how far each ray is from an angle at which the distance jumps.
    """
    width, degrees = 1.5, np.degrees(psi)
    degrees = (degrees + 180) % 360 - 180
    right, bottom, top, left = width - s, width - f, f, s
    theta_l = math.degrees(math.atan2(left, top))

    def cos(x: np.ndarray) -> np.ndarray:
        return np.cos(np.radians(x))

    with np.errstate(divide="ignore"):
        to_right, to_bottom = right / cos(90 + degrees), bottom / cos(180 + degrees)
        to_top, to_left = top / cos(degrees), left / cos(90 - degrees)
    if s <= width and f > width:  # Region 1: the hall before the turn
        theta_r = -math.degrees(math.atan2(right, f - width))
        cases = [degrees <= theta_r, degrees <= theta_l]
        distance = np.select(cases, [to_right, to_top], to_left)
        jump = theta_r
    elif s <= width:  # Region 2: the corner square
        theta_r = -90 - math.degrees(math.atan2(bottom, right))
        cases = [degrees <= theta_r, degrees <= -90, degrees <= theta_l]
        distance = np.select(cases, [to_right, to_bottom, to_top], to_left)
        jump = theta_r
    else:  # Region 3: the hall after the turn; the right wall is out of sight
        theta_c = 90 + math.degrees(math.atan2(bottom, s - width))
        cases = [degrees <= -90, degrees <= theta_l, degrees <= theta_c]
        distance = np.select(cases, [to_bottom, to_top, to_left], to_bottom)
        jump = theta_c
    return np.minimum(distance, RANGE), np.abs(degrees - jump)


REGIONS = {
    "Region 1": (st.floats(0.05, 1.45), st.floats(1.51, 13.4)),
    "Region 2": (st.floats(0.05, 1.45), st.floats(0.05, 1.45)),
    "Region 3": (st.floats(1.55, 13.4), st.floats(0.05, 1.45)),
}


@pytest.mark.parametrize("region", REGIONS)
@given(data=st.data(), theta=st.floats(-math.pi, math.pi), lidar=LIDARS)
@settings(max_examples=60)
def test_scans_agree_with_the_papers_formulas(region, data, theta, lidar):
    s, f = (data.draw(x) for x in REGIONS[region])
    expected, from_jump = papers_formulas(s, f, theta + lidar.angles)
    scan = lidar.scan(square_track().frames[0].obstacles, s, f, theta)[0]
    clear = from_jump > 1e-7
    assert np.abs(scan - expected)[clear].max(initial=0.0) < AGREED


def test_known_distances():
    lidar = Lidar(5, math.pi)  # -90, -45, 0, 45, 90 degrees
    scan = lidar.scan(square_track().frames[0].obstacles, 0.5, 3.0, 0.0)[0]
    assert scan == pytest.approx([1.0, math.sqrt(2), 3.0, math.sqrt(0.5), 0.5], abs=1e-15)


def test_rays_are_equally_spaced_from_right_to_left():
    angles = np.degrees(Lidar().angles)
    assert angles == pytest.approx(np.arange(-115, 116, 11.5))
    assert np.degrees(Lidar(1081, math.radians(270)).angles[:2]) == pytest.approx([-135, -134.75])


@pytest.mark.parametrize("batch", [1, 3, 5000])
def test_a_scan_does_not_depend_on_the_batch(batch):
    """Cars in all three regions, on walls and inside them: all cases of the same batch."""
    random = np.random.default_rng(3)
    s, f = random.uniform(-0.5, 8, batch), random.uniform(-0.5, 8, batch)
    s[: batch // 3] = random.choice([0.0, 1.5, 0.75], batch // 3)
    theta = random.uniform(-4, 4, batch)
    obstacles, lidar = square_track().frames[0].obstacles, Lidar()
    together = lidar.scan(obstacles, s, f, theta)
    for i in range(0, batch, max(1, batch // 200)):
        alone = lidar.scan(obstacles, s[i], f[i], theta[i])[0]
        assert np.abs(together[i] - alone).max() < AGREED


@pytest.mark.parametrize(
    ("s", "f"), [(0.0, 5.0), (-0.1, 5.0), (1.5, 5.0), (1.6, 5.0), (0.7, 0.0), (1.5, 1.5), (-9, 9)]
)
@pytest.mark.parametrize("others", [0, 100])
def test_a_car_on_or_in_a_wall_reads_nothing(s, f, others):
    s = np.append(np.full(others, 0.75), s)
    f = np.append(np.full(others, 9.9), f)
    scan = Lidar().scan(square_track().frames[0].obstacles, s, f, np.zeros(others + 1))
    assert not scan[-1].any()
    assert (scan[:-1] > 0).all()


@pytest.mark.parametrize("gap", [5e-324, 1e-310, 1e-200, 1e-30, 1e-17, 1e-12])
def test_a_car_as_good_as_on_a_wall_is_measured_without_overflow(gap):
    scan = Lidar(5, math.pi).scan(square_track().frames[0].obstacles, gap, 5.0, 0.0)[0]
    assert np.isfinite(scan).all()
    assert scan[4] == pytest.approx(gap, rel=1e-12, abs=1e-199)


def test_in_line_with_the_inner_face_a_ray_along_it_sees_past_the_corner():
    # f = W exactly: the face {f = W, s > W} is seen edge on.
    scan = Lidar(5, math.pi).scan(square_track().frames[0].obstacles, 0.5, 1.5, 0.1)[0]
    expected, _ = papers_formulas(0.5, 1.5, 0.1 + Lidar(5, math.pi).angles)
    assert scan == pytest.approx(expected, abs=AGREED)


def test_walls_may_lean():
    """A wall at 45 degrees, {s + f <= 0}: the distance straight at it and along it."""
    wall = Polygon.from_constraints([[math.sqrt(0.5), math.sqrt(0.5), 0.0]])
    scan = Lidar(3, math.pi).scan([wall], 1.0, 1.0, math.pi / 4)[0]
    assert scan == pytest.approx([5.0, math.sqrt(2), 5.0], abs=1e-14)
    assert Lidar(2, math.pi).scan([wall], 1.0, -1.0, 0.0).max() == 0


def test_one_broken_state_spoils_no_other():
    s, f, theta = np.array([0.7, math.nan, 0.8]), np.array([5.0, 5.0, 4.0]), np.zeros(3)
    obstacles, lidar = square_track().frames[0].obstacles, Lidar()
    scan = lidar.scan(obstacles, s, f, theta)
    assert np.isnan(scan[1]).any()
    good = lidar.scan(obstacles, s[[0, 2]], f[[0, 2]], theta[[0, 2]])
    assert np.abs(scan[[0, 2]] - good).max() < AGREED


def test_no_cars_give_no_readings():
    empty = np.empty(0)
    obstacles = square_track().frames[0].obstacles
    assert Lidar().scan(obstacles, empty, empty, empty).shape == (0, 21)


@pytest.mark.parametrize(
    "wrong",
    [
        {"rays": 1},
        {"field_of_view": 0.0},
        {"field_of_view": 6.3},
        {"field_of_view": math.nan},
        {"range": 0.0},
        {"range": math.inf},
    ],
)
def test_wrong_parameters_are_refused(wrong):
    with pytest.raises(BadInput, match="lidar"):
        Lidar(**wrong)
