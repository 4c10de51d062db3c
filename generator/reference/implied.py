"""When a proof of one instance proves another one: pure comparisons, exact on doubles.

A question asks less than another one if everything that may happen in it may happen in the other:
the same network and plant, no more steps, no start outside, no disturbance that the other does not
allow, and no unsafe point that is safe in the other.
"""

from __future__ import annotations

from racecar.disturbance import Disturbance
from racecar.instance import Constraints, InitialSet, Instance, PropertyData


def implies(proved: Instance, asked: Instance) -> bool:
    """Whether ``asked`` is unsat if ``proved`` is, with at least the same margin.

    False may also mean that these comparisons cannot tell.
    """
    return (
        proved.controller.sha256 == asked.controller.sha256
        and asked.steps <= proved.steps
        and starts_within(asked.initial_set, proved.initial_set)
        and disturbs_no_more(asked.disturbance, proved.disturbance)
        and unsafe_within(asked.property, proved.property)
        and proved.plant == asked.plant
    )


def starts_within(inner: InitialSet, outer: InitialSet) -> bool:
    """Whether every start of one box lies in another one."""
    pairs = ((getattr(inner, name), getattr(outer, name)) for name in InitialSet.model_fields)
    return all(least <= low and high <= most for (low, high), (least, most) in pairs)


def disturbs_no_more(less: Disturbance | None, more: Disturbance | None) -> bool:
    """Whether all that one disturbance may do another one may do, too.

    No disturbance at all is a member of every set of them.
    """
    if less is None:
        return True
    if more is None or less.noise > more.noise or less.missing > more.missing:
        return False
    if less.mirrors is not None and less.mirrors != more.mirrors:
        return False
    if less.missing == 0:
        return True
    # Chosen anew at every step, rays may as well be missing always, or in the turn only.
    anew = more.choice == "step"
    same_place = less.turn_only == more.turn_only or (anew and not more.turn_only)
    return same_place and (anew or less.choice == more.choice)


def unsafe_within(inner: PropertyData, outer: PropertyData) -> bool:
    """Whether every unsafe polygon of one property lies in one of the other's, frame by frame."""
    return len(inner.unsafe) == len(outer.unsafe) and all(
        all(any(_polygon_within(small, large) for large in larger) for small in smaller)
        for smaller, larger in zip(inner.unsafe, outer.unsafe, strict=True)
    )


def _polygon_within(small: Constraints, large: Constraints) -> bool:
    """Whether each constraint of the large polygon is one of the small one's, or weaker.

    Then the small one's constraints are missed by at least as much, so that a margin that was
    proved for the large one holds for the small one.
    """
    return all(
        any((a, b) == (other_a, other_b) and c <= offset for a, b, c in small)
        for other_a, other_b, offset in large
    )
