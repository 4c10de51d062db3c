"""What a dialect of automata can say: how rays, network and car are put in its arithmetic."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from generator.hybrid.automaton import Assignment, Constraint, StateVariable
from generator.hybrid.expression import Expression, Variable
from generator.hybrid.steps import Step

#: A constraint ``a_s s + a_f f <= b``.
Row = tuple[float, float, float]

S, F, V = Variable("s"), Variable("f"), Variable("v")


@dataclass(frozen=True)
class Sight:
    """How the ray at work sees constraints: s and f shrink by so much per metre of the ray."""

    toward_s: Expression
    toward_f: Expression

    def gap(self, row: Row) -> Expression:
        """Return g, by how much the car misses a constraint (metres)."""
        return row[0] * S + row[1] * F - row[2]

    def approach(self, row: Row) -> Expression:
        """Return h, by how much g shrinks per metre of the ray."""
        return row[0] * self.toward_s + row[1] * self.toward_f


class Dialect(Protocol):
    """What an automaton's arithmetic can say."""

    def variables(self) -> list[StateVariable]:
        """Return all variables but s, f, v, the clock and the counters."""

    def begin(self) -> dict[str, float]:
        """Return start values of these variables; 0 where none is given."""

    def heading(self) -> str:
        """Return the variable in which the start heading is."""

    def start(self) -> list[Step]:
        """Return what comes before the first scan."""

    def prepare(self) -> list[Step]:
        """Return what comes before every scan; no step may branch."""

    def settle(self) -> list[Step]:
        """Return what comes after the last face of every ray; no step may branch."""

    def sight(self) -> Sight:
        """Return the direction of the ray at work."""

    def aim(self, ray: int) -> list[Assignment]:
        """Return resets that begin a ray (from 1): its direction; so far it reads the range."""

    def nearer(self, sight: Sight, row: Row) -> Constraint:
        """Say that a face is no farther than what the ray at work reads so far."""

    def hit(self, sight: Sight, row: Row) -> list[Assignment]:
        """Return resets that let the ray at work read the distance to a face."""

    def keep(self, ray: int) -> list[Assignment]:
        """Return resets that keep what the ray at work reads as the reading of ``ray``."""

    def read(self) -> list[Step]:
        """Return what turns candidates into readings."""

    def readings(self) -> list[Expression]:
        """Return the readings in metres after ``read``."""

    def registers(self) -> list[str]:
        """Return variables that can keep disturbed readings."""

    def network(self, inputs: Sequence[Expression]) -> list[Step]:
        """Return the controller, from readings to what ``drive`` needs."""

    def enter_drive(self) -> list[Assignment]:
        """Return the resets with which a drive begins."""

    def drive(self) -> dict[str, Expression]:
        """Return the flow of the car."""

    def turn(self, rotation: float) -> list[Assignment]:
        """Return resets that turn the heading."""
