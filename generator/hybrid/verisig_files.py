"""Verisig's dictionaries: an automaton as plant and glue, pickled or as JSON."""

from __future__ import annotations

import io
import pickle
from typing import Any

from generator.hybrid.automaton import (
    CLOCK,
    SPARE_TIME,
    Assignment,
    Automaton,
    Constraint,
    Jump,
)
from generator.hybrid.expression import (
    ZERO,
    Call,
    Constant,
    Expression,
    Quotient,
    Variable,
    renamed,
)
from generator.hybrid.text import infix, number
from generator.hybrid.verisig import NETWORK

#: Verisig's names for variables whose first letters or whole names it looks at.
_NAMES = {"s": "y1", "f": "y2", "v": "y3", "theta": "y4", CLOCK: "clock"}
#: Verisig numbers its modes from the network's on: m0, DNNm1, then the plant's.
_BEFORE_PLANT = 1


class VerisigFiles:
    """The dictionaries of an automaton from ``verisig_automaton``.

    plant, glue: what Verisig unpickles.
    """

    def __init__(self, automaton: Automaton) -> None:
        self.automaton = automaton
        self.names = [_NAMES.get(x.name, x.name) for x in automaton.variables]
        modes = [m for m in automaton.modes if m.name != NETWORK]
        drives = [m for m in modes if _is_drive(m.name)]
        begin = [m for m in modes if m.name == automaton.initial_mode]
        rest = [m for m in modes if m not in (*drives[:1], *begin)]
        self.places = {m.name: i for i, m in enumerate([*drives[:1], *begin, *rest], start=1)}
        self.modes = {m.name: m for m in modes}
        self.labels = {name: self._label(name) for name in self.places}
        self.plant = {i: self._mode(name) for name, i in self.places.items()}
        self.glue = self._glue()

    def _label(self, name: str) -> str:
        if _is_drive(name):
            return "_cont_"
        # The name says it for every jump into the mode, so all of them must ask for the same.
        kinds = {
            "".join(self._special(assignment) for assignment in jump.reset)
            for jump in self.automaton.jumps
            if jump.target == name
        }
        if len(kinds) > 1:
            raise ValueError(f"jumps into mode {name} compute different things")
        return kinds.pop() if kinds else ""

    def _special(self, assignment: Assignment) -> str:
        """Return the mode name that stands for an assignment, or nothing if it is polynomial."""
        match assignment.expression:
            case Quotient(Constant(1.0), Variable(argument)):
                kind = "div"
            case Call("cos" | "sin" as kind, Variable(argument)):
                pass
            case _:
                return ""
        order = [x.name for x in self.automaton.variables]
        return f"_{kind}_{order.index(assignment.variable)}_{order.index(argument)}_"

    def _mode(self, name: str) -> dict[str, Any]:
        mode = self.modes[name]
        drive = self.labels[name] == "_cont_"
        return {
            "name": self.labels[name],
            "states": [x for x in self.names if x != "clock"],
            "odetype": "nonpoly ode" if drive else "lti ode",
            "dynamics": {
                ours: f"{ours}' = {self._text(mode.flow.get(x.name, ZERO))}\n"
                for ours, x in zip(self.names, self.automaton.variables, strict=True)
                # Verisig itself adds the line of the clock.
                if ours != "clock"
            },
            "invariants": [f"clock <= {number(mode.dwell)}"],
            "transitions": self._transitions(name),
        }

    def _transitions(self, name: str) -> dict[tuple[int, int], dict[str, list[str]]]:
        found: dict[tuple[int, int], dict[str, list[str]]] = {}
        for jump in self.automaton.jumps:
            if jump.source != name or jump.target == NETWORK:
                continue
            _add(found.setdefault((self.places[name], self.places[jump.target]), {}), self, jump)
        return found

    def _glue(self) -> dict[str, dict[int, dict[str, list[str]]]]:
        into: dict[int, dict[str, list[str]]] = {}
        out: dict[int, dict[str, list[str]]] = {}
        for jump in self.automaton.jumps:
            if jump.target == NETWORK:
                _add(into.setdefault(self.places[jump.source], {}), self, jump)
            if jump.source == NETWORK:
                _add(out.setdefault(self.places[jump.target], {}), self, jump)
        return {"plant2dnn": into, "dnn2plant": out}

    def guards(self, jump: Jump) -> list[str]:
        """Return the guard of a jump as text."""
        return [self._constraint(c) for c in jump.guard]

    def resets(self, jump: Jump) -> list[str]:
        """Return the polynomial resets of a jump as text; the others are in a mode's name."""
        return [
            f"{_NAMES.get(a.variable, a.variable)}' := {self._text(a.expression)}"
            for a in jump.reset
            if not self._special(a)
        ]

    def _constraint(self, c: Constraint) -> str:
        relation = {"==": "="}.get(c.closed_relation, c.closed_relation)
        return f"{self._text(c.expression)} {relation} {number(c.bound)}"

    def _text(self, expression: Expression) -> str:
        return infix(renamed(expression, _NAMES))

    def problem(self, a: Automaton) -> dict[str, Any]:
        """Return start box, unsafe sets and settings, as text for the model Verisig composes.

        a: this automaton, or one that differs in the start box; each unsafe set is a run of its
        own.
        """
        full = {n: f"{self.labels[n]}m{i + _BEFORE_PLANT}" for n, i in self.places.items()}
        blocks = []
        for unsafe in a.unsafe:
            rows = dict.fromkeys(["m0", "DNNm1", *full.values()], "clock <= -1.0")
            rows[full[unsafe.mode]] = " ".join(map(self._constraint, unsafe.constraints))
            text = "".join(f"\t{mode}\n\t{{\n\t\t{row}\n\t}}\n" for mode, row in rows.items())
            blocks.append(f"unsafe\n{{\n{text}}}")
        return {
            "id": a.name,
            "description": a.description,
            "initial_mode": full[a.initial_mode],
            "initial": [
                f"{ours} in [{number(low)}, {number(high)}]"
                for ours, (low, high) in zip(self.names, a.initial.values(), strict=True)
                if ours != "clock"
            ],
            "unsafe": blocks,
            "time": a.duration + SPARE_TIME,
            "max_jumps": a.longest + 1,
        }


def _is_drive(name: str) -> bool:
    return name.split("_", maxsplit=1)[0] == "drive"


def _add(ways: dict[str, list[str]], files: VerisigFiles, jump: Jump) -> None:
    """Add a jump under the next free number: reset1, guards1, reset2, ..."""
    count = len(ways) // 2 + 1
    ways[f"reset{count}"] = files.resets(jump)
    ways[f"guards{count}"] = files.guards(jump)


def pickled(data: Any) -> bytes:
    """Return data pickled with protocol 2; the same data give the same bytes."""
    # Without its memo a pickler writes equal texts in one way, whether or not they are one object.
    buffer = io.BytesIO()
    pickler = pickle.Pickler(buffer, protocol=2)
    pickler.fast = True
    pickler.dump(data)
    return buffer.getvalue()


def plain(data: Any) -> Any:
    """Return data for JSON: the keys (from, to) of transitions become "from -> to"."""
    if isinstance(data, dict):
        return {_key(key): plain(value) for key, value in data.items()}
    if isinstance(data, list):
        return [plain(value) for value in data]
    return data


def _key(key: Any) -> str:
    return " -> ".join(map(str, key)) if isinstance(key, tuple) else str(key)
