"""Kinks: rays that may end at either of two faces, or at the range; their reading is continuous.

A ray meets face w, proved but for guards u_a >= u_b that may fail by something (verifier.choice).
Let G be such a guard's u_a - u_b. The true inverse distance is

    outwards:  max(u_w, u_k)   w or the range; w or a face k of another wall (G = u_w - u_k)
    inwards:   min(u_w, u_k)   two faces of one convex wall                  (G = u_k - u_w)

of all of them together. One of a ray's kinks is followed: with g = -G in [low, high] and 0 <= share
<= 1, relu(g) - share g is convex, 0 at 0, so it lies in [0, 2 mu] where 2 mu is the larger of
its end values. So

    max(u_w, u_k) = u_w + relu(u_k - u_w)  is in  (1 - share) u_w + share u_k + mu +- mu
    min(u_w, u_k) = u_w - relu(u_w - u_k)  is in  (1 - share) u_w + share u_k - mu +- mu

The others go into the radius: those inwards make u smaller, those outwards larger, by no more than
their guards fail by.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from verifier.models import Array
from verifier.rounding import UP
from verifier.walls import Index

Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Kinks:
    """Guards ``nearer`` of rays that may fail ``[N]``.

    place: the ray and row, as one number; other: the face (or range) that is not the one met;
    inwards: whether it is of the same wall; least, most: bounds of G; sure: whether the ray
    surely meets the other where G < 0.
    """

    place: Index
    other: Index
    inwards: Bools
    least: Array
    most: Array
    sure: Bools

    def take(self, index: NDArray) -> Kinks:
        """Return those at ``index``."""
        return Kinks(
            self.place[index],
            self.other[index],
            self.inwards[index],
            self.least[index],
            self.most[index],
            self.sure[index],
        )

    @property
    def fails(self) -> Array:
        """By how much G may be below 0."""
        return -self.least

    @property
    def share(self) -> Array:
        """The slope of the chord of relu(g), within [0, 1]."""
        high, low = self.fails, np.minimum(-self.most, 0.0)
        return np.minimum(high / (high - low), 1.0)

    @property
    def gap(self) -> Array:
        """What the chord leaves open, 2 mu."""
        share = self.share
        return np.maximum(self.fails * (1 - share), share * np.maximum(self.most, 0.0)) * UP

    @property
    def cost(self) -> Array:
        """The radius that one of them costs at least (1/m)."""
        return np.where(self.sure, self.gap, self.fails) / 2


@dataclass(frozen=True)
class Bends:
    """What becomes of the inverse distance at places (of rays and rows) with kinks, ``[N]``.

    u is in (1 - share) u_w + share u_other + middle +- slack.
    """

    place: Index
    other: Index
    share: Array
    middle: Array
    slack: Array


def bends(kinks: Kinks, beyond: Array) -> Bends:
    """Return what kinks make of their places.

    beyond: ``[places]``, lower bounds of G for all guards of a place by which the ray does not
    end before the wall that it meets: those outwards (inf where there are none).
    """
    order = np.lexsort((-np.where(kinks.sure, kinks.fails - kinks.gap, 0.0), kinks.place))
    kinks = kinks.take(order)
    place, first, owner = np.unique(kinks.place, return_index=True, return_inverse=True)
    followed = kinks.take(first)
    inner, outer = np.zeros(len(place)), np.zeros(len(place))
    rest = np.ones(len(owner), dtype=bool)
    rest[first] = False
    for size, some in ((inner, kinks.inwards), (outer, ~kinks.inwards)):
        np.maximum.at(size, owner[some & rest], kinks.fails[some & rest])
    # Of the followed one, either the chord or, like the others, what it may fail by.
    mine = np.where(followed.inwards, inner, outer), np.where(followed.inwards, outer, inner)
    plain = np.maximum(mine[0], followed.fails) + mine[1]
    # Where u_other < u_w, what lies just beyond u_w lies beyond u_other no more.
    hidden = np.maximum(outer, np.maximum(followed.fails - beyond[place], 0.0) * UP)
    outer_then = np.where(followed.inwards, hidden, outer)
    chord = followed.gap + inner + outer_then
    bent = followed.sure & (chord < plain)
    inner = np.where(~bent & followed.inwards, np.maximum(inner, followed.fails), inner)
    outer = np.where(~bent & ~followed.inwards, np.maximum(outer, followed.fails), outer)
    outer = np.where(bent, outer_then, outer)
    gap = np.where(bent, followed.gap, 0.0)
    low = -inner - np.where(followed.inwards, gap, 0.0)
    high = outer + np.where(followed.inwards, 0.0, gap)
    slack = ((high - low) / 2) * UP
    return Bends(
        place, followed.other, np.where(bent, followed.share, 0.0), (low + high) / 2, slack
    )
