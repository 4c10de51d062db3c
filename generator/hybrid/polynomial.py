"""The polynomial automaton: divisions and functions become values of polynomial flows.

Exact, not approximate: each flow below, run for one unit of time, ends at the value wanted.

    1 / b      h' = -h^2 (b - 1),       h(0) = 1      h(t) = 1 / (1 + (b - 1) t),  b > 0
    tanh z     h' = z (1 - h^2),        h(0) = 0      h(t) = tanh(z t)
    sigmoid z  h' = z h (1 - h),        h(0) = 1/2    h(t) = sigmoid(z t)
    tan z      w' = z (1 + w^2),        w(0) = 0      w(t) = tan(z t),  |z| < pi / 2
    1 / sqrt(1 + m^2)  b' = -m^2 b^3 / 2,  b(0) = 1   b(t) = (1 + m^2 t)^(-1/2)

All rays are divided at the same time in one mode, all neurons of a layer run in one mode, with the
operands in registers z1, z2, ... and the results in h1, h2, ... The heading is kept as ct = cos
theta and st = sin theta; the initial mode turns (1, 0) by theta in one unit of time.

Rounded: cosine and sine of the fixed ray angles, to the nearest double.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from generator.hybrid.automaton import Assignment, Automaton, Constraint, Mode, StateVariable
from generator.hybrid.build import build
from generator.hybrid.dialect import V
from generator.hybrid.expression import Expression, Variable, constant, variables
from generator.hybrid.fraction import COS, DEN, NUM, SIN, FractionRays
from generator.hybrid.native import layer_sums
from generator.hybrid.steps import Branch, Step
from racecar.controller import Controller
from racecar.errors import BadInput
from racecar.instance import Instance

#: Inverse of the wheelbase; the value of the tan flow and then the curvature of the path.
INVERSE, CURVATURE = Variable("iw"), Variable("w")
#: The slip: rear part of the wheelbase times curvature, and cosine and sine of the angle.
SLIP, SLIP_COS, SLIP_SIN = Variable("m"), Variable("cb"), Variable("sb")


def polynomial_automaton(instance: Instance, controller: Controller) -> Automaton:
    """Return the automaton of an instance with polynomial flows, guards and resets.

    Raises BadInput if the property leaves out part of a wall, if a frame turns by another
    angle than 90 degrees, or if the steering is not known to stay below 90 degrees.
    """
    return build(instance, controller, _Polynomial(instance, controller))


class _Polynomial(FractionRays):
    def __init__(self, instance: Instance, controller: Controller) -> None:
        super().__init__(instance)
        self.layers, self.rays = controller.layers, controller.rays
        width = max(self.rays, *(len(layer.biases) for layer in self.layers))
        self.operands = [f"z{j}" for j in range(1, width + 1)]
        self.results = [f"h{j}" for j in range(1, width + 1)]
        self.numerators = [f"n{i}" for i in range(1, self.rays + 1)]
        _check_steering(controller)

    def variables(self) -> list[StateVariable]:
        found = [
            StateVariable("ct", "cosine of the heading"),
            StateVariable("st", "sine of the heading"),
            StateVariable("iw", "inverse of the wheelbase, from the initial mode on", "1/m"),
            StateVariable("w", "tangent of the steering angle, then the path's curvature", "1/m"),
        ]
        found += self.ray_variables()
        if self.plant.bicycle.slip:
            found += [
                StateVariable("m", "tangent of the slip angle"),
                StateVariable("cb", "cosine of the slip angle"),
                StateVariable("sb", "sine of the slip angle"),
            ]
        for i, name in enumerate(self.numerators, 1):
            found.append(StateVariable(name, f"ray {i} reads {name} / z{i}", "m"))
        for j, name in enumerate(self.operands, 1):
            found.append(StateVariable(name, f"operand {j}: divisor of a ray, or a neuron's sum"))
        for j, name in enumerate(self.results, 1):
            found.append(StateVariable(name, f"result {j}: 1 / z{j}, or a neuron's value"))
        return found

    def begin(self) -> dict[str, float]:
        return {"ct": 1.0, "iw": 1.0}

    def heading(self) -> str:
        # It waits in the first register until the initial mode has turned (ct, st).
        return self.operands[0]

    def start(self) -> list[Step]:
        heading = Variable(self.heading())
        car = self.plant.bicycle
        flow = {
            "iw": -(INVERSE**2 * (constant(car.front) + car.rear - 1.0)),
            "ct": -(heading * SIN),
            "st": heading * COS,
        }
        return [Step(Mode("begin", "the run begins: heading and wheelbase", flow, 1.0))]

    def prepare(self) -> list[Step]:
        return []

    def settle(self) -> list[Step]:
        return []

    def keep(self, ray: int) -> list[Assignment]:
        return [
            Assignment(self.numerators[ray - 1], NUM),
            Assignment(self.operands[ray - 1], DEN),
        ]

    def read(self) -> list[Step]:
        names = list(zip(self.operands, self.results, strict=True))[: self.rays]
        flow: dict[str, Expression] = {
            h: -(Variable(h) ** 2 * (Variable(z) - 1.0)) for z, h in names
        }
        enter = tuple(Assignment(h, constant(1.0)) for _, h in names)
        return [Step(Mode("divide", "all rays: h = 1 / z", flow, 1.0), enter)]

    def readings(self) -> list[Expression]:
        pairs = zip(self.numerators, self.results, strict=False)
        return [Variable(n) * Variable(h) for n, h in pairs]

    def registers(self) -> list[str]:
        return self.results[: self.rays]

    def network(self, inputs: Sequence[Expression]) -> list[Step]:
        steps, given = [], list(inputs)
        for i, layer in enumerate(self.layers, start=1):
            sums = layer_sums(layer, given)
            last = i == len(self.layers)
            if last and layer.activation == "linear":
                given = sums
                break
            steps += self._layer(i, layer.activation, sums)
            given = list(variables(self.results[: len(sums)]))
        operand = Variable(self.operands[0])
        enter = (Assignment(operand.name, given[0]), Assignment("w", constant(0.0)))
        flow = {"w": operand * (1.0 + CURVATURE**2)}
        steps.append(Step(Mode("tangent", "w = tan(steering)", flow, 1.0), enter))
        return [*steps, *self._slip()]

    def _layer(self, i: int, activation: str, sums: list[Expression]) -> list[Step]:
        names = list(zip(self.operands, self.results, strict=True))[: len(sums)]
        name, text = f"layer_{i}", f"layer {i}: h = {activation}(z)"
        if activation == "linear":
            write = tuple(Assignment(h, x) for (_, h), x in zip(names, sums, strict=True))
            return [Step(Mode(name, text), write)]
        enter = [Assignment(z, x) for (z, _), x in zip(names, sums, strict=True)]
        if activation == "relu":
            return [Step(Mode(name, text), tuple(enter)), *_rectified(name, names)]
        begin, rate = (0.0, _tanh_rate) if activation == "tanh" else (0.5, _sigmoid_rate)
        enter += [Assignment(h, constant(begin)) for _, h in names]
        flow = {h: rate(Variable(z), Variable(h)) for z, h in names}
        return [Step(Mode(name, text, flow, 1.0), tuple(enter))]

    def _slip(self) -> list[Step]:
        if not self.plant.bicycle.slip:
            return []
        flow = {"cb": -(0.5 * SLIP**2 * SLIP_COS**3)}
        enter = (
            Assignment("m", self.plant.bicycle.rear * INVERSE * CURVATURE),
            Assignment("cb", constant(1.0)),
        )
        return [Step(Mode("slip", "cb = cos(slip angle), m its tangent", flow, 1.0), enter)]

    def enter_drive(self) -> list[Assignment]:
        if not self.plant.bicycle.slip:
            return [Assignment("w", CURVATURE * INVERSE)]
        return [
            Assignment("w", CURVATURE * INVERSE * SLIP_COS),
            Assignment("sb", SLIP * SLIP_COS),
        ]

    def drive(self) -> dict[str, Expression]:
        car = self.plant.bicycle
        across: Expression = SIN
        along: Expression = COS
        if car.slip:
            across, along = SIN * SLIP_COS + COS * SLIP_SIN, COS * SLIP_COS - SIN * SLIP_SIN
        return {
            "s": -(V * across),
            "f": -(V * along),
            "v": car.acceleration * (car.motor * (constant(car.throttle) - car.hysteresis) - V),
            "ct": -(V * CURVATURE * SIN),
            "st": V * CURVATURE * COS,
        }

    def turn(self, rotation: float) -> list[Assignment]:
        if abs(rotation) != math.pi / 2:
            raise BadInput(
                f"plant.frames: a frame turns by {rotation} rad; the polynomial form knows "
                "only pi / 2 and -pi / 2"
            )
        if rotation > 0:
            return [Assignment("ct", -SIN), Assignment("st", COS)]
        return [Assignment("ct", SIN), Assignment("st", -COS)]


def _tanh_rate(z: Expression, h: Expression) -> Expression:
    return z * (1.0 - h**2)


def _sigmoid_rate(z: Expression, h: Expression) -> Expression:
    return z * h * (1.0 - h)


def _rectified(name: str, names: Sequence[tuple[str, str]]) -> list[Step]:
    """Return the steps that set h = max(z, 0), neuron by neuron."""
    steps = []
    for j, (z, h) in enumerate(names, start=1):
        positive = Constraint(Variable(z), ">=", 0.0)
        branches: tuple[Branch, ...] = (
            ((positive,), (Assignment(h, Variable(z)),)),
            ((positive.negated(),), (Assignment(h, constant(0.0)),)),
        )
        steps.append(Step(Mode(f"{name}_{j}", f"is the sum of neuron {j} positive?"), (), branches))
    return [*steps, Step(Mode(f"{name}_over", "all neurons of the layer are set"))]


def _check_steering(controller: Controller) -> None:
    """Refuse a controller whose steering may reach 90 degrees, where tan has its pole."""
    *before, last = controller.layers
    bounded = {"tanh": 1.0, "sigmoid": 1.0}
    weights, bias = np.abs(last.weights.astype(float)), np.abs(last.biases.astype(float))
    most = bounded.get(last.activation, math.inf)
    if math.isinf(most) and before and before[-1].activation in bounded:
        most = float(np.max(weights.sum(axis=1) + bias))
    if not most < math.pi / 2:
        raise BadInput(
            "controller: its steering is not bounded below 90 degrees by its last layers, so "
            "tan(steering) has no polynomial flow; end it with tanh and a factor below pi / 2"
        )
