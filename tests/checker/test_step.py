"""Readings and whole steps of the checker, against simulated cars."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from flint import arb

from checker.balls import Balls, to_arb
from checker.batch import of_models
from checker.batch_lidar import readings
from checker.batch_network import BatchNetwork
from checker.batch_step import Arcs
from checker.files import Layer as ReadLayer
from checker.files import Rejected
from checker.lidar import Assumed, Rays, View
from checker.models import TERMS, UNIT, Model, symbols
from checker.step import Motion, Network, Path, Sensors, choices, steering
from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant, State
from racecar.controller import Controller, Layer
from racecar.instance import plant_data
from racecar.lidar import Lidar
from racecar.safety import Property, named_property
from racecar.track import square_track, track_from_turns

TRACKS = {"square": square_track(), "bends": track_from_turns(["left", "right", "left"], 8.0)}
SYMBOLS = 2
#: Rounding of the simulation in doubles.
ROUNDING = 1e-11
#: What is raised where nothing is proved.
UNPROVED = (Rejected, ArithmeticError)


def in_doubles(rays: Rays, obstacles, state: list[Model], assumed: Assumed) -> Balls:
    """Return the readings of a row; infinite where they are not proved."""
    one = Balls(*(x[None] for x in of_models(state)))
    read, proved = readings(rays, obstacles, one, [assumed])
    read.radius[~proved, -1] = np.inf
    return read.at(0)


class Cars:
    """A row of cars at random, and members of it."""

    def __init__(self, random: np.random.Generator, width: float, turn: bool = False) -> None:
        self.random = random
        f = random.uniform(0.4, 3.0 if turn or random.uniform() < 0.7 else 7.0)
        middle = [random.uniform(0.4, 1.1), f, random.uniform(0, 2.4), random.uniform(-0.5, 0.5)]
        scale = width * np.array([1, 1, 0.3, 0.5])[:, None]
        self.poly = scale * random.uniform(-1, 1, (4, TERMS)) * 0.3 ** np.arange(TERMS)
        self.poly[:, 0] = middle
        self.errors = 0.2 * scale * random.uniform(-1, 1, (4, 2 * SYMBOLS))
        self.radius = 0.02 * width * random.uniform(size=4)

    def models(self) -> list[Model]:
        return [
            [*map(arb, p.tolist()), *map(arb, e.tolist()), arb(float(r)) * UNIT]
            for p, e, r in zip(self.poly, self.errors, self.radius, strict=True)
        ]

    def member(self) -> tuple[float, np.ndarray, np.ndarray]:
        """Return x, e and the state there."""
        x, e = self.random.uniform(-1, 1), self.random.choice([-1.0, 1.0], SYMBOLS)
        x = float(self.random.choice([x, -1.0, 1.0]))
        errors = (self.errors[:, :SYMBOLS] + self.errors[:, SYMBOLS:] * x) @ e
        rest = self.radius * self.random.choice([-1.0, 1.0], 4)
        return x, e, self.poly @ x ** np.arange(TERMS) + errors + rest


def outside(z: Model, value: float, x: float, e: np.ndarray) -> float:
    """Return by how much a value is outside of a model at x and e, other symbols free."""
    m = symbols(z)
    parts = np.array([float(c) for c in z[:-1]])
    a, b = parts[TERMS : TERMS + m], parts[TERMS + m :]
    there = parts[:TERMS] @ x ** np.arange(TERMS) + (a[: len(e)] + b[: len(e)] * x) @ e
    free = np.abs(a[len(e) :]).sum() + np.abs(b[len(e) :]).sum() + float(z[-1].rad())
    return abs(value - there) - free


def plant(track: str = "square", rays: int = 21, slip: bool = False) -> Plant:
    return Plant(TRACKS[track], Bicycle(slip=slip), Lidar(rays))


@pytest.mark.parametrize("track", TRACKS)
@pytest.mark.parametrize("width", [0.02, 1e-3, 1e-6])
@pytest.mark.parametrize("doubles", [False, True])
def test_readings_contain_those_of_the_simulator(track, width, doubles):
    car = plant(track, 41)
    obstacles = [p.to_constraints() for p in car.track.frames[0].obstacles]
    rays = Rays({"rays": 41, "range": 5.0, "field_of_view": car.lidar.field_of_view})
    proved = 0
    for seed in range(12):
        cars = Cars(np.random.default_rng(seed), width)
        view = View(rays, obstacles, cars.models(), {})
        quick = in_doubles(rays, obstacles, cars.models(), {})
        members = [cars.member() for _ in range(8)]
        states = np.array([state for _, _, state in members])
        seen = car.lidar.scan(car.track.frames[0].obstacles, *states[:, [0, 1, 3]].T)
        for ray in range(41):
            try:
                z = to_arb(quick.at(ray)) if doubles else view.reading(ray)
            except UNPROVED:
                continue
            if not z[-1].is_finite():
                continue
            proved += 1
            for (x, e, _), distance in zip(members, seen[:, ray], strict=True):
                assert outside(z, distance, x, e) <= ROUNDING
    assert proved > (0.5 if doubles else 0.7) * 12 * 41


@pytest.mark.parametrize("track", TRACKS)
def test_readings_in_doubles_are_hardly_wider_than_those_of_arb(track):
    car, proved = plant(track, 41), 0
    obstacles = [p.to_constraints() for p in car.track.frames[0].obstacles]
    rays = Rays({"rays": 41, "range": 5.0, "field_of_view": car.lidar.field_of_view})
    for seed in range(12):
        cars = Cars(np.random.default_rng(seed), 1e-3)
        view = View(rays, obstacles, cars.models(), {})
        quick = in_doubles(rays, obstacles, cars.models(), {})
        for ray in np.flatnonzero(np.isfinite(quick.radius[:, -1])).tolist():
            slow = float(view.reading(ray)[-1].rad())  # nor is more proved than by Arb
            assert quick.radius[ray, -1] <= 1.01 * slow + 1e-12
            proved += 1
    assert proved > 0.8 * 12 * 41


@pytest.mark.parametrize("doubles", [False, True])
def test_readings_hold_for_the_members_that_satisfy_an_assumption(doubles):
    """A ray past the inner corner: it hits for one sign, and passes for the other."""
    car = plant(rays=41)
    walls = car.track.frames[0].obstacles
    rays = Rays({"rays": 41, "range": 5.0, "field_of_view": car.lidar.field_of_view})
    corner = next(i for i, p in enumerate(walls) if len(p.offsets) == 4)
    faces = walls[corner]
    found = {True: 0, False: 0}
    for seed in range(60):
        cars = Cars(np.random.default_rng(seed), 0.03, turn=True)
        obstacles, state = [p.to_constraints() for p in walls], cars.models()
        view = View(rays, obstacles, state, {})
        members = [cars.member() for _ in range(20)]
        states = np.array([state for _, _, state in members])
        seen = car.lidar.scan(walls, *states[:, [0, 1, 3]].T)
        for ray in range(41):
            try:
                view.reading(ray)
            except UNPROVED:
                pass
            else:
                continue
            heading = states[:, 3] + car.lidar.angles[ray]
            g = faces.misses(states[:, 0], states[:, 1])
            h = faces.normals @ np.array([np.sin(heading), np.cos(heading)])
            for j, k in ((0, 2), (0, 3), (2, 0), (2, 1)):
                cross = h[k] * g[j] - h[j] * g[k]
                for sign in (True, False):
                    try:
                        given = {(ray, corner, j, k): sign}
                        if doubles:
                            z = to_arb(in_doubles(rays, obstacles, state, given).at(ray))
                        else:
                            z = View(rays, obstacles, state, given).reading(ray)
                    except UNPROVED:
                        continue
                    if not z[-1].is_finite():
                        continue
                    for (x, e, _), d, value in zip(members, seen[:, ray], cross, strict=True):
                        if (value > 1e-9) == sign and abs(value) > 1e-9:
                            found[sign] += 1
                            assert outside(z, d, x, e) <= ROUNDING
    assert min(found.values()) > 50


def test_readings_are_the_same_in_blocks_of_rays(monkeypatch):
    car = plant(rays=41)
    walls = car.track.frames[0].obstacles
    rays = Rays({"rays": 41, "range": 5.0, "field_of_view": car.lidar.field_of_view})
    corner = next(i for i, p in enumerate(walls) if len(p.offsets) == 4)
    obstacles = [p.to_constraints() for p in walls]
    states = [Cars(np.random.default_rng(k), 0.03, turn=True).models() for k in range(20)]
    models = Balls(*(np.stack(x) for x in zip(*map(of_models, states), strict=True)))
    assumed: list[Assumed] = [{(ray, corner, 0, 2): ray % 2 == 0} for ray in range(15, 35)]
    whole, proved = readings(rays, obstacles, models, assumed)
    assert not proved.all()
    assert (proved != readings(rays, obstacles, models, [{}] * 20)[1]).any()
    for at_once in (1, 20 * 11 * 15):
        monkeypatch.setattr("checker.batch_lidar._AT_ONCE", at_once)
        parts, also = readings(rays, obstacles, models, assumed)
        assert (also == proved).all()
        for x, y in zip(parts, whole, strict=True):
            np.testing.assert_allclose(x[proved], y[proved], rtol=1e-9, atol=1e-13)


def controller(random: np.random.Generator, rays: int, activation: str) -> Controller:
    sizes = [rays, 8, 6]
    layers = []
    for a, b in itertools.pairwise(sizes):
        weights = random.normal(size=(b, a)) / np.sqrt(a)
        layers.append((weights, 0.3 * random.normal(size=b), activation))
    layers.append((0.3 * random.normal(size=(1, 6)), np.zeros(1), "tanh"))
    layers.append((np.array([[0.26]]), np.zeros(1), "linear"))
    return Controller(
        tuple(Layer(w.astype(np.float32), c.astype(np.float32), a) for w, c, a in layers)
    )


def data_of(car: Plant, **fault) -> dict:
    point = dict.fromkeys(("s", "f", "v", "theta"), (0.0, 0.0))
    data = {"plant": plant_data(car).model_dump(mode="json"), "initial_set": point}
    return data | ({"disturbance": fault} if fault else {})


NOISE = {"noise": 0.01, "missing": 0, "turn_only": False, "choice": "run"}
RUN = {"noise": 0.0, "missing": 2, "turn_only": True, "choice": "run"}
STEP = {"noise": 0.002, "missing": 1, "turn_only": True, "choice": "step"}


@pytest.mark.parametrize("doubles", [False, True])
def test_noise_is_followed_ray_by_ray_and_cut_off_at_the_range(doubles):
    """Each reading is off by the noise, no more, also where it is the same on all of the row."""
    random, noise = np.random.default_rng(1), 0.01
    cars = Cars(random, 0.0)  # one state, far from the front wall: some rays end at the range
    cars.poly[:, 0] = 0.75, 7.0, 2.4, 0.0
    sensors = Sensors(data_of(plant(rays=21), **NOISE))
    state = cars.models()
    obstacles = data_of(plant(rays=21))["plant"]["frames"][0]["obstacles"]
    view = View(sensors.rays, obstacles, state, {})
    if doubles:
        read = sensors.disturbed(in_doubles(sensors.rays, obstacles, state, {}), [])
        noisy = [to_arb(read.at(ray)) for ray in range(21)]
    else:
        noisy = sensors.readings(view, [])
    seen = plant(rays=21).scan_rows(State.start(*cars.member()[2]))[:, 0]
    assert (seen == 5).sum() > 0
    for z, distance in zip(noisy, seen, strict=True):
        reach = float(sum((abs(x) for x in z[TERMS:]), arb(0)).upper())
        assert abs(reach - (noise / 2 if distance == 5 else noise)) < 1e-9
        assert abs(float(z[0]) + reach - min(distance + noise, 5.0)) < 1e-9


class InDoubles:
    """The arc of one row as ``Path`` has it, from what is known of many rows in doubles."""

    def __init__(self, motion: Motion, state: list[Model], delta: Model) -> None:
        one = Balls(*(x[None] for x in of_models(state)))
        self._arcs = Arcs(motion, one, of_models([delta]))
        self.end = [to_arb(self._arcs.end.at(0, k)) for k in range(4)]

    def point(self, share: float) -> list[Model]:
        return [to_arb(z.at(0)) for z in self._arcs.point(share, np.array([0]))]

    def clear(self, polygon: list[list[float]], margin: arb) -> None:
        if not self._arcs.clear(polygon, float(margin)).all():
            raise Rejected("not by one face on each piece")


def clear(path: Path | InDoubles, safety: Property, margin: float) -> bool:
    """Tell whether the checker proves a margin to all of the unsafe set."""
    try:
        for polygon in safety.unsafe[0]:
            path.clear(polygon.to_constraints(), arb(margin))
    except Rejected:
        return False
    return True


@pytest.mark.parametrize(
    ("activation", "slip", "fault"),
    [
        ("tanh", False, {}),
        ("tanh", True, {}),
        ("relu", False, {}),
        ("sigmoid", True, {}),
        ("tanh", False, NOISE),
        ("relu", False, RUN),
        ("tanh", False, STEP),
    ],
)
@pytest.mark.parametrize("doubles", [False, True])
def test_steps_contain_those_of_the_simulator(activation, slip, fault, doubles):
    car, done = plant(rays=9, slip=slip), 0
    safety = named_property("clearance", car.track)
    for seed in range(25):
        random = np.random.default_rng(seed)
        cars, net = (
            Cars(random, random.choice([0.03, 1e-3, 1e-5])),
            controller(random, 9, activation),
        )
        data = data_of(car, **fault)
        sensors = Sensors(data)
        names = {"tanh": "Tanh", "relu": "Relu", "sigmoid": "Sigmoid", "linear": ""}
        layers = [ReadLayer(x.weights, x.biases, names[x.activation]) for x in net.layers]
        state = cars.models()
        obstacles = data["plant"]["frames"][0]["obstacles"]
        view = View(sensors.rays, obstacles, state, {})
        case = (
            {"run": [2, 6], "step": list(range(9))}[fault["choice"]] if fault.get("missing") else []
        )
        active = sensors.active(state, None) if case else (False, True)
        try:
            if doubles:
                read = in_doubles(sensors.rays, obstacles, state, {})
                found = [sensors.disturbed(read, gone) for gone in choices(sensors, case, active)]
                answers = BatchNetwork(layers).steering(found)
            else:
                scans = [sensors.readings(view, gone) for gone in choices(sensors, case, active)]
                answers = list(map(Network(layers).steering, scans))
        except UNPROVED:
            continue
        if None in answers:
            continue
        delta = steering(answers, SYMBOLS)
        arc_of = InDoubles if doubles and not slip else Path
        path = arc_of(Motion(data["plant"]), state, delta)
        for _ in range(10):
            x, e, there = cars.member()
            given = State.start(*there)
            scan = car.scan_rows(given)
            if fault.get("noise"):
                noise = fault["noise"] * random.choice([-1.0, 1.0], scan.shape)
                scan = np.clip(scan + noise, 0, 5.0)
            inside = 0 < there[0] < 1.5 and there[1] <= 2.5
            if case and inside:
                gone = case if fault["choice"] == "run" else [int(random.integers(9))]
                scan[gone] = 5.0
            after, arc = car.drive(given, net.steering_rows(scan))
            true = [after.s[0], after.f[0], after.v[0], after.theta[0]]
            for z, value in zip(path.end, true, strict=True):
                assert outside(z, value, x, e) <= ROUNDING
            for share in (0.25, 0.5):
                for z, value in zip(
                    path.point(share), arc.point(share * arc.distance), strict=True
                ):
                    assert outside(z, value[0], x, e) <= ROUNDING
            done += 1
            least = car.arc_margin(safety, given, arc, np.full(1, np.inf))[0]
            for margin in (least + 1e-9, least + 1e-3):
                assert not clear(path, safety, float(margin))
    assert done > 100


@pytest.mark.parametrize("arc_of", [Path, InDoubles])
def test_the_clearance_of_a_thin_row_is_proved_to_a_micrometre(arc_of):
    car = plant(rays=9)
    safety = named_property("clearance", car.track)
    for seed in range(20):
        random = np.random.default_rng(seed)
        cars = Cars(random, 1e-8, turn=True)
        state = cars.models()
        delta = random.uniform(-0.26, 0.26)
        constant = [arb(delta), *[arb(0)] * (TERMS + 2 * SYMBOLS + 2)]
        path = arc_of(Motion(data_of(car)["plant"]), state, constant)
        given = State.start(*cars.member()[2])
        _, arc = car.drive(given, np.array([delta]))
        least = car.arc_margin(safety, given, arc, np.full(1, np.inf))[0]
        assert clear(path, safety, float(least) - 1e-6)
