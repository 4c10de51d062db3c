"""Chains of modes: what is done one after the other in a control period."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass

from generator.hybrid.automaton import Assignment, Constraint, Jump, Mode, leave

#: A way out of a step: when it is open, and what it resets.
Branch = tuple[tuple[Constraint, ...], tuple[Assignment, ...]]


@dataclass(frozen=True)
class Step:
    """A mode of a chain.

    enter: resets on the way in. They see the values before the jump, so a step that branches
    with resets must not be followed by one that has resets on the way in.
    """

    mode: Mode
    enter: tuple[Assignment, ...] = ()
    branches: tuple[Branch, ...] = (((), ()),)


def linked(
    steps: Sequence[Step], target: str | None, reset: Iterable[Assignment]
) -> tuple[list[Mode], list[Jump]]:
    """Return the modes of a chain and the jumps between them.

    target, reset: where the last step leads to; with None its jumps are left out.
    """
    jumps = []
    ways = [(step.mode.name, step.enter) for step in steps[1:]]
    if target is not None:
        ways.append((target, tuple(reset)))
    for step, (to, enter) in zip(steps, ways, strict=False):
        for guard, done in step.branches:
            if done and enter:
                raise ValueError(f"resets before and in {to} meet in one jump")
            jumps.append(leave(step.mode, to, guard, (*done, *enter)))
    return [step.mode for step in steps], jumps


def decide(
    mode: Mode,
    atoms: Sequence[Constraint],
    target: str,
    reset: Sequence[Assignment],
    otherwise: Sequence[Assignment] = (),
) -> Iterator[Jump]:
    """Yield jumps to a mode: one with ``reset`` if all atoms hold, else one with ``otherwise``.

    Exactly one of them is open at any state; where a language has no strict relations, two are
    at the boundary of an atom.
    """
    yield leave(mode, target, atoms, reset)
    for guard in failing(atoms):
        yield leave(mode, target, guard, otherwise)


def failing(atoms: Sequence[Constraint]) -> Iterator[tuple[Constraint, ...]]:
    """Yield guards, no two of which hold at once, that together say: not all atoms hold."""
    for i, atom in enumerate(atoms):
        yield (*atoms[:i], atom.negated())
