"""Read a VNN-LIB query: the flat dialect of version 1.0, and version 2.0 with one network.

Both state assertions alike: comparisons of sums, differences and products of numbers and
elements, joined by ``and`` and ``or``. What 2.0 has beyond that (several networks, hidden
tensors, other element types) is NotUnderstood.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from decimal import Decimal
from fractions import Fraction

from harness.query.sexpr import Form, parse_forms
from harness.query.terms import (
    And,
    Comparison,
    Element,
    Formula,
    Operation,
    Or,
    Query,
    Relation,
    Tensor,
    Term,
)
from racecar.errors import BadInput


class NotUnderstood(BadInput):
    """A query that is well formed but says what the harness cannot judge."""


_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d{1,3})?")
_LONGEST_NUMBER = 1200
_NAME_1 = re.compile(r"([XY])_(0|[1-9]\d{0,8})")
_INDEXED = re.compile(r"([^\s\[]+)[ \t]*\[([\d, \t]*)\]")
_DTYPES = ("float32", "float64", "real")


def read_query(text: str, where: str) -> Query:
    """Read a query of either version; BadInput says in which line something is wrong.

    where: how errors call the file. NotUnderstood for what VNN-LIB 2.0 allows beyond this reader.
    """
    forms = parse_forms(text, where)
    if not forms:
        raise BadInput(f"{where}: it holds no VNN-LIB")
    if _head(forms[0]) == "vnnlib-version":
        return _Reader(where).version_2(forms)
    return _Reader(where).version_1(forms)


def _head(form: Form) -> str:
    return form[0] if form and isinstance(form[0], str) else ""


class _Reader:
    def __init__(self, where: str) -> None:
        self._where = where
        self._tensors: list[Tensor] = []
        self._find: Callable[[str, int], Element | None] = lambda symbol, line: None
        self._known: dict[str, Term] = {}

    def version_1(self, forms: Sequence[Form]) -> Query:
        """``(declare-const X_0 Real)`` ..., then assertions."""
        sizes = {"X": 0, "Y": 0}
        for form in forms:
            if _head(form) != "declare-const":
                continue
            match = _NAME_1.fullmatch(str(form[1])) if _symbols(form, 3) else None
            if match is None or form[2] != "Real":
                raise self._bad(form, "it must read (declare-const X_0 Real), X or Y")
            if int(match[2]) != sizes[match[1]]:
                expected = f"{match[1]}_{sizes[match[1]]}"
                raise self._bad(form, f"{form[1]} is declared where {expected} must be")
            sizes[match[1]] += 1
        self._tensors = [
            Tensor("X", "real", (sizes["X"],), is_input=True),
            Tensor("Y", "real", (sizes["Y"],), is_input=False),
        ]

        def find(symbol: str, line: int) -> Element | None:
            match = _NAME_1.fullmatch(symbol)
            if match is None or int(match[2]) >= sizes[match[1]]:
                return None
            return Element("XY".index(match[1]), int(match[2]))

        self._find = find
        rest = [form for form in forms if _head(form) != "declare-const"]
        assertions = tuple(self._assertion(form) for form in rest)
        return self._query("1.0", assertions)

    def version_2(self, forms: Sequence[Form]) -> Query:
        """``(vnnlib-version <2.0>)``, ``(declare-network ...)``, then assertions."""
        version = "".join(map(str, forms[0][1:]))
        if not re.fullmatch(r"<2\.\d+>", version):
            raise NotUnderstood(f"{self._at(forms[0])}: version {version} is not known; use <2.0>")
        networks = [form for form in forms if _head(form) == "declare-network"]
        if len(networks) != 1 or networks[0] is not forms[1]:
            kind = NotUnderstood if len(networks) > 1 else BadInput
            place = networks[1] if len(networks) > 1 else forms[0]
            raise kind(f"{self._at(place)}: one network must be declared, first of all")
        declared = [self._tensor(part) for part in networks[0][2:]]
        self._tensors = sorted(declared, key=lambda tensor: not tensor.is_input)
        places = {tensor.name: place for place, tensor in enumerate(self._tensors)}
        if len(places) != len(self._tensors):
            raise self._bad(networks[0], "a name is declared twice")

        def find(symbol: str, line: int) -> Element | None:
            match = _INDEXED.fullmatch(symbol)
            if match is None or match[1] not in places:
                return None
            tensor = self._tensors[places[match[1]]]
            index = _row_major(whole_numbers(match[2]), tensor.shape)
            if index is None:
                raise BadInput(
                    f"{self._where}, line {line}: {symbol} is not in shape {list(tensor.shape)}"
                )
            return Element(places[match[1]], index)

        self._find = find
        assertions = tuple(_shared_tolerance(self._assertion(form)) for form in forms[2:])
        return self._query("2.0", assertions)

    def _tensor(self, form: str | Form) -> Tensor:
        if not isinstance(form, Form):
            raise NotUnderstood(f"{self._where}: {form[:40]!r} in declare-network")
        kind = _head(form)
        if kind not in ("declare-input", "declare-output"):
            raise NotUnderstood(f"{self._at(form)}: ({kind} ...) is not understood here")
        match = _INDEXED.fullmatch(str(form[2])) if _symbols(form, 3) else None
        if match is None:
            raise NotUnderstood(f"{self._at(form)}: it must read ({kind} NAME TYPE [SHAPE])")
        dtype, shape = match[1].lower(), whole_numbers(match[2])
        if dtype not in _DTYPES:
            raise NotUnderstood(f"{self._at(form)}: type {dtype} is none of {', '.join(_DTYPES)}")
        if shape is None or 0 in shape:
            raise self._bad(form, f"[{match[2]}] is not a shape")
        return Tensor(str(form[1]), dtype, shape, kind == "declare-input")

    def _query(self, version: str, assertions: tuple[Formula, ...]) -> Query:
        query = Query(version, tuple(self._tensors), assertions)
        if not all(any(t.size for t in side) for side in (query.inputs, query.outputs)):
            raise BadInput(f"{self._where}: it must declare inputs and outputs")
        if not assertions:
            raise BadInput(f"{self._where}: it asserts nothing")
        return query

    def _assertion(self, form: Form) -> Formula:
        if _head(form) != "assert" or len(form) != 2:
            raise self._bad(form, "it must read (assert ...)")
        return self._formula(form[1], form)

    def _formula(self, part: str | Form, within: Form) -> Formula:
        if not isinstance(part, Form):
            raise self._bad(within, f"{part[:40]!r} is not a condition")
        head = _head(part)
        if head in ("and", "or"):
            if len(part) == 1:
                raise self._bad(part, f"({head}) joins nothing")
            parts = tuple([self._formula(inner, part) for inner in part[1:]])
            return And(parts) if head == "and" else Or(parts)
        try:
            relation = Relation(head)
        except ValueError:
            raise self._bad(part, f"{head[:40]!r} is none of and, or, {_RELATIONS}") from None
        if len(part) != 3:
            raise self._bad(part, f"{head} compares two terms, not {len(part) - 1}")
        left, right = self._term(part[1], part), self._term(part[2], part)
        tensors = _tensors_in(left) | _tensors_in(right)
        on_inputs = all(self._tensors[place].is_input for place in tensors)
        return Comparison(relation, left, right, part.line, on_inputs, on_inputs and bool(tensors))

    def _term(self, part: str | Form, within: Form) -> Term:
        if isinstance(part, Form):
            head = _head(part)
            if head not in ("+", "-", "*") or len(part) == 1:
                raise self._bad(part, f"{head[:40]!r} is none of +, - and * with terms")
            return Operation(head, tuple([self._term(inner, part) for inner in part[1:]]))
        # The same numbers and elements occur again and again.
        term = self._known.get(part)
        if term is None:
            term = self._known[part] = self._symbol(part, within)
        return term

    def _symbol(self, symbol: str, within: Form) -> Term:
        element = self._find(symbol, within.line)
        if element is not None:
            return element
        if len(symbol) > _LONGEST_NUMBER or not _NUMBER.fullmatch(symbol):
            raise self._bad(within, f"{symbol[:40]!r} is neither a number nor declared")
        return Fraction(Decimal(symbol))

    def _at(self, form: Form) -> str:
        return f"{self._where}, line {form.line}"

    def _bad(self, form: Form, what: str) -> BadInput:
        return BadInput(f"{self._at(form)}: {what}")


_RELATIONS = ", ".join(Relation)


def _symbols(form: Form, count: int) -> bool:
    return len(form) == count and all(isinstance(part, str) for part in form)


def whole_numbers(text: str) -> tuple[int, ...] | None:
    """Return the numbers of an index or a shape; None if they are none."""
    if not text.strip():
        return ()
    parts = [part.strip() for part in text.split(",")]
    return tuple(map(int, parts)) if all(re.fullmatch(r"\d{1,9}", p) for p in parts) else None


def _row_major(index: tuple[int, ...] | None, shape: tuple[int, ...]) -> int | None:
    if index is None or len(index) != len(shape):
        return None
    place = 0
    for i, size in zip(index, shape, strict=True):
        if i >= size:
            return None
        place = place * size + i
    return place


def _tensors_in(term: Term) -> set[int]:
    if isinstance(term, Element):
        return {term.tensor}
    if isinstance(term, Operation):
        return set().union(*[_tensors_in(part) for part in term.terms])
    return set()


def _shared_tolerance(assertion: Formula) -> Formula:
    """Give all of an assertion the tolerance, or none of it, as VNN-COMP does for 2.0.

    It is for assertions that are about inputs and about nothing else.
    """
    found = list(comparisons(assertion))
    tolerant = all(c.on_inputs for c in found) and any(c.tolerant for c in found)
    return _with_tolerance(assertion, tolerant)


def _with_tolerance(formula: Formula, tolerant: bool) -> Formula:
    if isinstance(formula, Comparison):
        return replace(formula, tolerant=tolerant)
    return type(formula)(tuple([_with_tolerance(part, tolerant) for part in formula.parts]))


def comparisons(formula: Formula) -> Iterator[Comparison]:
    """Yield all comparisons of a formula."""
    if isinstance(formula, Comparison):
        yield formula
    else:
        for part in formula.parts:
            yield from comparisons(part)
