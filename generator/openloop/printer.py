"""Printers of specifications: VNN-LIB 1.0 and 2.0.

Both print the same assertions; they differ in the header and in how elements are called. What
all boxes share is asserted once. The rest is one disjunction over boxes, and one over what the
outputs do; with a single output condition it stands in the boxes' disjunction, because some
readers of 1.0 take no disjunction that is about inputs alone.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from generator.openloop.numbers import plain
from generator.openloop.spec import Box, Conjunction, Spec

VERSIONS = ("1.0", "2.0")

#: Calls an element: (tensor "X" or "Y", index) -> name.
Name = Callable[[str, int], str]


def print_spec(spec: Spec, version: str) -> str:
    """Return the text of a specification in VNN-LIB "1.0" or "2.0"."""
    return {"1.0": _print_1, "2.0": _print_2}[version](spec)


def _print_1(spec: Spec) -> str:
    """The flat dialect that VNN-COMP has used since 2021."""

    def name(tensor: str, index: int) -> str:
        return f"{tensor}_{index}"

    declared = [
        f"(declare-const {name(tensor, i)} Real)"
        for tensor, count in (("X", spec.inputs), ("Y", spec.outputs))
        for i in range(count)
    ]
    return _text(spec, [*declared, ""], name)


def _print_2(spec: Spec) -> str:
    """The standard of 2025: one network, typed tensors with the shapes of the ONNX file."""

    def name(tensor: str, index: int) -> str:
        return f"{tensor}[0,{index}]"

    declared = [
        "(vnnlib-version <2.0>)",
        "",
        "(declare-network N",
        f"  (declare-input X float32 [1,{spec.inputs}])",
        f"  (declare-output Y float32 [1,{spec.outputs}])",
        ")",
        "",
    ]
    return _text(spec, declared, name)


def _text(spec: Spec, declared: list[str], name: Name) -> str:
    comments = [f"; {line}".rstrip() for line in spec.title]
    return "\n".join([*comments, *declared, *_assertions(spec, name)]) + "\n"


def _assertions(spec: Spec, name: Name) -> Iterator[str]:
    boxes = list(dict.fromkeys(tuple(_bounds(box, name)) for box in spec.boxes))
    common = set.intersection(*map(set, boxes))
    for bound in boxes[0]:
        if bound in common:
            yield f"(assert {bound})"
    outputs = [_condition(conjunction, name) for conjunction in spec.unsafe]
    # Two boxes that differ do so in bounds that neither shares with all: no case is empty.
    cases = [[bound for bound in box if bound not in common] for box in boxes]
    if len(boxes) == 1:
        yield from _disjunction(outputs)
    elif len(outputs) == 1:
        yield from _disjunction([case + outputs[0] for case in cases])
    else:
        yield from _disjunction(cases)
        yield from _disjunction(outputs)


def _bounds(box: Box, name: Name) -> Iterator[str]:
    for i, (low, high) in enumerate(zip(box.lower, box.upper, strict=True)):
        yield f"(>= {name('X', i)} {plain(low)})"
        yield f"(<= {name('X', i)} {plain(high)})"


def _condition(conjunction: Conjunction, name: Name) -> list[str]:
    return [f"({y.relation} {name('Y', y.index)} {plain(y.bound)})" for y in conjunction]


def _disjunction(cases: list[list[str]]) -> Iterator[str]:
    if len(cases) == 1:
        for condition in cases[0]:
            yield f"(assert {condition})"
        return
    yield "(assert (or"
    for case in cases:
        yield f"  (and {' '.join(case)})"
    yield "))"
