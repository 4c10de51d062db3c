"""Readers of the printed formats, written from the languages' grammars; no printer code in them.

Every reader returns the same plain structure, with expressions as Python source over ``v[name]``.
"""

import json
import re
import xml.etree.ElementTree as ET
from dataclasses import dataclass, field

#: Flow* 2.1's own number token: a minus in front of digits belongs to them.
FLOWSTAR_NUMBER = re.compile(r"-?(?:\d*\.\d*e(?:\+\d+|-?\d+)|\d+e-?\d+|\d*\.\d+|\d+\.\d*|\d+)")
_HYST_NUMBER = re.compile(r"(?:\d+(?:\.\d+)?|\.\d+)(?:[Ee][+|-]?\d+)?")
_NAME = re.compile(r"[A-Za-z_][A-Za-z_0-9]*")
_SIGN = re.compile(r":=|<=|>=|==|[-+*/^(){}\[\],'=<>&|]")


class Refused(Exception):
    """The text is not in the language."""


@dataclass
class Edge:
    source: str
    target: str
    guard: list  # (source text, relation, bound)
    reset: dict  # variable -> source text
    ranges: dict = field(default_factory=dict)  # variable -> (low, high), added


@dataclass
class Read:
    variables: list
    flows: dict  # mode -> {variable: source text}
    invariants: dict  # mode -> guard-like list
    edges: list
    initial_mode: str
    initial: dict
    unsafe: list  # (mode, guard-like list)
    text: dict = field(default_factory=dict)


def tokens(text, numbers=FLOWSTAR_NUMBER):
    """Split as a lexer does: at each place the longest match."""
    found, at = [], 0
    while at < len(text):
        if text[at].isspace():
            at += 1
        elif text[at] == "#":
            at = text.index("\n", at)
        else:
            options = [pattern.match(text, at) for pattern in (numbers, _NAME, _SIGN)]
            best = max((m for m in options if m), key=lambda m: m.end(), default=None)
            if best is None:
                raise Refused(f"unknown character {text[at]!r}")
            kind = ("number", "name", "sign")[options.index(best)]
            found.append((kind, best.group()))
            at = best.end()
    return found


class Parser:
    """Recursive descent; ``minus_first``: -x^2 means (-x)^2, as in Hyst's grammar."""

    def __init__(self, text, numbers=FLOWSTAR_NUMBER, minus_first=False, functions=()):
        self.tokens, self.at = tokens(text, numbers), 0
        self.minus_first, self.functions = minus_first, functions

    def peek(self, ahead=0):
        i = self.at + ahead
        return self.tokens[i][1] if i < len(self.tokens) else None

    def kind(self):
        return self.tokens[self.at][0] if self.at < len(self.tokens) else None

    def next(self):
        self.at += 1
        return self.tokens[self.at - 1][1]

    def expect(self, *words):
        for word in words:
            if self.peek() != word:
                raise Refused(f"expected {word!r}, found {self.peek()!r}")
            self.at += 1

    def name(self):
        if self.kind() != "name":
            raise Refused(f"expected a name, found {self.peek()!r}")
        return self.next()

    def number(self):
        sign = ""
        if self.peek() == "-" and self.minus_first:
            sign = self.next()
        if self.kind() != "number":
            raise Refused(f"expected a number, found {self.peek()!r}")
        return float(sign + self.next())

    def expression(self):
        left = self.term()
        while self.peek() in ("+", "-") and self.peek(1) != "[":
            sign = self.next()
            left = f"({left} {sign} {self.term()})"
        return left

    def term(self):
        left = self.unary()
        while self.peek() in ("*", "/"):
            sign = self.next()
            left = f"({left} {sign} {self.unary()})"
        return left

    def unary(self):
        if self.minus_first:
            base = self.signed()
            while self.peek() == "^":
                self.next()
                base = f"({base} ** {self.signed()})"
            return base
        if self.peek() == "-":
            self.next()
            return f"(-{self.unary()})"
        base = self.atom()
        while self.peek() == "^":
            self.next()
            base = f"({base} ** {int(self.number())})"
        return base

    def signed(self):
        if self.peek() == "-":
            self.next()
            return f"(-{self.signed()})"
        return self.atom()

    def atom(self):
        if self.peek() == "(":
            self.next()
            inner = self.expression()
            self.expect(")")
            return inner
        if self.kind() == "number":
            return f"({float(self.next())!r})"
        name = self.name()
        if self.peek() == "(":
            if name not in self.functions:
                raise Refused(f"unknown function {name}")
            self.next()
            inner = self.expression()
            self.expect(")")
            return f"{name}({inner})"
        return f"v[{name!r}]"

    def constraint(self):
        left = self.expression()
        relation = self.next()
        if relation not in ("<=", ">=", "=", "=="):
            raise Refused(f"unknown relation {relation!r}")
        return left, relation.replace("==", "="), self.number()

    def constraints(self):
        found = []
        self.expect("{")
        while self.peek() != "}":
            found.append(self.constraint())
        self.next()
        return found

    def end(self):
        if self.at != len(self.tokens):
            raise Refused(f"trailing {self.peek()!r}")


def read_expression(text, **options):
    parser = Parser(text, **options)
    found = parser.expression()
    parser.end()
    return found


def _modes(p):
    flows, invariants = {}, {}
    p.expect("modes", "{")
    while p.peek() != "}":
        mode = p.name()
        assert mode not in flows
        p.expect("{", "poly", "ode", "1", "{")
        flows[mode] = {}
        while p.peek() != "}":
            name = p.name()
            p.expect("'", "=")
            flows[mode][name] = p.expression()
        p.expect("}", "inv")
        invariants[mode] = p.constraints()
        p.expect("}")
    p.expect("}")
    return flows, invariants


def _range(p):
    p.expect("[")
    low = p.number()
    p.expect(",")
    high = p.number()
    p.expect("]")
    return low, high


def _jumps(p):
    edges = []
    p.expect("jumps", "{")
    while p.peek() != "}":
        source = p.name()
        p.expect("-", ">")
        edge = Edge(source, p.name(), [], {})
        p.expect("guard")
        edge.guard = p.constraints()
        p.expect("reset", "{")
        while p.peek() != "}":
            name = p.name()
            p.expect("'", ":=")
            edge.reset[name] = p.expression()
            if p.peek() == "+":
                p.expect("+")
                edge.ranges[name] = _range(p)
        p.expect("}", "interval", "aggregation")
        edges.append(edge)
    p.expect("}")
    return edges


def read_flowstar(text):
    p = Parser(text)
    p.expect("hybrid", "reachability", "{", "state", "var")
    variables = [p.name()]
    while p.peek() == ",":
        p.next()
        variables.append(p.name())
    p.expect("setting", "{")
    depth = 1
    while depth:
        depth += {"{": 1, "}": -1}.get(p.next(), 0)
    flows, invariants = _modes(p)
    edges = _jumps(p)
    p.expect("init", "{")
    mode, initial = p.name(), {}
    p.expect("{")
    while p.peek() != "}":
        name = p.name()
        p.expect("in")
        initial[name] = _range(p)
    p.expect("}", "}", "}", "unsafe", "{")
    unsafe = []
    while p.peek() != "}":
        unsafe.append((p.name(), p.constraints()))
    p.expect("}")
    p.end()
    return Read(variables, flows, invariants, edges, mode, initial, unsafe)


_HYST = {"numbers": _HYST_NUMBER, "minus_first": True, "functions": ("sin", "cos", "tan", "exp")}


def _conjunction(text):
    return [part for part in (text or "").split("&") if part.strip()]


def _hyst_constraint(text):
    parser = Parser(text, **_HYST)
    found = parser.constraint()
    parser.end()
    return found


def read_spaceex(xml, cfg):
    space = {"x": "http://www-verimag.imag.fr/xml-namespaces/sspaceex"}
    root = ET.fromstring(xml)
    component, system = root.findall("x:component", space)
    variables = [p.get("name") for p in component.findall("x:param", space)]
    binds = system.find("x:bind", space)
    assert binds.get("component") == component.get("id")
    maps = {m.get("key"): m.text for m in binds.findall("x:map", space)}
    assert maps == {name: name for name in variables}
    names, flows, invariants = {}, {}, {}
    for location in component.findall("x:location", space):
        name = names[location.get("id")] = location.get("name")
        flows[name] = {}
        for part in _conjunction(location.findtext("x:flow", None, space)):
            variable, rate = part.split("' ==")
            flows[name][variable.strip()] = read_expression(rate, **_HYST)
        parts = _conjunction(location.findtext("x:invariant", None, space))
        invariants[name] = [_hyst_constraint(part) for part in parts]
    edges = []
    for transition in component.findall("x:transition", space):
        guard = _conjunction(transition.findtext("x:guard", None, space))
        source, target = (names[transition.get(end)] for end in ("source", "target"))
        edge = Edge(source, target, [_hyst_constraint(part) for part in guard], {})
        for part in _conjunction(transition.findtext("x:assignment", None, space)):
            if ":=" in part:
                variable, value = part.split(":=")
                edge.reset[variable.strip()] = read_expression(value, **_HYST)
            else:
                variable, relation, bound = re.fullmatch(
                    r"\s*(\w+) (>=|<=) (\S+)\s*", part
                ).groups()
                low, high = edge.ranges.get(variable, (None, None))
                low, high = (float(bound), high) if relation == ">=" else (low, float(bound))
                edge.ranges[variable] = (low, high)
                edge.reset[variable] = "0.0"
        edges.append(edge)
    lines = dict(line.split(" = ", 1) for line in cfg.splitlines())
    initial, mode = {}, None
    for part in _conjunction(lines["initially"].strip('"')):
        if match := re.fullmatch(r"\s*loc\((\w+)_1\)==(\w+)\s*", part):
            assert match[1] == component.get("id")
            mode = match[2]
            continue
        name, relation, bound = re.fullmatch(r"\s*(\w+) (==|>=|<=) (\S+)\s*", part).groups()
        low, high = initial.get(name, (None, None))
        value = float(bound)
        initial[name] = (low if relation == "<=" else value, high if relation == ">=" else value)
    unsafe = []
    for side in lines["forbidden"].strip('"').split("|"):
        where, *parts = _conjunction(side)
        unsafe.append((where.split("==")[1].strip(), [_hyst_constraint(part) for part in parts]))
    return Read(variables, flows, invariants, edges, mode, initial, unsafe, lines)


def json_source(node):
    """Return the Python source of a JSON expression."""
    if isinstance(node, int | float):
        return f"({float(node)!r})"
    if isinstance(node, str):
        return f"v[{node!r}]"
    ((operator, operand),) = node.items()
    signs = {"add": "+", "subtract": "-", "multiply": "*", "divide": "/"}
    if operator in signs:
        left, right = map(json_source, operand)
        return f"({left} {signs[operator]} {right})"
    if operator == "power":
        return f"({json_source(operand[0])} ** {operand[1]})"
    if operator == "negate":
        return f"(-{json_source(operand)})"
    if operator == "dot":
        pairs = zip(operand["weights"], map(json_source, operand["terms"]), strict=True)
        return f"({' + '.join(f'{w!r} * {x}' for w, x in pairs)} + {operand['bias']!r})"
    return f"{operator}({json_source(operand)})"


def read_json(text):
    data = json.loads(text)

    def constraints(rows):
        return [
            (json_source(r["expression"]), r["relation"].replace("==", "="), r["bound"])
            for r in rows
        ]

    return Read(
        [x["name"] for x in data["variables"]],
        {m["name"]: {n: json_source(e) for n, e in m["flow"].items()} for m in data["modes"]},
        {m["name"]: constraints(m["invariant"]) for m in data["modes"]},
        [
            Edge(
                j["source"],
                j["target"],
                constraints(j["guard"]),
                {r["variable"]: json_source(r["value"]) for r in j["reset"]},
                {r["variable"]: tuple(r["plus"]) for r in j["reset"] if "plus" in r},
            )
            for j in data["jumps"]
        ],
        data["initial_mode"],
        {x["name"]: tuple(x["initial"]) for x in data["variables"]},
        [(u["mode"], constraints(u["constraints"])) for u in data["unsafe"]],
        data,
    )
