"""A polynomial automaton as a model file of Flow* 2.1 (https://flowstar.org).

What the language asks for, and how it is met: a mode may stand only once under ``unsafe``, so
the unsafe set is one mode of its own (see generator.hybrid.automaton.with_crash_mode), and
every other mode is listed with a condition that never holds, because an unlisted one would
count as unsafe. Relations are not strict: at the boundary of a guard both jumps are open.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from generator.hybrid.automaton import (
    CLOCK,
    SPARE_TIME,
    Assignment,
    Automaton,
    Constraint,
    Jump,
    Mode,
    with_crash_mode,
)
from generator.hybrid.document import Document
from generator.hybrid.text import infix, number
from racecar.errors import BadInput

#: Words of the language; no variable or mode may have one as its name.
_RESERVED = """
adaptive computation continuous cos cutoff end exp false fixed flowpipes gnuplot grid guard hybrid
identity in init interval inv jumps linear log lti ltv matlab max min mode modes nonpoly
nonpolynomial octagon ode order orders output par parallelotope paths plot poly precision print
reachability remainder reset setting sin sqrt start state step steps taylor time tm true uncertain
univariate unsafe var visualize
"""
RESERVED = frozenset(_RESERVED.split())


@dataclass(frozen=True)
class Settings:
    """How Flow* computes; the authors of a tool change them as they like.

    least_step, step: of the flowpipe, seconds, in every mode; order: of the Taylor models;
    remainder: first guess of their remainders; cutoff: smaller terms go to the remainder;
    precision: bits.
    """

    least_step: float = 0.001
    step: float = 0.1
    order: int = 4
    remainder: float = 1e-4
    cutoff: float = 1e-10
    precision: int = 100


def flowstar_model(automaton: Automaton, settings: Settings | None = None) -> Document:
    """Return the model.

    Raises BadInput, when its body is made, if the automaton is not polynomial or uses a reserved
    name.
    """
    crashing = with_crash_mode(automaton)
    count = len(automaton.jumps)
    return Document(
        f"# {automaton.name}\n# {automaton.description}\n",
        _body(crashing, crashing.jumps[:count], settings or Settings()),
        "".join(map(_jump, crashing.jumps[count:]))
        + f"  }}\n{_initial(automaton)}}}\n{_unsafe(crashing)}",
    )


def _body(automaton: Automaton, jumps: Iterable[Jump], settings: Settings) -> Iterator[str]:
    if not automaton.polynomial:
        raise BadInput(f"{automaton.name}: a Flow* model must be polynomial")
    names = [x.name for x in automaton.variables] + [mode.name for mode in automaton.modes]
    if reserved := sorted(RESERVED.intersection(names)):
        raise BadInput(f"{automaton.name}: Flow* reserves the name {reserved[0]}")
    yield "hybrid reachability\n{\n"
    yield f"  state var {', '.join(x.name for x in automaton.variables)}\n\n"
    yield _setting(automaton, settings)
    yield "  modes\n  {\n"
    yield from map(_mode, automaton.modes)
    yield "  }\n  jumps\n  {\n"
    yield from map(_jump, jumps)


def _setting(automaton: Automaton, settings: Settings) -> str:
    lines = [
        f"adaptive steps {{ min {number(settings.least_step)}, max {number(settings.step)} }}",
        f"time {number(automaton.duration + SPARE_TIME)}",
        f"remainder estimation {number(settings.remainder)}",
        "identity precondition",
        "gnuplot interval s, f",
        f"fixed orders {settings.order}",
        f"cutoff {number(settings.cutoff)}",
        f"precision {settings.precision}",
        "output closedlap",
        f"max jumps {automaton.longest + 1}",
        "print on",
    ]
    return "  setting\n  {\n" + "".join(f"    {line}\n" for line in lines) + "  }\n\n"


def _mode(mode: Mode) -> str:
    flow = "".join(f"        {name}' = {infix(rate)}\n" for name, rate in mode.flow.items())
    invariant = "".join(f" {text}" for text in map(_constraint, mode.invariant))
    return (
        f"    # {mode.description}\n"
        f"    {mode.name}\n    {{\n      poly ode 1\n      {{\n{flow}      }}\n"
        f"      inv {{{invariant} }}\n    }}\n"
    )


def _jump(jump: Jump) -> str:
    guard = "".join(f" {text}" for text in map(_constraint, jump.guard))
    reset = "".join(f" {text}" for text in map(_assignment, jump.reset))
    return (
        f"    {jump.source} -> {jump.target}\n"
        f"    guard {{{guard} }}\n    reset {{{reset} }}\n    interval aggregation\n"
    )


def _constraint(constraint: Constraint) -> str:
    relation = {"==": "="}.get(constraint.closed_relation, constraint.closed_relation)
    return f"{infix(constraint.expression)} {relation} {number(constraint.bound)}"


def _assignment(assignment: Assignment) -> str:
    text = f"{assignment.variable}' := {infix(assignment.expression)}"
    if assignment.spread != (0.0, 0.0):
        text += f" + [{', '.join(map(number, assignment.spread))}]"
    return text


def _initial(automaton: Automaton) -> str:
    rows = "".join(
        f"      {name} in [{number(low)}, {number(high)}]\n"
        for name, (low, high) in automaton.initial.items()
    )
    return f"  init\n  {{\n    {automaton.initial_mode}\n    {{\n{rows}    }}\n  }}\n"


def _unsafe(automaton: Automaton) -> str:
    never = f"{CLOCK} <= -1.0"
    unsafe = {u.mode: " ".join(map(_constraint, u.constraints)) for u in automaton.unsafe}
    rows = [f"  {mode.name} {{ {unsafe.get(mode.name, never)} }}\n" for mode in automaton.modes]
    return "unsafe\n{\n" + "".join(rows) + "}\n"
