"""What a VNN-LIB query says, as data.

A query describes the violation: it is sat if some inputs, with the outputs that the network
gives for them, make all assertions true. Numbers are exact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import StrEnum
from fractions import Fraction


class Relation(StrEnum):
    """How two terms are compared."""

    AT_MOST = "<="
    AT_LEAST = ">="
    LESS = "<"
    GREATER = ">"
    EQUAL = "=="
    DIFFERENT = "!="


@dataclass(frozen=True, slots=True)
class Tensor:
    """A declared input or output; dtype: float32, float64 or real."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    is_input: bool

    @property
    def size(self) -> int:
        """How many elements it has."""
        return math.prod(self.shape)


@dataclass(frozen=True, slots=True)
class Element:
    """One element of a tensor; tensor: its place in Query.tensors, index: row-major."""

    tensor: int
    index: int


@dataclass(frozen=True, slots=True)
class Operation:
    """A sum, a difference (with one term: its negative) or a product; operator: + - or *."""

    operator: str
    terms: tuple[Term, ...]


Term = Fraction | Element | Operation


@dataclass(frozen=True, slots=True)
class Comparison:
    """A comparison of two terms, in a line of the file.

    on_inputs: whether no output occurs in it; tolerant: whether the tolerance on inputs holds
    for it.
    """

    relation: Relation
    left: Term
    right: Term
    line: int
    on_inputs: bool
    tolerant: bool


@dataclass(frozen=True, slots=True)
class And:
    """A conjunction."""

    parts: tuple[Formula, ...]


@dataclass(frozen=True, slots=True)
class Or:
    """A disjunction."""

    parts: tuple[Formula, ...]


Formula = Comparison | And | Or


@dataclass(frozen=True)
class Query:
    """A query; version: of VNN-LIB, "1.0" or "2.0"; tensors: inputs first, as declared."""

    version: str
    tensors: tuple[Tensor, ...]
    assertions: tuple[Formula, ...]

    @property
    def inputs(self) -> tuple[Tensor, ...]:
        """The inputs in the order of their declaration."""
        return tuple(tensor for tensor in self.tensors if tensor.is_input)

    @property
    def outputs(self) -> tuple[Tensor, ...]:
        """The outputs in the order of their declaration."""
        return tuple(tensor for tensor in self.tensors if not tensor.is_input)
