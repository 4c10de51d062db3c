from __future__ import annotations

import io
import math
from xml.etree import ElementTree

import matplotlib.image
import numpy as np
import pytest
from matplotlib.colors import to_rgb

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.errors import BadInput
from racecar.experiment import EvenStarts, Experiment, RandomStarts, run_experiment
from racecar.faults import FAULTS, Faults
from racecar.figure import (
    BLUE,
    UNSAFE,
    VERMILLION,
    WALL,
    check_format,
    clip,
    draw_track,
    new_figure,
    save_figure,
)
from racecar.lidar import Lidar
from racecar.plot import draw_traces, trace_paths
from racecar.plot_scan import draw_scan, take_scan
from racecar.polygon import Polygon
from racecar.safety import named_property
from racecar.track import square_track, track_from_turns


def plant(track=None, rays: int = 21) -> Plant:
    return Plant(track or square_track(), Bicycle(), Lidar(rays))


def record(steer, starts, car=None, name="clearance", **changes):
    car = car or plant()
    safety = named_property(name, car.track)
    setup = Experiment(car, safety, starts, **changes)
    return car, safety, run_experiment(setup, steer, record=True)


def hold(angle: float):
    return lambda scan: np.full(scan.shape[1], angle)


def colours(path) -> set[tuple[int, ...]]:
    pixels = np.round(matplotlib.image.imread(path)[..., :3] * 255).astype(int)
    packed = np.unique(pixels @ (1 << 16, 1 << 8, 1))
    return {(int(x) >> 16, int(x) >> 8 & 255, int(x) & 255) for x in packed}


def rgb(colour: str) -> tuple[int, ...]:
    return tuple(round(255 * x) for x in to_rgb(colour))


class TestClip:
    LOWER, UPPER = np.zeros(2), np.array([2.0, 1.0])

    def area(self, constraints) -> float:
        corners = clip(Polygon.from_constraints(constraints), self.LOWER, self.UPPER)
        x, y = corners[:, 0], corners[:, 1]
        return abs(float(np.dot(x, np.roll(y, -1)) - np.dot(y, np.roll(x, -1)))) / 2

    @pytest.mark.parametrize(
        ("constraints", "area"),
        [
            ([[1, 0, 5]], 2.0),  # covers the box
            ([[1, 0, 0.5]], 0.5),
            ([[-1, 0, -0.5], [0, -1, -0.25]], 1.125),  # a corner, unbounded
            ([[1, 2, 2]], 1.0),  # along the diagonal
            ([[1, 0, 1.5], [-1, 0, -0.5], [0, 1, 0.75], [0, -1, -0.25]], 0.5),  # inside
            ([[1, 0, -1]], 0.0),
        ],
    )
    def test_area_is_that_of_the_intersection(self, constraints, area):
        assert self.area(constraints) == pytest.approx(area, abs=1e-12)

    def test_a_polygon_outside_leaves_nothing(self):
        assert clip(Polygon.from_constraints([[1, 0, -1]]), self.LOWER, self.UPPER).shape == (0, 2)


@pytest.mark.parametrize("name", ["clearance", "hscc20"])
def test_the_drawn_track_is_the_models(name, tmp_path):
    """Wall and unsafe zone, read back from the pixels of a figure."""
    track = square_track()
    safety = named_property(name, track)
    view = (-3.0, 0.5, -3.0, 0.5)
    figure, axes = new_figure(view, "", "")
    draw_track(axes, track, view, safety)
    figure.canvas.draw()
    pixels = np.asarray(figure.canvas.buffer_rgba())[..., :3]
    for x, y in np.random.default_rng(0).uniform((-2.98, -2.98), (0.48, 0.48), (400, 2)):
        s, f = -y, -x  # the first hall's frame
        room = min(s, f, max(1.5 - s, 1.5 - f))
        unsafe = min(float(p.separation(s, f)) for p in safety.unsafe[0])
        if abs(room) < 0.03 or abs(unsafe) < 0.03:
            continue
        column, row = axes.transData.transform((x, y))
        seen = tuple(int(c) for c in pixels[pixels.shape[0] - 1 - int(row), int(column)])
        assert seen == rgb(WALL if room < 0 else UNSAFE if unsafe < 0 else "white"), (x, y)


class TestTracePaths:
    def test_a_straight_drive_is_a_straight_line(self):
        car, _, outcome = record(hold(0.0), EvenStarts((0.6, 0.9)), runs=4, steps=20)
        x, y = trace_paths(car, outcome, points=3)
        assert x.shape == y.shape == (4, 61)
        np.testing.assert_allclose(y, np.broadcast_to(-outcome.start.s[:, None], y.shape))
        assert (x[:, 0] == -9.9).all()
        assert (np.diff(x, axis=1) > 0).all()

    def test_a_held_angle_gives_points_on_one_circle(self):
        angle = math.radians(5)
        car, _, outcome = record(hold(angle), EvenStarts((0.9, 0.9)), runs=1, steps=12)
        x, y = trace_paths(car, outcome)
        radius = 0.45 / math.tan(angle)  # to the left of the start
        np.testing.assert_allclose(np.hypot(x + 9.9, y - (radius - 0.9)), radius, atol=1e-12)

    def test_the_path_goes_on_through_a_change_of_frame(self):
        # In the second hall, as the first hall's frame sees it, driving along it.
        starts = EvenStarts((3.0, 3.0), f=0.75, theta=-math.pi / 2)
        car, _, outcome = record(hold(0.0), starts, runs=1, steps=40)
        assert outcome.runs.trace["frame"][0, -1] == 1
        x, y = trace_paths(car, outcome)
        np.testing.assert_allclose(x, -0.75, atol=1e-12)
        assert y[0, 0] == -3
        assert (np.diff(y) < 0).all()
        assert y[0, -1] == pytest.approx(-3 - car.bicycle.distance_after(0.0, 4.0))

    def test_a_path_ends_at_the_crash(self):
        car, _, outcome = record(hold(0.2), EvenStarts(), runs=2, steps=70)
        x, y = trace_paths(car, outcome)
        for i, step in enumerate(outcome.runs.crash_step):
            assert 0 < step < 70
            assert np.isfinite(x[i]).sum() == np.isfinite(y[i]).sum() == 1 + 4 * step
            frame, s, f = (outcome.runs.trace[name][i, step] for name in ("frame", "s", "f"))
            end = car.track.to_global(frame, s, f, 0.0)
            assert x[i, 4 * step] == pytest.approx(float(end[0]), abs=1e-12)
            assert y[i, 4 * step] == pytest.approx(float(end[1]), abs=1e-12)

    def test_runs_without_traces_are_refused(self):
        car = plant()
        setup = Experiment(car, named_property("clearance", car.track), EvenStarts(), runs=1)
        with pytest.raises(ValueError, match="not recorded"):
            trace_paths(car, run_experiment(setup, hold(0.0)))


class TestDrawTraces:
    def test_safe_and_crashed_runs_differ_in_colour_and_line_style(self):
        starts = RandomStarts((0.5, 1.0), theta=(-0.3, 0.3))
        car, safety, outcome = record(hold(0.0), starts, runs=40, steps=25)
        crashed = int(np.sum(~outcome.safe))
        assert 0 < crashed < 40
        figure = draw_traces(car, safety, outcome, "title", "subtitle")
        # Each run is drawn twice: on the track and enlarged.
        for axes in (figure.axes[0], figure.axes[0].child_axes[0]):
            lines = axes.get_lines()
            safe = [x for x in lines if x.get_color() == BLUE and x.get_linestyle() == "-"]
            dashed = [x for x in lines if x.get_color() == VERMILLION and x.get_linestyle() == "--"]
            marks = [x for x in lines if x.get_marker() == "X"]
            assert (len(safe), len(dashed), len(marks)) == (40 - crashed, crashed, crashed)
        ends = {(float(x.get_xdata()[-1]), float(x.get_ydata()[-1])) for x in dashed}
        assert ends == {(float(x.get_xdata()[0]), float(x.get_ydata()[0])) for x in marks}
        texts = [text.get_text() for text in figure.legends[0].get_texts()]
        assert f"safe runs: {40 - crashed}" in texts
        assert f"crashed runs: {crashed}" in texts

    def test_axes_name_their_units_and_are_to_scale(self):
        car, safety, outcome = record(hold(0.0), EvenStarts(), runs=2, steps=10)
        axes = draw_traces(car, safety, outcome, "title", "subtitle").axes[0]
        assert (axes.get_xlabel(), axes.get_ylabel()) == ("x (m)", "y (m)")
        assert axes.get_aspect() == 1.0
        assert axes.get_title().startswith("title")

    def test_the_view_is_the_first_turn_or_the_whole_track(self):
        car, safety, outcome = record(hold(0.0), EvenStarts(), runs=2, steps=10)
        axes = draw_traces(car, safety, outcome, "", "").axes[0]
        assert axes.get_xlim() == pytest.approx((-10.4, 0.5))
        assert axes.get_ylim() == pytest.approx((-8.0, 0.5))
        axes = draw_traces(car, safety, outcome, "", "", whole_track=True).axes[0]
        assert axes.get_xlim() == axes.get_ylim() == pytest.approx((-20.5, 0.5))

    def test_a_left_turn_is_in_view(self):
        car = plant(track_from_turns(["left", "right"]))
        _, safety, outcome = record(hold(0.0), EvenStarts(), car, runs=2, steps=10)
        axes = draw_traces(car, safety, outcome, "", "").axes[0]
        assert axes.get_ylim() == pytest.approx((-2.0, 8.0))


class TestScan:
    def test_without_faults_it_is_the_lidars(self):
        car = plant(rays=41)
        scan = take_scan(car, 0.6, 3.0, 0.2, FAULTS["none"])
        expected = car.lidar.scan(car.track.frames[0].obstacles, 0.6, 3.0, 0.2)[0]
        np.testing.assert_array_equal(scan.distances, expected)
        assert not scan.missing.any()
        assert scan.steering is None

    @pytest.mark.parametrize(("f", "in_turn"), [(2.4, True), (2.6, False)])
    def test_rays_are_missing_in_the_turn_only(self, f, in_turn):
        scan = take_scan(plant(), 0.6, f, 0.0, Faults(missing=5), seed=3)
        clear = take_scan(plant(), 0.6, f, 0.0, FAULTS["none"])
        assert scan.missing.any() == in_turn
        assert scan.missing.sum() <= 5
        assert (scan.distances[scan.missing] == 5).all()
        kept = ~scan.missing
        np.testing.assert_array_equal(scan.distances[kept], clear.distances[kept])

    def test_noise_adds_up_to_its_bound(self):
        clear = take_scan(plant(), 0.6, 4.0, 0.0, FAULTS["none"]).distances
        noisy = take_scan(plant(), 0.6, 4.0, 0.0, Faults(noise=0.2), seed=1).distances
        added = noisy - clear
        assert (added >= 0).all()
        assert 0.1 < added.max() <= 0.2

    def test_the_seed_decides(self):
        scans = [take_scan(plant(), 0.6, 2.0, 0.0, FAULTS["paper"], seed) for seed in (1, 1, 2)]
        np.testing.assert_array_equal(scans[0].distances, scans[1].distances)
        assert (scans[0].distances != scans[2].distances).any()

    def test_the_controller_reads_the_scan_as_it_is_drawn(self):
        scan = take_scan(plant(), 0.6, 2.0, 0.0, FAULTS["paper"], 1, lambda x: x.sum(axis=0) / 500)
        assert scan.steering == pytest.approx(scan.distances.sum() / 500)

    @pytest.mark.parametrize("pose", [(0.0, 3.0), (1.6, 3.0), (0.7, 0.0)])
    def test_a_pose_in_a_wall_is_refused(self, pose):
        with pytest.raises(BadInput, match=r"scan: s = .* inside a wall"):
            take_scan(plant(), *pose, 0.0, FAULTS["none"])

    def test_a_pose_that_is_not_finite_is_refused(self):
        with pytest.raises(BadInput, match="finite"):
            take_scan(plant(), 0.7, 3.0, math.nan, FAULTS["none"])

    def test_rays_are_drawn_from_the_car_to_their_readings(self):
        car = plant()
        scan = take_scan(car, 0.6, 2.0, 0.3, Faults(missing=4), seed=1)
        axes = draw_scan(car, scan, "title", "subtitle").axes[0]
        drawn = {}
        for collection in axes.collections:
            dashed = collection.get_linestyle()[0][1] is not None
            for start, tip in collection.get_segments():
                assert tuple(start) == pytest.approx((-2.0, -0.6))
                drawn[math.atan2(tip[1] + 0.6, tip[0] + 2.0)] = (math.dist(start, tip), dashed)
        angles = 0.3 + car.lidar.angles
        assert len(drawn) == 21
        for angle, length, missing in zip(angles, scan.distances, scan.missing, strict=True):
            wrapped = math.atan2(math.sin(angle), math.cos(angle))
            nearest = min(drawn, key=lambda a: abs(a - wrapped))
            assert nearest == pytest.approx(wrapped, abs=1e-9)
            assert drawn[nearest] == (pytest.approx(length, abs=1e-9), bool(missing))


class TestSaving:
    @pytest.fixture
    def figure(self):
        car, safety, outcome = record(hold(0.0), RandomStarts((0.5, 1.0)), runs=20, steps=30)
        return draw_traces(car, safety, outcome, "A title", "subtitle")

    def test_png_shows_walls_unsafe_zone_and_runs(self, figure, tmp_path):
        path = tmp_path / "new folder" / "traces.PNG"
        save_figure(figure, path)
        assert path.read_bytes().startswith(b"\x89PNG\r\n\x1a\n")
        assert {rgb(c) for c in (WALL, UNSAFE, "white")} <= colours(path)
        assert [p.name for p in path.parent.iterdir()] == [path.name]

    def test_svg_is_well_formed_and_undated(self, figure, tmp_path):
        path = tmp_path / "traces.svg"
        save_figure(figure, path)
        root = ElementTree.parse(path).getroot()
        assert root.tag == "{http://www.w3.org/2000/svg}svg"
        assert not list(root.iter("{http://purl.org/dc/elements/1.1/}date"))
        assert len(list(root.iter("{http://www.w3.org/2000/svg}path"))) > 40

    @pytest.mark.parametrize("name", ["traces", "traces.pdf", "traces.png.txt"])
    def test_other_formats_are_refused(self, figure, name, tmp_path):
        with pytest.raises(BadInput, match=r"written as \.png or \.svg"):
            save_figure(figure, tmp_path / name)
        with pytest.raises(BadInput, match=r"written as \.png or \.svg"):
            check_format(tmp_path / name)
        assert not list(tmp_path.iterdir())

    def test_a_users_settings_do_not_matter(self, tmp_path):
        car = plant()
        scan = take_scan(car, 0.6, 2.0, 0.3, FAULTS["paper"])
        for name, settings in (("a", {}), ("b", {"lines.linewidth": 9, "font.size": 30})):
            with matplotlib.rc_context(settings):
                figure = draw_scan(car, scan, "title", "subtitle")
                for suffix in ("png", "svg"):
                    save_figure(figure, tmp_path / f"{name}.{suffix}")
        for suffix in ("png", "svg"):
            first, second = (tmp_path / f"{name}.{suffix}" for name in "ab")
            assert first.read_bytes() == second.read_bytes()
        assert matplotlib.image.imread(io.BytesIO((tmp_path / "a.png").read_bytes())).ndim == 3
