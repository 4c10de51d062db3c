"""The closed loop in the form that Verisig 2.0 reads: network, plant and glue.

Verisig composes a network (YAML) with a plant and a glue (dictionaries, pickled). Where the
plant needs more than polynomials, the name of a mode says what a jump into it computes from the
values before the jump: ``_div_2_5_`` sets variable 2 to 1 / variable 5, ``_cos_``, ``_sin_``
alike, with the index of a variable in ``states``, from 0. ``_cont_`` is the mode in which time
passes; the mode ``DNN``, which Verisig adds, replaces ``_f1`` by the network's output. First
letters matter: ``y1`` to ``y4`` are s, f, v and theta, ``_f1`` ... the readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from generator.hybrid.automaton import Assignment, Automaton, Mode, StateVariable
from generator.hybrid.build import build
from generator.hybrid.dialect import V
from generator.hybrid.disturb import refuse_mirrors
from generator.hybrid.expression import (
    Call,
    Expression,
    Quotient,
    Variable,
    constant,
    variables,
)
from generator.hybrid.fraction import DEN, NUM, FractionRays
from generator.hybrid.steps import Step
from generator.hybrid.text import number
from racecar.controller import Controller
from racecar.errors import BadInput
from racecar.instance import Instance

THETA, STEERING = Variable("theta"), Variable("u")
#: 1 / DEN.
INVERSE = Variable("q")
#: The network's mode: entered with readings in metres, left with its raw output.
NETWORK = "network"
_ACTIVATIONS = {"tanh": "Tanh", "sigmoid": "Sigmoid"}


def verisig_automaton(instance: Instance, controller: Controller) -> Automaton:
    """Return the plant and glue as an automaton with one mode in the place of the network.

    Raises BadInput for what Verisig cannot say: disturbances, and activations other than tanh
    and sigmoid before a last linear layer.
    """
    refuse_mirrors(instance)
    if instance.disturbance is not None:
        raise BadInput(
            f"{instance.id}: Verisig stops where several jumps are open; instances with noise or "
            "missing rays are not made for it, use flowstar, spaceex or json"
        )
    return build(instance, controller, _Verisig(instance, controller))


def split_network(controller: Controller) -> tuple[list[dict[str, Any]], float, float]:
    """Return the layers that Verisig runs, and factor and offset of a last linear layer."""
    *layers, last = controller.layers
    factor, offset = 1.0, 0.0
    if last.activation == "linear" and last.weights.shape == (1, 1) and layers:
        factor, offset = float(last.weights[0, 0]), float(last.biases[0])
    else:
        layers.append(last)
    found = []
    for i, layer in enumerate(layers, start=1):
        if layer.activation not in _ACTIVATIONS:
            raise BadInput(
                f"controller: Verisig runs layers with tanh or sigmoid; layer {i} has "
                f"{layer.activation}"
            )
        found.append(
            {
                "weights": layer.weights.tolist(),
                "offsets": layer.biases.tolist(),
                "activation": _ACTIVATIONS[layer.activation],
            }
        )
    return found, factor, offset


def network_yaml(controller: Controller) -> str:
    """Return the network: weights by layer as rows, offsets, activations.

    It reads distances in metres, as the ONNX file does.
    """
    layers, _, _ = split_network(controller)
    numbered = list(enumerate(layers, start=1))
    lines = ["activations:"]
    lines += [f"  {i}: {layer['activation']}" for i, layer in numbered]
    lines.append("offsets:")
    lines += [f"  {i}: {_row(layer['offsets'])}" for i, layer in numbered]
    lines.append("weights:")
    for i, layer in numbered:
        lines.append(f"  {i}:")
        lines += [f"  - {_row(row)}" for row in layer["weights"]]
    return "\n".join(lines) + "\n"


def _row(values: Sequence[float]) -> str:
    return f"[{', '.join(map(number, values))}]"


class _Verisig(FractionRays):
    def __init__(self, instance: Instance, controller: Controller) -> None:
        super().__init__(instance)
        self.inputs = [f"_f{i}" for i in range(1, controller.rays + 1)]
        _, self.factor, self.offset = split_network(controller)

    def variables(self) -> list[StateVariable]:
        return [
            StateVariable("theta", "heading, 0 along the hall, counter-clockwise", "rad"),
            StateVariable("u", "steering angle", "rad"),
            StateVariable("ct", "cosine of the heading"),
            StateVariable("st", "sine of the heading"),
            *self.ray_variables(),
            StateVariable("q", "1 / den"),
            *(StateVariable(f, f"reading of ray {i}", "m") for i, f in enumerate(self.inputs, 1)),
        ]

    def begin(self) -> dict[str, float]:
        return {}

    def heading(self) -> str:
        return "theta"

    def start(self) -> list[Step]:
        return []

    def prepare(self) -> list[Step]:
        return [
            Step(Mode("heading", "cosine and sine of the heading come next")),
            Step(Mode("cosine", "ct = cos(theta)"), (Assignment("ct", Call("cos", THETA)),)),
            Step(Mode("sine", "st = sin(theta)"), (Assignment("st", Call("sin", THETA)),)),
        ]

    def settle(self) -> list[Step]:
        inverse = Quotient(constant(1.0), DEN)
        return [
            Step(Mode("settle", "no face is left for the ray")),
            Step(Mode("divide", "q = 1 / den"), (Assignment("q", inverse),)),
        ]

    def keep(self, ray: int) -> list[Assignment]:
        return [Assignment(self.inputs[ray - 1], NUM * INVERSE)]

    def read(self) -> list[Step]:
        return []

    def readings(self) -> list[Expression]:
        return list(variables(self.inputs))

    def registers(self) -> list[str]:
        return self.inputs

    def network(self, inputs: Sequence[Expression]) -> list[Step]:
        del inputs
        return [Step(Mode(NETWORK, "the network runs"))]

    def enter_drive(self) -> list[Assignment]:
        return [Assignment("u", self.factor * Variable(self.inputs[0]) + self.offset)]

    def drive(self) -> dict[str, Expression]:
        car = self.plant.bicycle
        base = Call("cos", STEERING) * (constant(car.front) + car.rear)
        sine: Expression = Call("sin", THETA)
        cosine: Expression = Call("cos", THETA)
        turning: Expression = V
        if car.slip:
            # With m the tangent of the slip angle: its cosine is 1 / sqrt(1 + m^2).
            slope = Quotient(car.rear * Call("sin", STEERING), base)
            root = Call("sqrt", 1.0 + slope**2)
            sine, cosine = (sine + cosine * slope) / root, (cosine - sine * slope) / root
            turning = V / root
        return {
            "s": -(V * sine),
            "f": -(V * cosine),
            "v": car.acceleration * (car.motor * (constant(car.throttle) - car.hysteresis) - V),
            "theta": Quotient(turning * Call("sin", STEERING), base),
        }

    def turn(self, rotation: float) -> list[Assignment]:
        return [Assignment("theta", THETA + rotation)]
