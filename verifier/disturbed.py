"""Disturbed scans: missing rays and bounded noise, on Taylor models.

Each reading's error becomes a symbol of its own on the way through the network, so that
errors of different rays meet with the signs of their weights; behind it they are one.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice

import numpy as np
from numpy.typing import NDArray

from racecar.faults import TURN_LEAD
from racecar.instance import Disturbance
from verifier.models import Array, Models, bounds, norm
from verifier.network import Network
from verifier.raychoices import choices, masks
from verifier.rounding import TINY, UP
from verifier.rows import Assumption, F, Inside, Rows, S
from verifier.scan import Guards

Bools = NDArray[np.bool_]

#: Choices of missing rays at one instant are tried one by one, up to so many.
MOST_CHOICES = 2000


class TooManyChoices(Exception):
    """There are more choices of missing rays than can be tried."""


class MirrorsUnknown(Exception):
    """What a mirroring wall does is not enclosed, so nothing can be proved of it."""


def cases(disturbance: Disturbance | None, rays: int) -> Bools:
    """Return the sets of rays that may be missing in a run, ``[cases, rays]``.

    If the choice is made anew at each step, there is one case, of all rays. Every proof begins
    here. Raises TooManyChoices, MirrorsUnknown.
    """
    if disturbance is not None and disturbance.mirrors is not None:
        raise MirrorsUnknown
    if disturbance is None or not disturbance.missing:
        return np.zeros((1, rays), dtype=bool)
    chosen = _choices(rays, disturbance.missing)
    if disturbance.choice == "step":
        return np.ones((1, rays), dtype=bool)
    return masks(chosen, rays)


def _choices(rays: int, most: int) -> list[tuple[int, ...]]:
    """Return the sets of at most ``most`` rays; raises TooManyChoices."""
    found = list(islice(choices(rays, most), MOST_CHOICES + 1))
    if len(found) > MOST_CHOICES:
        raise TooManyChoices
    return found


@dataclass(frozen=True)
class Region:
    """Where rays may be missing.

    inside: ``[rows]``, whether the row's rays are missing now; guards: of rows that are partly
    inside; unclear: rows that have to be split.
    """

    inside: Bools
    guards: Guards | None
    unclear: Bools


def region(rows: Rows, missing: Bools, turn_only: bool, width: float) -> Region:
    """Tell where rays are missing; missing: ``[rows]``, whether any are in the row's case."""
    count = len(rows)
    none = np.zeros(count, dtype=bool)
    if not turn_only or not missing.any():
        return Region(missing, None, none)
    s, f = rows.state[S], rows.state[F]
    conditions = [s, (-s).plus(width), (-f).plus(width + TURN_LEAD)]
    low, high = (np.stack(x) for x in zip(*(bounds(c) for c in conditions), strict=True))
    assumed = [next((d for d in known if isinstance(d, Inside)), None) for known in rows.decisions]
    settled = np.array([d is not None for d in assumed], dtype=bool)
    holds = np.array([d is not None and d.positive for d in assumed], dtype=bool)
    inside, outside = (low > 0).all(axis=0), (high < 0).any(axis=0)
    open_rows = missing & ~settled & ~inside & ~outside
    unsure = (~(low > 0)).sum(axis=0)
    one = np.flatnonzero(open_rows & (unsure == 1))
    place = (~(low > 0)).argmax(axis=0)[one]
    models = Models(
        np.stack([conditions[p].c[:, n] for p, n in zip(place, one, strict=True)], axis=-1)
        if one.size
        else np.zeros((len(s.c), 0)),
        np.array([conditions[p].radius[n] for p, n in zip(place, one, strict=True)]),
    )
    decisions: tuple[Assumption | None, ...] = (Inside(True),) * one.size
    guards = Guards(models, -low[place, one], one, decisions)
    unclear = open_rows & (unsure > 1)
    return Region(missing & np.where(settled, holds, inside), guards, unclear)


def without(distance: Models, gone: Bools, reach: float) -> Models:
    """Return the scan ``[rays, rows]``, in which the rays ``gone`` (the same) read ``reach``."""
    c = np.where(gone, 0.0, distance.c)
    c[0] = np.where(gone, reach, c[0])
    return Models(c, np.where(gone, 0.0, distance.radius))


def steering_apart(network: Network, distance: Models, noise: float) -> Models:
    """Return the steering ``[rows]`` for a scan ``[rays, rows]`` off by up to ``noise`` (m).

    It has one error symbol more than the scan: the part of the noise to first order. The
    scan's own remainders are carried apart, too; they end in the radius.
    """
    rays, rows = distance.radius.shape
    terms = len(distance.c)
    total = (distance.radius + noise) * UP
    c = np.zeros((terms + 2 * rays, rays, rows))
    c[:terms] = distance.c
    each = np.arange(rays)
    c[terms + 2 * each, each] = total
    steering = network.steering(Models(c, np.zeros((rays, rows))))
    # |a| + |b| bounds a + b x. A noise of 0 is no reason to divide by 0.
    sizes = np.abs(steering.c[terms:]).reshape(rays, 2, rows).sum(axis=1)
    share = noise / np.maximum(total, TINY)
    from_noise = (sizes * share).sum(axis=0) * UP * UP
    out = np.zeros((terms + 2, rows))
    out[:terms] = steering.c[:terms]
    out[terms] = from_noise
    rest = (sizes * (1 - share * (1 - 2.0**-50))).sum(axis=0) * UP * UP
    return Models(out, (steering.radius + rest) * UP)


def hull(steerings: list[Models]) -> Models:
    """Return models ``[rows]`` that contain each of several, with one error symbol more."""
    first = steerings[0]
    low, high = np.zeros(first.radius.shape), np.zeros(first.radius.shape)
    for other in steerings[1:]:
        below, above = bounds(Models(other.c - first.c, _difference_radius(other, first)))
        low, high = np.minimum(low, below), np.maximum(high, above)
    half = (high - low) / 2 * UP
    centre = first.plus((low + high) / 2)
    c = np.concatenate([centre.c, half[None], np.zeros_like(half)[None]])
    # The middle is rounded.
    return Models(c, (centre.radius + 2.0**-50 * (np.abs(low) + np.abs(high))) * UP)


def _difference_radius(other: Models, first: Models) -> Array:
    """Return the radius of the difference of two models.

    Their symbols are the same, so their coefficients cancel; their radii do not.
    """
    size = norm(other.c) + norm(first.c)
    return (other.radius + first.radius + 2.0**-52 * size) * UP


def steering_of_choices(
    network: Network, distance: Models, inside: Bools, most: int, noise: float, reach: float
) -> Models:
    """Return steering ``[rows]`` that contains every choice of up to ``most`` missing rays."""
    rays = distance.radius.shape[0]
    found = []
    for gone in masks(_choices(rays, most), rays):
        scan = without(distance, gone[:, None] & inside[None, :], reach)
        found.append(steering_apart(network, scan, noise))
    return hull(found)
