"""The compact automaton: exact functions in resets and flows, no auxiliary time.

A ray's reading is reset to g / h when a nearer face is found; a layer of the network is one
reset; the car is driven by the bicycle model's own equations.
"""

from __future__ import annotations

from collections.abc import Sequence

from generator.hybrid.automaton import Assignment, Automaton, Constraint, Mode, StateVariable
from generator.hybrid.build import build
from generator.hybrid.dialect import Row, Sight, V
from generator.hybrid.expression import (
    Call,
    Dot,
    Expression,
    Quotient,
    Variable,
    constant,
    variables,
)
from generator.hybrid.steps import Step
from racecar.controller import Controller, Layer
from racecar.instance import Instance

THETA, DELTA, BETA = Variable("theta"), Variable("delta"), Variable("beta")
#: Of the ray at work: angle relative to the heading, and reading so far.
ALPHA, READING = Variable("alpha"), Variable("y")


def native_automaton(instance: Instance, controller: Controller) -> Automaton:
    """Return the automaton of an instance with exact functions.

    Raises BadInput if the property leaves out part of a wall.
    """
    return build(instance, controller, _Native(instance, controller))


def layer_sums(layer: Layer, inputs: Sequence[Expression]) -> list[Expression]:
    """Return the weighted sums of a layer, float32 weights as they are."""
    rows = zip(layer.weights.tolist(), layer.biases.tolist(), strict=True)
    return [Dot(tuple(row), tuple(inputs), bias) for row, bias in rows]


class _Native:
    def __init__(self, instance: Instance, controller: Controller) -> None:
        self.plant = instance.plant
        self.angles = instance.make_plant().lidar.angles.tolist()
        self.layers = controller.layers
        self.rays = [f"y{i}" for i in range(1, controller.rays + 1)]
        width = max((len(layer.biases) for layer in self.layers[:-1]), default=0)
        self.neurons = [f"x{j}" for j in range(1, width + 1)]
        self.steering: Expression = constant(0.0)

    def variables(self) -> list[StateVariable]:
        found = [
            StateVariable("theta", "heading, 0 along the hall, counter-clockwise", "rad"),
            StateVariable("delta", "steering angle", "rad"),
            StateVariable("alpha", "angle of the ray at work, relative to the heading", "rad"),
            StateVariable("y", "what the ray at work reads so far", "m"),
        ]
        if self.plant.bicycle.slip:
            found.append(StateVariable("beta", "slip angle", "rad"))
        found += [StateVariable(y, f"reading of ray {i}", "m") for i, y in enumerate(self.rays, 1)]
        return found + [
            StateVariable(x, f"neuron {j} of the layer at work")
            for j, x in enumerate(self.neurons, 1)
        ]

    def begin(self) -> dict[str, float]:
        return {}

    def heading(self) -> str:
        return "theta"

    def start(self) -> list[Step]:
        return []

    def prepare(self) -> list[Step]:
        return []

    def settle(self) -> list[Step]:
        return []

    def sight(self) -> Sight:
        course = THETA + ALPHA
        return Sight(Call("sin", course), Call("cos", course))

    def aim(self, ray: int) -> list[Assignment]:
        return [
            Assignment("alpha", constant(self.angles[ray - 1])),
            Assignment("y", constant(self.plant.lidar.range)),
        ]

    def nearer(self, sight: Sight, row: Row) -> Constraint:
        return Constraint(sight.gap(row) - READING * sight.approach(row), "<=", 0.0)

    def hit(self, sight: Sight, row: Row) -> list[Assignment]:
        return [Assignment("y", Quotient(sight.gap(row), sight.approach(row)))]

    def keep(self, ray: int) -> list[Assignment]:
        return [Assignment(self.rays[ray - 1], READING)]

    def read(self) -> list[Step]:
        return []

    def readings(self) -> list[Expression]:
        return list(variables(self.rays))

    def registers(self) -> list[str]:
        return self.rays

    def network(self, inputs: Sequence[Expression]) -> list[Step]:
        steps, given = [], list(inputs)
        for i, layer in enumerate(self.layers, start=1):
            values = [_activated(layer.activation, z) for z in layer_sums(layer, given)]
            if i == len(self.layers):
                self.steering = values[0]
                break
            names = self.neurons[: len(values)]
            write = tuple(Assignment(x, value) for x, value in zip(names, values, strict=True))
            steps.append(Step(Mode(f"layer_{i}", f"layer {i} is done"), write))
            given = list(variables(names))
        last = Mode("steer", "the steering angle is set")
        return [*steps, Step(last, (Assignment("delta", self.steering),))]

    def enter_drive(self) -> list[Assignment]:
        if not self.plant.bicycle.slip:
            return []
        car = self.plant.bicycle
        slope = Quotient(car.rear * Call("tan", DELTA), constant(car.front) + car.rear)
        return [Assignment("beta", Call("atan", slope))]

    def drive(self) -> dict[str, Expression]:
        car = self.plant.bicycle
        course = THETA + BETA if car.slip else THETA
        turning = V * Call("cos", BETA) if car.slip else V
        return {
            "s": -(V * Call("sin", course)),
            "f": -(V * Call("cos", course)),
            "v": car.acceleration * (car.motor * (constant(car.throttle) - car.hysteresis) - V),
            "theta": Quotient(turning * Call("tan", DELTA), constant(car.front) + car.rear),
        }

    def turn(self, rotation: float) -> list[Assignment]:
        return [Assignment("theta", THETA + rotation)]


def _activated(activation: str, z: Expression) -> Expression:
    return z if activation == "linear" else Call(activation, z)
