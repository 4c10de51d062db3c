"""A hybrid automaton as plain data.

Meaning: time passes in a mode while its invariant holds, variables follow the mode's flow; a
jump may be taken when its guard holds, and then all variables are reset at once from their old
values. A jump is urgent only because an invariant ends: the variable CLOCK grows at rate 1 in
every mode, is 0 on entry, and an invariant ``CLOCK <= T`` with guards ``CLOCK == T`` makes a
mode last exactly T (with T = 0: no time at all).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

from generator.hybrid.expression import (
    Expression,
    Variable,
    constant,
    is_polynomial,
    names_in,
)

#: The variable that measures the time in a mode, seconds.
CLOCK = "clk"
#: Its flow.
TICK: dict[str, Expression] = {CLOCK: constant(1.0)}
#: Seconds that a tool may spend beyond the longest run. A run is over when its control periods are
#: counted, not when time is; tools add the small steps that they make in modes without duration.
SPARE_TIME = 1.0
#: The relations of constraints, each with the one that holds where it does not.
RELATIONS = {"<=": ">", ">": "<=", ">=": "<", "<": ">="}


@dataclass(frozen=True)
class Constraint:
    """``expression relation bound``; relation: one of ``<= < >= > ==``."""

    expression: Expression
    relation: str
    bound: float = 0.0

    def negated(self) -> Constraint:
        """Return the constraint that holds exactly where this one does not (not for ==)."""
        return Constraint(self.expression, RELATIONS[self.relation], self.bound)

    @property
    def closed_relation(self) -> str:
        """The relation with its boundary, for languages without strict ones."""
        return {"<": "<=", ">": ">="}.get(self.relation, self.relation)


@dataclass(frozen=True)
class Assignment:
    """``variable := expression + [spread]``: any value of the interval may be taken."""

    variable: str
    expression: Expression
    spread: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True)
class StateVariable:
    """A variable, what it means, and its unit ("1" if it has none)."""

    name: str
    description: str
    unit: str = "1"


@dataclass(frozen=True)
class Mode:
    """A mode; a variable without a flow does not change.

    flow: time derivatives by variable; dwell: how long the mode lasts, seconds. The invariant
    follows: ``CLOCK <= dwell``. A mode from which no jump leads ends the run.
    """

    name: str
    description: str
    flow: dict[str, Expression] = field(default_factory=dict)
    dwell: float = 0.0

    @property
    def invariant(self) -> tuple[Constraint, ...]:
        """The invariant, a conjunction."""
        return (Constraint(Variable(CLOCK), "<=", self.dwell),)


@dataclass(frozen=True)
class Jump:
    """A jump: guard is a conjunction; a variable without an assignment keeps its value."""

    source: str
    target: str
    guard: tuple[Constraint, ...]
    reset: tuple[Assignment, ...]


@dataclass(frozen=True)
class Unsafe:
    """An unsafe set in one mode: a conjunction, at any time in the mode."""

    mode: str
    constraints: tuple[Constraint, ...]


@dataclass(frozen=True)
class Automaton:
    """The closed loop of one instance.

    name, description: of the instance; initial_mode, initial: the only start mode, and a box of
    start values of every variable; heading: the variable in which the start heading is; unsafe:
    a union; duration: seconds in all modes that the longest run takes; longest: how many jumps
    it takes.
    """

    name: str
    description: str
    variables: tuple[StateVariable, ...]
    modes: tuple[Mode, ...]
    jumps: tuple[Jump, ...]
    initial_mode: str
    initial: dict[str, tuple[float, float]]
    heading: str
    unsafe: tuple[Unsafe, ...]
    duration: float
    longest: int

    def expressions(self) -> Iterator[Expression]:
        """Yield every expression of flows, guards, resets and unsafe sets."""
        for mode in self.modes:
            yield from mode.flow.values()
        for jump in self.jumps:
            yield from (constraint.expression for constraint in jump.guard)
            yield from (assignment.expression for assignment in jump.reset)
        for unsafe in self.unsafe:
            yield from (constraint.expression for constraint in unsafe.constraints)

    @property
    def polynomial(self) -> bool:
        """Whether it uses only + - * and powers."""
        return all(is_polynomial(expression) for expression in self.expressions())

    def jumps_from(self) -> dict[str, list[Jump]]:
        """Return the jumps by source, in order."""
        found: dict[str, list[Jump]] = {mode.name: [] for mode in self.modes}
        for jump in self.jumps:
            found[jump.source].append(jump)
        return found


def checked(automaton: Automaton) -> Automaton:
    """Return an automaton as it is; ValueError if names are given twice or not at all."""
    names = [variable.name for variable in automaton.variables]
    known, modes = set(names), {mode.name for mode in automaton.modes}
    if len(known) != len(names) or len(modes) != len(automaton.modes):
        raise ValueError("two variables or two modes have one name")
    ends = {mode for jump in automaton.jumps for mode in (jump.source, jump.target)}
    ends |= {unsafe.mode for unsafe in automaton.unsafe}
    used = {automaton.heading}.union(*(names_in(e) for e in automaton.expressions()))
    used |= {a.variable for jump in automaton.jumps for a in jump.reset}
    used |= {name for mode in automaton.modes for name in mode.flow}
    strange = (used - known) | (ends - modes) | ({automaton.initial_mode} - modes)
    strange |= set(automaton.initial) ^ known
    if strange:
        raise ValueError(f"the automaton does not know {sorted(strange)}")
    for jump in automaton.jumps:
        if len({a.variable for a in jump.reset}) < len(jump.reset):
            raise ValueError(f"a jump from {jump.source} resets a variable twice")
    return automaton


def leave(
    mode: Mode,
    target: str,
    guard: Iterable[Constraint] = (),
    reset: Iterable[Assignment] = (),
) -> Jump:
    """Return a jump that is taken when the dwell of a mode is over; the clock starts anew."""
    over = Constraint(Variable(CLOCK), "==", mode.dwell)
    restart = Assignment(CLOCK, constant(0.0))
    return Jump(mode.name, target, (over, *guard), (*reset, restart))


#: Name of the sink in which every unsafe run ends, see with_crash_mode.
CRASH = "crash"


def with_crash_mode(automaton: Automaton) -> Automaton:
    """Say the unsafe set as one mode: a jump leads there from wherever the set is reached.

    For languages that take one unsafe conjunction per mode. Jumps may be taken at any time at
    which their guard holds, so CRASH can be reached exactly if the unsafe set can.
    """
    crash = Mode(CRASH, "the car has been in the unsafe set", TICK, 0.0)
    restart = Assignment(CLOCK, constant(0.0))
    jumps = tuple(Jump(u.mode, CRASH, u.constraints, (restart,)) for u in automaton.unsafe)
    return replace(
        automaton,
        modes=(*automaton.modes, crash),
        jumps=(*automaton.jumps, *jumps),
        unsafe=(Unsafe(CRASH, ()),),
        longest=automaton.longest + 1,
    )
