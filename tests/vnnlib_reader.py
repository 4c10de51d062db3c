"""An independent small reader of VNN-LIB 1.0 and 2.0: exact numbers, and what the text means."""

import re
from fractions import Fraction
from pathlib import Path

TOKEN = re.compile(r"[()]|[^\s()]+")
NUMBER = re.compile(r"-?\d+\.\d+")
NAMES = (re.compile(r"([XY])_(\d+)"), re.compile(r"([XY])\[0,(\d+)\]"))


class Read:
    """inputs, outputs: how many are declared; assertions: nested lists; numbers: as printed.

    Numbers are taken in plain decimals only; anything else fails where it is used.
    """

    def __init__(self, text):
        if isinstance(text, Path):
            text = text.read_text()
        lines = [line for line in text.splitlines() if not line.startswith(";")]
        tokens = TOKEN.findall("\n".join(lines))
        forms = []
        while tokens:
            forms.append(_form(tokens))
        self.assertions = [form[1] for form in forms if form[0] == "assert"]
        self.inputs, self.outputs = _declared(forms)
        self.numbers = [x for x in _leaves(self.assertions) if re.match(r"-?[.\d]", x)]

    def holds(self, x, y):
        """Whether all assertions hold for exact input and output values."""
        values = {"X": x, "Y": y}
        return all(_true(assertion, values) for assertion in self.assertions)

    def boxes(self):
        """The input boxes as lists of (lower, upper), without regard to the outputs.

        Each disjunct that bounds an input is one; the others' bounds come from above.
        """
        shared = [a for a in self.assertions if a[0] in ("<=", ">=")]
        cases = [[]]
        for assertion in self.assertions:
            if assertion[0] == "or" and any("X" in x for x in _leaves([assertion])):
                cases = [case[1:] for case in assertion[1:]]
        found = []
        for case in cases:
            bounds = [[None, None] for _ in range(self.inputs)]
            for relation, name, number in shared + case:
                tensor, index = _element(name)
                if tensor == "X":
                    side = 0 if relation == ">=" else 1
                    assert bounds[index][side] is None, "a bound is given twice"
                    bounds[index][side] = Fraction(number)
            assert all(None not in pair for pair in bounds)
            if bounds not in found:
                found.append(bounds)
        return found


def _form(tokens):
    token = tokens.pop(0)
    if token != "(":
        return token
    form = []
    while tokens[0] != ")":
        form.append(_form(tokens))
    tokens.pop(0)
    return form


def _declared(forms):
    names = [form[1] for form in forms if form[0] == "declare-const"]
    if names:
        assert all(form[2] == "Real" for form in forms if form[0] == "declare-const")
        return tuple(sum(name.startswith(x) for name in names) for x in "XY")
    assert forms[0] == ["vnnlib-version", "<2.0>"]
    network = next(form for form in forms if form[0] == "declare-network")
    sizes = {}
    for kind, name, dtype, shape in network[2:]:
        assert dtype == "float32"
        sizes[kind, name] = int(re.fullmatch(r"\[1,(\d+)\]", shape)[1])
    return sizes["declare-input", "X"], sizes["declare-output", "Y"]


def _element(name):
    match = next(m for m in (pattern.fullmatch(name) for pattern in NAMES) if m)
    return match[1], int(match[2])


def _true(form, values):
    head = form[0]
    if head in ("and", "or"):
        assert len(form) > 1
        return (all if head == "and" else any)(_true(part, values) for part in form[1:])
    left, right = (_value(part, values) for part in form[1:])
    return {"<=": left <= right, ">=": left >= right}[head]


def _value(part, values):
    if NUMBER.fullmatch(part):
        return Fraction(part)
    tensor, index = _element(part)
    return Fraction(values[tensor][index])


def _leaves(form):
    for part in form:
        if isinstance(part, list):
            yield from _leaves(part)
        else:
            yield part
