"""Partitions of a start range in exact decimal arithmetic, so that no gap can open."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import Decimal, localcontext
from itertools import pairwise

from racecar.errors import BadInput

#: Lower and upper bound as decimal literals.
Bounds = tuple[str, str]


def tile(lower: str, upper: str, width: str) -> tuple[Bounds, ...]:
    """Cut [lower, upper] into subsets of one width; neighbours share the same literal.

    Raises BadInput if the width does not divide the range.
    """
    low, high, step = (exact_decimal(x) for x in (lower, upper, width))
    with localcontext() as context:
        context.prec = 60  # enough for every sum and quotient here to be exact
        if not (low < high and step > 0 and (high - low) % step == 0):
            raise BadInput(f"width {width} does not divide the range [{lower}, {upper}]")
        count = int((high - low) / step)
        cuts = [str(low + i * step) for i in range(count + 1)]
    return tuple(pairwise(cuts))


def exact_decimal(text: str) -> Decimal:
    """Read a decimal literal that a double keeps: it prints as the same decimal number.

    Such a literal stands in an instance file exactly as it was given. Raises BadInput for
    anything else.
    """
    try:
        value = Decimal(text)
    except ArithmeticError:
        raise BadInput(f"{text!r} is not a decimal number") from None
    if not value.is_finite() or Decimal(repr(float(value))) != value:
        raise BadInput(f"{text} cannot be kept exactly; give a finite number of up to 15 digits")
    return value


@dataclass(frozen=True)
class Partition:
    """A start range cut into subsets of one width, each asked about with each property.

    lower, upper, width: decimal literals, metres; properties: names.
    """

    lower: str
    upper: str
    width: str
    properties: tuple[str, ...]

    @property
    def subsets(self) -> tuple[Bounds, ...]:
        """The subsets, left to right."""
        return tile(self.lower, self.upper, self.width)

    @property
    def label(self) -> str:
        """What the subsets' IDs and the HDF5 group call it: w5mm for a width of 0.005 m."""
        return f"w{(Decimal(self.width) * 1000).normalize():f}mm"

    def ids(self, prefix: str) -> list[list[str]]:
        """Return an ID for each subset and property; one subset for all needs no number."""
        places = (
            [f"{prefix}.{self.label}.{i:03}" for i in range(len(self.subsets))]
            if len(self.subsets) > 1
            else [prefix]
        )
        return [[f"{place}.{name}" for name in self.properties] for place in places]
