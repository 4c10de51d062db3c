"""Instances: one verification question as plain data, with one reader and one writer.

The JSON form is self-contained: it states the plant's parameters, the geometry in every
local frame and the unsafe set as numbers, so that it can be read without this package.
Lengths are metres, times seconds, angles radians; every number is the IEEE double nearest
to what is printed.
"""

from __future__ import annotations

import hashlib
import json
import math
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from racecar.bicycle import Bicycle
from racecar.closed_loop import Plant
from racecar.controller import Controller, parse_controller, write_whole
from racecar.data import Data, Number, Positive, parse_data
from racecar.disturbance import Disturbance
from racecar.errors import BadInput
from racecar.lidar import Lidar
from racecar.mirrors import complaint_about
from racecar.polygon import Polygon
from racecar.safety import PROPERTIES, Property, named_property
from racecar.track import Hall, Track

#: A half-plane ``a_s s + a_f f <= b`` as ``[a_s, a_f, b]``.
Constraint = tuple[Number, Number, Number]
#: A convex polygon: all of its constraints hold.
Constraints = Annotated[list[Constraint], Field(min_length=1)]
Identifier = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.+-]*$", max_length=200)]


class ControllerReference(Data):
    """Which controller drives."""

    name: Identifier
    file: str = Field(description="ONNX file, relative to the instance's own file")
    sha256: str = Field(pattern=r"^[0-9a-f]{64}$", description="of the ONNX file")


class BicycleData(Data):
    """The kinematic bicycle model: see racecar.bicycle."""

    throttle: Number = Field(description="u")
    acceleration: Positive = Field(description="c_a, 1/s")
    motor: Positive = Field(description="c_m")
    hysteresis: Number = Field(description="c_h")
    front: Positive = Field(description="l_f, m")
    rear: Positive = Field(description="l_r, m")
    slip: bool = Field(description="whether beta = atan(l_r tan(delta) / (l_f + l_r)), else 0")


class LidarData(Data):
    """The LiDAR: rays equally spaced over the field of view, the first at its right end."""

    rays: int = Field(ge=2, le=100_000)
    field_of_view: Positive = Field(description="rad", le=2 * math.pi)
    range: Positive = Field(description="m; readings are clipped here")


class HallData(Data):
    """One hall: its outer length (both corner squares included) and where it turns."""

    length: Positive = Field(description="m")
    turn: Literal["right", "left"] | None


class AdvanceData(Data):
    """The change to the next frame, taken at the end of a control step.

    If ``guard[0] s + guard[1] f > guard[2]``: ``(s, f) <- matrix (s, f) + offset``,
    ``theta <- theta + rotation``.
    """

    guard: Constraint
    to: int = Field(ge=0)
    matrix: tuple[tuple[Number, Number], tuple[Number, Number]]
    offset: tuple[Number, Number]
    rotation: Number = Field(description="rad")


class FrameData(Data):
    """The local frame of one hall: walls as convex polygons, and the change to the next."""

    obstacles: list[Constraints]
    advance: AdvanceData | None


class PlantData(Data):
    """Everything but the controller."""

    period: Positive = Field(description="control period, s")
    bicycle: BicycleData
    lidar: LidarData
    width: Positive = Field(description="of every hall, m")
    closed: bool = Field(description="whether the last hall turns into the first")
    halls: Annotated[list[HallData], Field(min_length=1)]
    frames: list[FrameData] = Field(description="one per hall; they follow from the halls")


class InitialSet(Data):
    """A box of start states, [lower, upper] each, in the frame of the first hall."""

    s: tuple[Number, Number] = Field(description="distance to the left wall, m")
    f: tuple[Number, Number] = Field(description="distance to the front wall, m")
    v: tuple[Number, Number] = Field(description="speed, m/s")
    theta: tuple[Number, Number] = Field(description="heading, rad")

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for name in ("s", "f", "v", "theta"):
            low, high = getattr(self, name)
            if low > high:
                raise ValueError(f"{name}: lower bound {low} is above upper bound {high}")
        if self.v[0] < 0:
            raise ValueError(f"v: the car does not drive backwards, but v may be {self.v[0]}")
        return self

    def bounds(self) -> tuple[np.ndarray, np.ndarray]:
        """Return lower and upper bounds, ``[4]`` each, in the order s, f, v, theta."""
        box = np.array([self.s, self.f, self.v, self.theta])
        return box[:, 0], box[:, 1]


class PropertyData(Data):
    """The unsafe set: ``unsafe[i]`` lists the convex polygons of frame i."""

    name: Identifier
    unsafe: list[Annotated[list[Constraints], Field(min_length=1)]]


class Instance(Data):
    """One question: can the car, from some start state, enter the unsafe set?

    The car may be unsafe at any time in ``[0, steps * period]``, not only at control
    instants. With a disturbance, also: for some of the noise, missing rays and mirrors that it
    allows.
    """

    format: Literal["closedlap-instance"] = "closedlap-instance"
    version: Literal["1.0"] = "1.0"
    id: Identifier
    category: Identifier
    controller: ControllerReference
    plant: PlantData
    initial_set: InitialSet
    disturbance: Disturbance | None = Field(
        default=None, description="of the LiDAR; left out if the readings are exact"
    )
    steps: int = Field(ge=1, le=100_000, description="control periods")
    property: PropertyData

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        try:
            plant = make_plant(self.plant)
            if frames_data(plant.track) != self.plant.frames:
                raise ValueError("plant.frames: they do not follow from plant.halls")
            if len(self.property.unsafe) != len(self.plant.frames):
                raise ValueError("property.unsafe: one list per frame is needed")
            if any(a == b == 0 for f in self.property.unsafe for p in f for a, b, _ in p):
                raise ValueError("property.unsafe: a constraint has the normal (0, 0)")
            if self.property.name in PROPERTIES:
                expected = property_data(named_property(self.property.name, plant.track))
                if self.property != expected:
                    raise ValueError(
                        f"property.unsafe: it is not the property {self.property.name} "
                        "on this track; give it another name"
                    )
        except BadInput as error:
            raise ValueError(str(error)) from None
        rays, disturbance = self.plant.lidar.rays, self.disturbance
        if disturbance is not None and disturbance.missing > rays:
            raise ValueError(
                f"disturbance.missing: {disturbance.missing} of {rays} rays cannot be missing"
            )
        if disturbance is not None and disturbance.mirrors is not None:
            for i, segment in enumerate(disturbance.mirrors.segments):
                complaint = complaint_about(segment, plant.track)
                if complaint is not None:
                    raise ValueError(f"disturbance.mirrors.segments.{i}: {complaint}")
        lower, upper = self.initial_set.bounds()
        for wall in plant.track.frames[0].obstacles:
            if wall.relevant(lower[:2], upper[:2], 0.0) is not None:
                raise ValueError("initial_set: it reaches into a wall; move or shrink s and f")
        return self

    def make_plant(self) -> Plant:
        """Return the plant for simulation."""
        return make_plant(self.plant)

    def make_property(self) -> Property:
        """Return the unsafe set for simulation."""
        return Property(
            self.property.name,
            tuple(
                tuple(Polygon.from_constraints(p) for p in polygons)
                for polygons in self.property.unsafe
            ),
        )


def make_plant(data: PlantData) -> Plant:
    """Return the plant that the data describe."""
    halls = tuple(Hall(h.length, h.turn) for h in data.halls)
    return Plant(
        Track(data.width, halls, data.closed),
        Bicycle(**data.bicycle.model_dump()),
        Lidar(**data.lidar.model_dump()),
        data.period,
    )


def plant_data(plant: Plant) -> PlantData:
    """Return a plant as data."""
    car, lidar, track = plant.bicycle, plant.lidar, plant.track
    return PlantData(
        period=plant.period,
        bicycle=BicycleData(**{name: getattr(car, name) for name in BicycleData.model_fields}),
        lidar=LidarData(**{name: getattr(lidar, name) for name in LidarData.model_fields}),
        width=track.width,
        closed=track.closed,
        halls=[HallData.model_validate({"length": h.length, "turn": h.turn}) for h in track.halls],
        frames=frames_data(track),
    )


def frames_data(track: Track) -> list[FrameData]:
    """Return the frames of a track as data."""
    return [
        FrameData.model_validate(
            {
                "obstacles": [p.to_constraints() for p in frame.obstacles],
                "advance": frame.advance and asdict(frame.advance),
            }
        )
        for frame in track.frames
    ]


def property_data(safety: Property) -> PropertyData:
    """Return an unsafe set as data."""
    unsafe = [[p.to_constraints() for p in polygons] for polygons in safety.unsafe]
    return PropertyData.model_validate({"name": safety.name, "unsafe": unsafe})


def parse_instance(text: str | bytes, where: str) -> Instance:
    """Read an instance from JSON text; BadInput names what is wrong in ``where``."""
    try:
        return parse_data(Instance, text)
    except BadInput as error:
        raise BadInput(f"{where}: {error}") from None


def read_text(path: Path) -> bytes:
    """Read a file; BadInput if that fails."""
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise BadInput(f"{path}: cannot be read ({error.strerror})") from None


def load_instance(path: Path) -> Instance:
    """Read an instance file; BadInput if it is missing, broken or breaks the schema."""
    return parse_instance(read_text(path), str(path))


def controller_path(instance: Instance, path: Path) -> Path:
    """Return where the controller of the instance at ``path`` lies."""
    return Path(path).parent / instance.controller.file


def load_instance_controller(instance: Instance, path: Path) -> Controller:
    """Read the controller of the instance at ``path`` and check that it is the right one."""
    file = controller_path(instance, path)
    content = read_text(file)
    if hashlib.sha256(content).hexdigest() != instance.controller.sha256:
        raise BadInput(f"{file}: its sha256 is not the one that {path} names")
    controller = parse_controller(content, str(file))
    if controller.rays != instance.plant.lidar.rays:
        raise BadInput(
            f"{file}: it reads {controller.rays} rays, but {path} has {instance.plant.lidar.rays}"
        )
    return controller


def format_instance(instance: Instance) -> str:
    """Return the canonical JSON text: the same instance gives the same bytes."""
    data = instance.model_dump(mode="json")
    if instance.disturbance is None:
        del data["disturbance"]
    elif instance.disturbance.mirrors is None:
        del data["disturbance"]["mirrors"]
    return _format(data, "") + "\n"


def _format(value: Any, indent: str) -> str:
    """Format JSON with numbers, points and polygons on one line each."""
    inner = indent + "  "
    if isinstance(value, dict):
        items = [f"{inner}{json.dumps(k)}: {_format(v, inner)}" for k, v in value.items()]
        return "{\n" + ",\n".join(items) + "\n" + indent + "}"
    if isinstance(value, list) and _depth(value) > 2:
        return "[\n" + ",\n".join(inner + _format(v, inner) for v in value) + "\n" + indent + "]"
    return json.dumps(value, allow_nan=False)


def _depth(value: Any) -> int:
    """Return how deep lists are nested; an object that holds lists or objects counts as deep."""
    if isinstance(value, dict):
        return 3 if any(isinstance(x, dict | list) for x in value.values()) else 0
    if isinstance(value, list):
        return 1 + max((_depth(x) for x in value), default=0)
    return 0


def save_instance(instance: Instance, path: Path) -> None:
    """Write an instance file, whole or not at all."""
    write_whole(Path(path), format_instance(instance).encode())


def instance_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of instance files."""
    schema = Instance.model_json_schema()
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}
