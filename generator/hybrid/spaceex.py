"""An automaton as a SpaceEx model: XML and configuration.

Every location states the derivative of every variable, because SpaceEx lets one that is left
out change freely. ``forbidden`` is a union, so all unsafe sets stand in one file. A reset to a
range is a range of constants in SpaceEx; noise on a reading therefore becomes a variable of its own
that jumps into the range first and is added then.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from xml.sax.saxutils import escape

from generator.hybrid.automaton import (
    CLOCK,
    SPARE_TIME,
    TICK,
    Assignment,
    Automaton,
    Constraint,
    Jump,
    Mode,
    StateVariable,
)
from generator.hybrid.document import Document
from generator.hybrid.expression import ZERO, Call, Variable, constant, walk
from generator.hybrid.text import infix, number
from racecar.errors import BadInput

#: Functions that SpaceEx files may call, as Hyst reads them.
_KNOWN = frozenset({"sin", "cos", "tan", "exp", "sqrt", "ln"})
_AND = " &\n"
COMPONENT, SYSTEM = "closedlap", "system"


def spaceex_xml(automaton: Automaton) -> Document:
    """Return the XML file.

    Raises BadInput, when its body is made, if the automaton calls a function that SpaceEx lacks.
    """
    head = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f"<!-- {_comment(automaton.name)}: {_comment(automaton.description)} -->\n"
    )
    return Document(head, _body(automaton))


def _body(automaton: Automaton) -> Iterator[str]:
    automaton = ranges_apart(automaton)
    calls = {n.function for e in automaton.expressions() for n in walk(e) if isinstance(n, Call)}
    if strange := sorted(calls - _KNOWN):
        raise BadInput(f"{automaton.name}: SpaceEx has no function {strange[0]}")
    places = {mode.name: i for i, mode in enumerate(automaton.modes, start=1)}
    names = [variable.name for variable in automaton.variables]
    yield (
        '<sspaceex xmlns="http://www-verimag.imag.fr/xml-namespaces/sspaceex" '
        'version="0.2" math="SpaceEx">\n'
    )
    yield f'  <component id="{COMPONENT}">\n'
    yield from (_parameter(name, "") for name in names)
    for mode in automaton.modes:
        yield _location(mode, places[mode.name], names)
    for jump in automaton.jumps:
        yield _transition(jump, places)
    yield "  </component>\n"
    yield f'  <component id="{SYSTEM}">\n'
    yield from (_parameter(name, ' controlled="true"') for name in names)
    yield f'    <bind component="{COMPONENT}" as="{COMPONENT}_1">\n'
    yield from (f'      <map key="{name}">{name}</map>\n' for name in names)
    yield "    </bind>\n  </component>\n</sspaceex>\n"


def spaceex_cfg(automaton: Automaton) -> Document:
    """Return the configuration: start states, forbidden states, settings."""
    automaton = ranges_apart(automaton)
    start = " & ".join(
        f"{name} == {number(low)}"
        if low == high
        else f"{name} >= {number(low)} & {name} <= {number(high)}"
        for name, (low, high) in automaton.initial.items()
    )
    forbidden = " | ".join(
        " & ".join([_at(u.mode), *map(_constraint, u.constraints)]) for u in automaton.unsafe
    )
    settings = {
        "system": SYSTEM,
        "initially": f'"{start} & {_at(automaton.initial_mode)}"',
        "forbidden": f'"{forbidden}"',
        "scenario": "supp",
        "directions": "box",
        "set-aggregation": "none",
        "sampling-time": "0.01",
        "time-horizon": number(automaton.duration + SPARE_TIME),
        "iter-max": str(automaton.longest),
        "output-variables": '"s, f"',
        "output-format": "GEN",
    }
    return Document("".join(f"{key} = {value}\n" for key, value in settings.items()))


def _comment(text: str) -> str:
    return escape(text.replace("--", "- -"))


def _at(mode: str) -> str:
    return f"loc({COMPONENT}_1)=={mode}"


def _parameter(name: str, extra: str) -> str:
    return (
        f'    <param name="{name}" type="real" local="false" d1="1" d2="1" '
        f'dynamics="any"{extra} />\n'
    )


def _location(mode: Mode, place: int, names: list[str]) -> str:
    flow = _AND.join(f"{name}' == {infix(mode.flow.get(name, ZERO))}" for name in names)
    invariant = ""
    if mode.invariant:
        text = _AND.join(map(_constraint, mode.invariant))
        invariant = f"      <invariant>{escape(text)}</invariant>\n"
    x, y = 100 + 400 * (place % 20), 100 + 300 * (place // 20)
    return (
        f"    <!-- {_comment(mode.description)} -->\n"
        f'    <location id="{place}" name="{mode.name}" x="{x}.0" y="{y}.0" '
        'width="300.0" height="200.0">\n'
        f"{invariant}      <flow>{escape(flow)}</flow>\n    </location>\n"
    )


def _transition(jump: Jump, places: dict[str, int]) -> str:
    guard = _AND.join(map(_constraint, jump.guard))
    reset = _AND.join(map(_assignment, jump.reset))
    return (
        f'    <transition source="{places[jump.source]}" target="{places[jump.target]}">\n'
        f"      <guard>{escape(guard)}</guard>\n"
        f"      <assignment>{escape(reset)}</assignment>\n"
        "    </transition>\n"
    )


def _constraint(constraint: Constraint) -> str:
    return f"{infix(constraint.expression)} {constraint.closed_relation} {number(constraint.bound)}"


def _assignment(assignment: Assignment) -> str:
    if assignment.spread != (0.0, 0.0):
        low, high = map(number, assignment.spread)
        return f"{assignment.variable} >= {low}{_AND}{assignment.variable} <= {high}"
    return f"{assignment.variable} := {infix(assignment.expression)}"


def ranges_apart(automaton: Automaton) -> Automaton:
    """Say the same with ranges only where a variable jumps into a range of constants."""
    modes, jumps = list(automaton.modes), []
    spread: dict[str, str] = {}
    for jump in automaton.jumps:
        ranged = [a for a in jump.reset if a.spread != (0.0, 0.0)]
        if not ranged:
            jumps.append(jump)
            continue
        middle = f"ranges_{len(modes)}"
        spread |= {f"e_{a.variable}": a.variable for a in ranged}
        restart = Assignment(CLOCK, constant(0.0))
        first = [replace(a, variable=f"e_{a.variable}", expression=ZERO) for a in ranged]
        second = [_exact(a) if a in ranged else a for a in jump.reset]
        jumps.append(Jump(jump.source, middle, jump.guard, (*first, restart)))
        over = Constraint(Variable(CLOCK), "==", 0.0)
        jumps.append(Jump(middle, jump.target, (over,), tuple(second)))
        modes.append(Mode(middle, "values in ranges have been chosen", TICK, 0.0))
    if not spread:
        return automaton
    extra = [StateVariable(e, f"what is added to {name}", "m") for e, name in spread.items()]
    return replace(
        automaton,
        variables=(*automaton.variables, *extra),
        modes=tuple(modes),
        jumps=tuple(jumps),
        initial=automaton.initial | dict.fromkeys(spread, (0.0, 0.0)),
        longest=2 * automaton.longest,
    )


def _exact(assignment: Assignment) -> Assignment:
    added = assignment.expression + Variable(f"e_{assignment.variable}")
    return Assignment(assignment.variable, added)
