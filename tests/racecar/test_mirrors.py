"""Mirroring walls: which stretches are walls, which rays they take, and what is read then."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest
from global_geometry import TRACKS, Place, cast, lay_out, outline
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State, simulate
from racecar.disturbance import Mirrors
from racecar.faultmodels.draw import spec_faults
from racecar.faultmodels.spec import Segment, parse_faults
from racecar.faults import GivenFaults
from racecar.lidar import Lidar
from racecar.mirrors import complaint_about, mirroring
from racecar.safety import named_property
from racecar.track import square_track

RAYS = 21
PLANT = Plant(square_track(), Bicycle(), Lidar())


def local(place: Place, point: np.ndarray) -> tuple[float, float]:
    """Return s and f of a global point in the frame of a hall."""
    away = np.array(place.corner) - point
    return float(away @ place.left), float(away @ place.ahead)


# --- Where a stretch may be --------------------------------------------------------------


@settings(max_examples=60)
@given(track=TRACKS, data=st.data())
def test_every_stretch_of_every_wall_is_accepted_in_every_frame(track, data):
    """The walls are those of a second geometry: sides of halls that border no other."""
    places = lay_out(track)
    walls = outline(places)
    hall = data.draw(st.integers(0, len(places) - 1))
    begin, end = walls[data.draw(st.integers(0, len(walls) - 1))]
    a, b = sorted(data.draw(st.lists(st.floats(0, 1), min_size=2, max_size=2)))
    assume((b - a) * math.dist(begin, end) > 1e-6)
    ends = [local(places[hall], begin + x * (end - begin)) for x in (a, b)]
    assert complaint_about(Segment(hall=hall, begin=ends[0], end=ends[1]), track) is None
    # Longer than the wall, or beside it: no stretch of it.
    unit = (end - begin) / math.dist(begin, end)
    free = np.array([-unit[1], unit[0]])
    for by in (1e-6 * free, -1e-6 * free):
        beside = [local(places[hall], begin + x * (end - begin) + by) for x in (a, b)]
        assert complaint_about(Segment(hall=hall, begin=beside[0], end=beside[1]), track)


# --- Which rays are taken ----------------------------------------------------------------

#: Stretches on the walls that a car near the first corner may see, in the frame of hall 0: on the
#: left and the front wall, and on both sides of the inner block.
STRETCHES = (
    Segment(hall=0, begin=(0.0, 0.0), end=(0.0, 1.0)),
    Segment(hall=0, begin=(0.0, 3.5), end=(0.0, 2.5)),
    Segment(hall=0, begin=(0.5, 0.0), end=(1.5, 0.0)),
    Segment(hall=0, begin=(0.0, 0.0), end=(4.0, 0.0)),
    Segment(hall=0, begin=(1.5, 1.5), end=(1.5, 4.0)),
    Segment(hall=0, begin=(3.0, 1.5), end=(1.5, 1.5)),
    # The front wall, as the next hall sees it: its left wall.
    Segment(hall=1, begin=(0.0, 20.0), end=(0.0, 18.0)),
)
#: The same in the plane: x = -f, y = -s; and the direction of the wall's normal.
PLANE = {
    0: ((0.0, 0.0), (-1.0, 0.0)),
    1: ((-3.5, 0.0), (-2.5, 0.0)),
    2: ((0.0, -0.5), (0.0, -1.5)),
    3: ((0.0, 0.0), (0.0, -4.0)),
    4: ((-1.5, -1.5), (-4.0, -1.5)),
    5: ((-1.5, -3.0), (-1.5, -1.5)),
    6: ((0.0, 0.0), (0.0, -2.0)),
}


def taken(chosen: int, incidence: float, x: float, y: float, angle: float) -> bool | None:
    """Say by plain geometry whether one ray is taken; None where it is too close to call."""
    walls = outline(lay_out(PLANT.track))
    (distance,), _ = cast(walls, x, y, np.array([angle]), 5.0)
    if distance >= 5:
        return False
    hit = x + distance * math.cos(angle), y + distance * math.sin(angle)
    (ax, ay), (bx, by) = PLANE[chosen]
    # The nearest point of the stretch, and how far the stretch's ends are.
    near = (
        min(max(hit[0], min(ax, bx)), max(ax, bx)),
        min(max(hit[1], min(ay, by)), max(ay, by)),
    )
    on = math.dist(hit, near)
    if 1e-10 < on < 1e-6 or min(math.dist(hit, e) for e in ((ax, ay), (bx, by))) < 1e-6:
        return None
    normal = math.pi / 2 if ay == by else 0.0
    off = abs((angle - normal + math.pi / 2) % math.pi - math.pi / 2)
    if abs(off - incidence) < 1e-9:
        return None
    return on <= 1e-10 and off > incidence


@given(
    seed=st.integers(0, 2**32 - 1),
    incidence=st.sampled_from([0.0, 30.0, 45.0, 60.0, 80.0]).map(math.radians),
    noisy=st.booleans(),
    lossy=st.booleans(),
)
def test_given_mirrors_take_the_rays_that_plain_geometry_says(seed, incidence, noisy, lossy):
    random = np.random.default_rng(seed)
    runs = 6
    s, f = random.uniform(0.2, 1.3, runs), random.uniform(0.2, 5.0, runs)
    theta = random.uniform(-math.pi, math.pi, runs)
    state = State.start(s, f, 2.0, theta)
    chosen = random.integers(-1, len(STRETCHES), runs)
    mirrors = mirroring(Mirrors(segments=STRETCHES, incidence=incidence), PLANT, chosen)
    scan = PLANT.scan_rows(state)
    noise = random.uniform(-1, 1, (1, RAYS, runs)) if noisy else None
    gone = random.random((RAYS, runs)) < 0.1 if lossy else None
    faults = GivenFaults(1.5, 5.0, gone, False, noise, mirrors)
    found = faults(0, state, scan)
    for run in range(runs):
        for ray, offset in enumerate(PLANT.lidar.angles):
            lost = False
            if chosen[run] >= 0:
                lost = taken(chosen[run], incidence, -f[run], -s[run], theta[run] + offset)
            if gone is not None and gone[ray, run]:
                lost = True
            if lost is None:
                continue
            # What the mirror does is judged by the true distance, and comes after the noise.
            shift = noise[0, ray, run] if noise is not None else 0.0
            expected = 5.0 if lost else max(0.0, min(5.0, scan[ray, run] + shift))
            assert found[ray, run] == expected
            assert faults.missing(0, state, scan)[ray, run] == lost


def test_mirrors_take_rays_outside_the_turn_too():
    """Missing rays may be kept to the turn; a wall is where it is."""
    segment = Segment(hall=0, begin=(0.0, 10.0), end=(0.0, 8.0))
    mirrors = mirroring(Mirrors(segments=(segment,), incidence=0.5), PLANT, 0)
    state = State.start(np.array([0.75]), 10.5)
    scan = PLANT.scan_rows(state)
    found = GivenFaults(1.5, 5.0, np.ones((RAYS, 1), dtype=bool), True, None, mirrors)
    assert 0 < (found(0, state, scan) != scan).sum() < RAYS / 2


def test_a_stretch_of_a_run_is_the_reflective_fault_of_that_stretch():
    """Whole runs: given mirrors and the random fault model with a fixed segment agree."""
    segment = Segment(hall=0, begin=(0.0, 0.0), end=(0.0, 3.0))
    model = {
        "format": "closedlap-faults",
        "version": 1,
        "name": "one_wall",
        "description": "a wall",
        "parts": [
            {
                "kind": "reflective",
                "incidence": 0.7,
                "segments": [segment.model_dump()],
            }
        ],
    }
    drawn = spec_faults(parse_faults(json.dumps(model), "here"), PLANT, range(9), 0)
    mirrors = mirroring(Mirrors(segments=(segment,), incidence=0.7), PLANT, 0)
    start = State.start(np.linspace(0.5, 1.0, 9), 5.0, 2.0, 0.1)
    safety = named_property("clearance", PLANT.track)

    def steer(scan: np.ndarray) -> np.ndarray:
        return 0.2 * np.tanh(scan[15] - scan[5])

    one, other, none = (
        simulate(PLANT, steer, safety, start, 25, disturb).margin
        for disturb in (drawn, GivenFaults(1.5, 5.0, mirrors=mirrors), None)
    )
    assert (one == other).all()
    assert (one != none).any()


@pytest.mark.parametrize("chosen", [[-1, 0, 1], [1, 1, -1]])
def test_each_run_of_a_batch_has_its_own_stretch(chosen):
    given_mirrors = Mirrors(segments=STRETCHES, incidence=0.3)
    state = State.start(np.array([0.6, 0.7, 0.8]), 2.5, 2.0, 0.3)
    scan = PLANT.scan_rows(state)
    together = mirroring(given_mirrors, PLANT, chosen).lost(state, scan)
    for run, index in enumerate(chosen):
        one = np.array([run])
        alone = mirroring(given_mirrors, PLANT, index).lost(state.take(one), scan[:, one])
        assert (together[:, one] == alone).all()
        assert alone.any() == (index >= 0)
