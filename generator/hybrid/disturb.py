"""Noise and missing rays in a hybrid automaton: any value, any choice that the instance allows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from generator.hybrid.automaton import Assignment, Constraint, Jump, Mode, StateVariable
from generator.hybrid.expression import Expression, Variable, constant
from generator.hybrid.steps import Branch, Step, decide
from racecar.disturbance import Disturbance
from racecar.errors import BadInput
from racecar.faults import TURN_LEAD
from racecar.instance import Instance

#: How many rays are missing: at the control instant, or in the run.
GONE = Variable("gone")
#: 1 where the car is in the turn at the control instant, else 0.
IN_TURN = Variable("turn")


@dataclass(frozen=True)
class Spoil:
    """A disturbance of so many rays; reach: the LiDAR's range (m); width: of the halls (m)."""

    data: Disturbance
    rays: int
    reach: float
    width: float

    @property
    def for_run(self) -> bool:
        """Whether the missing rays are chosen once."""
        return self.data.missing > 0 and self.data.choice == "run"

    @property
    def each_step(self) -> bool:
        """Whether the missing rays are chosen anew at every control instant."""
        return self.data.missing > 0 and self.data.choice == "step"

    @property
    def asks_turn(self) -> bool:
        """Whether it matters that the car is in the turn."""
        return self.data.missing > 0 and self.data.turn_only

    def flag(self, ray: int) -> Variable:
        """Return the variable that is 1 if ray ``ray`` (from 1) is missing in this run."""
        return Variable(f"m{ray}")

    def ask_turn(self, mode: Mode, target: str, s: Expression, f: Expression) -> Iterator[Jump]:
        """Yield the jumps that write down whether the car is in the turn."""
        atoms = [
            Constraint(s, ">", 0.0),
            Constraint(s, "<", self.width),
            Constraint(f - self.width, "<=", TURN_LEAD),
        ]
        one, zero = (Assignment(IN_TURN.name, constant(x)) for x in (1.0, 0.0))
        yield from decide(mode, atoms, target, [one], [zero])

    def reset_count(self) -> list[Assignment]:
        """Return the resets with which a scan begins."""
        return [Assignment(GONE.name, constant(0.0))] if self.each_step else []

    @property
    def some_left(self) -> Constraint:
        """One more ray may be missing."""
        return Constraint(GONE, "<=", self.data.missing - 0.5)


def refuse_mirrors(instance: Instance) -> None:
    """Raise BadInput if a wall of the instance may mirror: no automaton says that."""
    if instance.disturbance is not None and instance.disturbance.mirrors is not None:
        raise BadInput(
            f"{instance.id}: the hybrid automaton does not know walls that mirror; "
            "use the instance's own JSON"
        )


def disturbance_variables(spoil: Spoil) -> list[StateVariable]:
    """Return the variables that a disturbance needs."""
    found = []
    if spoil.data.missing:
        found.append(StateVariable(GONE.name, "missing rays so far"))
    if spoil.asks_turn:
        found.append(StateVariable(IN_TURN.name, "1 if the car is in the turn, else 0"))
    if spoil.for_run:
        found += [
            StateVariable(spoil.flag(i).name, f"1 if ray {i} is missing in this run, else 0")
            for i in range(1, spoil.rays + 1)
        ]
    return found


def start_disturbance(spoil: Spoil) -> list[Step]:
    """Return the steps that choose the rays that are missing for the whole run."""
    if not spoil.for_run:
        return []
    steps = [Step(Mode("choose", "which rays are missing?"))]
    for ray in range(1, spoil.rays + 1):
        missing = (
            Assignment(spoil.flag(ray).name, constant(1.0)),
            Assignment(GONE.name, GONE + 1.0),
        )
        branches: tuple[Branch, ...] = (((), ()), ((spoil.some_left,), missing))
        steps.append(Step(Mode(f"choose_{ray}", f"is ray {ray} missing?"), (), branches))
    return steps


def spoiled(spoil: Spoil, registers: Sequence[str], readings: Sequence[Expression]) -> list[Step]:
    """Return the steps that disturb the readings and leave them in the registers.

    Noise first, then the clip to [0, range], then missing rays.
    """
    noise = spoil.data.noise
    write = tuple(
        Assignment(name, reading, (-noise, noise))
        for name, reading in zip(registers, readings, strict=True)
        if noise or reading != Variable(name)
    )
    steps = [Step(Mode("disturb", "readings are noisy"), write)]
    for ray, name in enumerate(registers, start=1):
        mode = Mode(f"disturb_{ray}", f"is ray {ray} missing? clip it")
        branches = (*_missing(spoil, ray, name), *_present(spoil, ray, name))
        steps.append(Step(mode, (), branches))
    return [*steps, Step(Mode("disturbed", "readings are as the controller gets them"))]


def _missing(spoil: Spoil, ray: int, register: str) -> Iterator[Branch]:
    if not spoil.data.missing:
        return
    active = (Constraint(IN_TURN, ">=", 0.5),) if spoil.asks_turn else ()
    read = Assignment(register, constant(spoil.reach))
    if spoil.for_run:
        yield (Constraint(spoil.flag(ray), ">=", 0.5), *active), (read,)
    else:
        yield (*active, spoil.some_left), (read, Assignment(GONE.name, GONE + 1.0))


def _present(spoil: Spoil, ray: int, register: str) -> Iterator[Branch]:
    for guard in _not_missing(spoil, ray):
        for clip, reset in _clip(spoil, register):
            yield (*guard, *clip), reset


def _not_missing(spoil: Spoil, ray: int) -> Iterator[tuple[Constraint, ...]]:
    if not spoil.for_run:
        yield ()
        return
    flag = Constraint(spoil.flag(ray), ">=", 0.5)
    yield (flag.negated(),)
    if spoil.asks_turn:
        yield flag, Constraint(IN_TURN, "<", 0.5)


def _clip(spoil: Spoil, register: str) -> Iterator[Branch]:
    if not spoil.data.noise:
        yield (), ()
        return
    value = Variable(register)
    low, high = Constraint(value, "<", 0.0), Constraint(value, ">", spoil.reach)
    yield (low,), (Assignment(register, constant(0.0)),)
    yield (low.negated(), high.negated()), ()
    yield (high,), (Assignment(register, constant(spoil.reach)),)
