"""An automaton as JSON, with a JSON Schema (2020-12).

Expressions are nested objects with one key, the operator: ``{"add": [x, y]}``, ``{"sin": x}``,
``{"dot": {"weights": [...], "terms": [...], "bias": b}}``; a number is itself and a variable its
name. Every number is the IEEE double nearest to what is printed.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from typing import Any

from generator.hybrid.automaton import (
    Assignment,
    Automaton,
    Constraint,
    Jump,
    Mode,
    StateVariable,
)
from generator.hybrid.document import Document
from generator.hybrid.expression import (
    FUNCTIONS,
    Call,
    Constant,
    Difference,
    Dot,
    Expression,
    Negative,
    Power,
    Product,
    Quotient,
    Sum,
    Variable,
)

FORMAT, VERSION = "closedlap-automaton", "1.0"
_PAIRS: dict[type[Expression], str] = {
    Sum: "add",
    Difference: "subtract",
    Product: "multiply",
    Quotient: "divide",
}


def automaton_json(automaton: Automaton) -> Document:
    """Return the JSON text: one line for each variable, mode and jump."""
    head = {
        "format": FORMAT,
        "version": VERSION,
        "id": automaton.name,
        "description": automaton.description,
        "initial_mode": automaton.initial_mode,
    }
    rows = [f"  {_line(key)}: {_line(value)},\n" for key, value in head.items()]
    boxes = automaton.initial
    variables = [_variable(variable, boxes[variable.name]) for variable in automaton.variables]
    unsafe = _list("unsafe", _unsafe(automaton))
    return Document(
        "{\n" + "".join([*rows, *_list("variables", variables), *unsafe]), _body(automaton)
    )


def question_json(automaton: Automaton) -> Document:
    """Return, as JSON, what is asked of an automaton: ID, start box, unsafe set.

    In the place of what the file of another question says it makes the file of this one.
    """
    data = {
        "id": automaton.name,
        "description": automaton.description,
        "initial": {name: list(automaton.initial[name]) for name in (*"sfv", automaton.heading)},
        "unsafe": _unsafe(automaton),
    }
    return Document(_line(data) + "\n")


def _body(automaton: Automaton) -> Iterator[str]:
    yield from _list("modes", map(_mode, automaton.modes))
    yield from _list("jumps", map(_jump, automaton.jumps))
    bounds = {"duration": automaton.duration, "jumps": automaton.longest}
    yield f'  "longest_run": {_line(bounds)}\n}}\n'


def _line(value: Any) -> str:
    return json.dumps(value, allow_nan=False)


def _list(key: str, items: Iterable[dict[str, Any]]) -> Iterator[str]:
    yield f"  {_line(key)}: ["
    for i, item in enumerate(items):
        yield f"{',' if i else ''}\n    {_line(item)}"
    yield "\n  ],\n"


def _unsafe(automaton: Automaton) -> list[dict[str, Any]]:
    return [{"mode": u.mode, "constraints": _all(u.constraints)} for u in automaton.unsafe]


def _variable(variable: StateVariable, box: tuple[float, float]) -> dict[str, Any]:
    return {
        "name": variable.name,
        "description": variable.description,
        "unit": variable.unit,
        "initial": list(box),
    }


def _mode(mode: Mode) -> dict[str, Any]:
    return {
        "name": mode.name,
        "description": mode.description,
        "flow": {name: expression_data(rate) for name, rate in mode.flow.items()},
        "invariant": _all(mode.invariant),
    }


def _jump(jump: Jump) -> dict[str, Any]:
    return {
        "source": jump.source,
        "target": jump.target,
        "guard": _all(jump.guard),
        "reset": [_assignment(assignment) for assignment in jump.reset],
    }


def _all(constraints: Iterable[Constraint]) -> list[dict[str, Any]]:
    return [
        {"expression": expression_data(c.expression), "relation": c.relation, "bound": c.bound}
        for c in constraints
    ]


def _assignment(assignment: Assignment) -> dict[str, Any]:
    data = {"variable": assignment.variable, "value": expression_data(assignment.expression)}
    if assignment.spread != (0.0, 0.0):
        data["plus"] = list(assignment.spread)
    return data


def expression_data(expression: Expression) -> Any:
    """Return an expression as JSON data."""
    match expression:
        case Constant(value):
            return value
        case Variable(name):
            return name
        case Sum(a, b) | Difference(a, b) | Product(a, b) | Quotient(a, b):
            return {_PAIRS[type(expression)]: [expression_data(a), expression_data(b)]}
        case Negative(a):
            return {"negate": expression_data(a)}
        case Power(a, exponent):
            return {"power": [expression_data(a), exponent]}
        case Call(function, a):
            return {function: expression_data(a)}
        case Dot(weights, terms, bias):
            parts = [expression_data(term) for term in terms]
            return {"dot": {"weights": list(weights), "terms": parts, "bias": bias}}
    raise TypeError(f"unknown expression {type(expression).__name__}")


def automaton_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of automaton files."""
    name = {"type": "string", "pattern": "^[A-Za-z][A-Za-z0-9_]*$"}
    number = {"type": "number"}
    node = {"$ref": "#/$defs/expression"}
    range_ = {"type": "array", "items": number, "minItems": 2, "maxItems": 2}
    pair = {"type": "array", "items": node, "minItems": 2, "maxItems": 2}
    power = {
        "type": "array",
        "prefixItems": [node, {"type": "integer", "minimum": 2}],
        "minItems": 2,
        "maxItems": 2,
    }
    dot = _object(
        {
            "weights": {"type": "array", "items": number},
            "terms": {"type": "array", "items": node},
            "bias": number,
        }
    )
    operators = (
        dict.fromkeys(_PAIRS.values(), pair)
        | {"negate": node, "power": power, "dot": dot}
        | dict.fromkeys(FUNCTIONS, node)
    )
    constraint = _object(
        {
            "expression": node,
            "relation": {"enum": ["<=", "<", ">=", ">", "=="]},
            "bound": number,
        }
    )
    constraints = {"type": "array", "items": {"$ref": "#/$defs/constraint"}}
    text = {"type": "string"}
    assignment = _object({"variable": name, "value": node, "plus": range_}, optional=("plus",))
    mode = _object(
        {
            "name": name,
            "description": text,
            "flow": {"type": "object", "additionalProperties": node, "propertyNames": name},
            "invariant": constraints,
        }
    )
    variable = _object({"name": name, "description": text, "unit": text, "initial": range_})
    jump = _object(
        {
            "source": name,
            "target": name,
            "guard": constraints,
            "reset": {"type": "array", "items": assignment},
        }
    )
    longest = {"duration": number, "jumps": {"type": "integer", "minimum": 1}}
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "Hybrid automaton of a ClosedLap instance",
        "description": "Time passes in a mode while its invariant holds; a variable without a "
        "flow does not change. A jump may be taken when its guard holds; all resets happen at "
        "once from the old values, a variable without one keeps its value, and 'plus' adds any "
        "value of a range. Constraints of a list hold together; the sets of 'unsafe' are a "
        "union, each in one mode and at any time in it.",
        **_object(
            {
                "format": {"const": FORMAT},
                "version": {"const": VERSION},
                "id": text,
                "description": text,
                "variables": {"type": "array", "items": variable, "minItems": 1},
                "modes": {"type": "array", "items": mode, "minItems": 1},
                "jumps": {"type": "array", "items": jump},
                "initial_mode": name,
                "unsafe": {
                    "type": "array",
                    "items": _object({"mode": name, "constraints": constraints}),
                },
                "longest_run": _object(longest),
            }
        ),
        "$defs": {
            "expression": {
                "oneOf": [
                    number,
                    name,
                    {
                        "type": "object",
                        "properties": operators,
                        "additionalProperties": False,
                        "minProperties": 1,
                        "maxProperties": 1,
                    },
                ]
            },
            "constraint": constraint,
        },
    }


def _object(properties: dict[str, Any], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": [key for key in properties if key not in optional],
        "additionalProperties": False,
    }
