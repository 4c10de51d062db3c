"""Checking a certificate of a VNN-LIB question: its boxes, their division, and every leaf.

A question is unsat if none of its cases can be fulfilled. The certificate's boxes hold those of all
cases; each is divided by its tree, so that the leaves cover it whatever the tree says; and on every
leaf, every case whose box lies in the leaf's root has a condition that no input of it fulfils.
"""

from __future__ import annotations

import random
import time
from collections.abc import Callable
from fractions import Fraction
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from checker.files import Rejected, Unreadable, require
from checker.query.files import Asked, Certificate, read_asked, read_certificate
from checker.query.vnnlib import Case
from checker.run import Report

Array = NDArray[np.float64]
#: Leaves that are checked between two reports.
_CHUNK = 32


def check(
    certificate: Path, spec: Path, onnx: Path, sample: int | None = None, seed: int = 0,
    report: Callable[[float], None] = lambda share: None,
) -> Report:  # fmt: skip
    """Check a certificate; raises Unreadable. sample: so many leaves, drawn by ``seed``.

    The margin of a valid one is proved: by so much, in the outputs' unit, every case misses one
    of its conditions.
    """
    began = time.perf_counter()
    cert, asked = read_certificate(certificate), read_asked(spec, onnx)
    margin, done, total, reason = np.inf, 0, 0, ""
    try:
        roots = check_boxes(cert, asked)
        leaves = check_trees(cert)
        total = len(leaves)
        chosen = list(range(total))
        if sample is not None:
            chosen = sorted(random.Random(seed).sample(chosen, min(sample, total)))
        for root, mine in _by_root(leaves, chosen):
            for k in range(0, len(mine), _CHUNK):
                part = mine[k : k + _CHUNK]
                margin = min(margin, _check_leaves(asked, roots[root], leaves, part))
                done += len(part)
                report(done / len(chosen))
    except Rejected as error:
        reason = str(error)
    verdict = "rejected" if reason else "valid" if done == total else "sampled"
    margin = margin if np.isfinite(margin) and not reason else 0.0
    return Report(verdict, float(margin), total, done, time.perf_counter() - began, reason)


def check_boxes(cert: Certificate, asked: Asked) -> list[list[Case]]:
    """Return the cases that each box answers for; Rejected if one is in no box."""
    require(cert.spec_sha256 == asked.spec_sha256, "it is of another question")
    require(cert.onnx_sha256 == asked.onnx_sha256, "of another network")
    return answered(asked, cert.lower, cert.upper)


def answered(asked: Asked, lower: Array, upper: Array) -> list[list[Case]]:
    """Return the cases that each box ``[boxes, inputs]`` answers for.

    A case goes to the smallest box that holds its own; Rejected if there is none.
    """
    require(lower.shape[1] == asked.question.inputs, "its boxes have another number of inputs")
    require((lower <= upper).all(), "a box is empty")
    roots: list[list[Case]] = [[] for _ in lower]
    for i, case in enumerate(asked.question.cases):
        low = np.array([_rounded(x, -np.inf) for x in case.lower])
        high = np.array([_rounded(x, np.inf) for x in case.upper])
        holds = ((lower <= low) & (high <= upper)).all(axis=1)
        require(holds.any(), f"case {i} of the question lies in none of its boxes")
        require(case.conditions, f"case {i} of the question asks nothing of the outputs")
        sizes = np.where(holds, (upper - lower).sum(axis=1), np.inf)
        roots[int(np.argmin(sizes))].append(case)
    return roots


def _rounded(value: Fraction, towards: float) -> float:
    """Return the nearest double that is not on the inner side."""
    double = float(value)
    inside = double > value if towards < 0 else double < value
    return float(np.nextafter(double, towards)) if inside else double


#: Root, lower and upper bounds of a leaf.
Leaf = tuple[int, Array, Array]


def check_trees(cert: Certificate) -> list[Leaf]:
    """Return all leaves; Rejected if the nodes are no trees, one for each box."""
    leaves: list[Leaf] = []
    place = 0
    for root, (lower, upper) in enumerate(zip(cert.lower, cert.upper, strict=True)):
        todo = [(lower, upper)]
        while todo:
            require(place < len(cert.dim), f"the tree of box {root} ends early")
            low, high = todo.pop()
            dim, at = cert.dim[place], cert.at[place]
            if dim == -1:
                leaves.append((root, low, high))
            else:
                sound = 0 <= dim < len(low) and low[dim] <= at <= high[dim]
                require(sound, f"node {place} divides a box where it is not")
                left, right = high.copy(), low.copy()
                left[dim] = right[dim] = at
                todo += [(right, high), (low, left)]
            place += 1
    require(place == len(cert.dim), "there are more nodes than trees need")
    return leaves


def _by_root(leaves: list[Leaf], chosen: list[int]) -> list[tuple[int, list[int]]]:
    groups: dict[int, list[int]] = {}
    for k in chosen:
        groups.setdefault(leaves[k][0], []).append(k)
    return list(groups.items())


def _check_leaves(asked: Asked, cases: list[Case], leaves: list[Leaf], mine: list[int]) -> float:
    """Return by how much all cases are excluded on some leaves of a box; Rejected if one is not."""
    lower = np.array([leaves[k][1] for k in mine])
    upper = np.array([leaves[k][2] for k in mine])
    missed = excluded(asked, cases, lower, upper)
    k = int(np.argmin(missed))
    if not missed[k] > 0:
        raise Rejected(
            f"leaf {mine[k]} (of box {leaves[mine[k]][0]}): a violation is not excluded, "
            f"by {-missed[k]:.3g}"
        )
    return float(missed[k])


def excluded(asked: Asked, cases: list[Case], lower: Array, upper: Array) -> Array:
    """Return by how much some cases are proved to be missed on boxes ``[boxes, inputs]``.

    Of each box the least over the cases of the largest amount by which one of a case's conditions
    is missed everywhere on the box: if it is positive, no case can be fulfilled there. Without
    cases it is infinite.
    """
    if not cases:
        return np.full(len(lower), np.inf)
    rows = [(i, condition) for i, case in enumerate(cases) for condition in case.conditions]
    factors = np.zeros((len(rows), asked.question.outputs))
    for row, (_, condition) in enumerate(rows):
        for output, factor in condition.factors:
            factors[row, output] = float(factor)
            if factors[row, output] != factor:
                raise Unreadable(f"the factor {factor} of an output is no double")
    most = np.array([_rounded(condition.most, np.inf) for _, condition in rows])
    unique, back = np.unique(factors, axis=0, return_inverse=True)
    least = asked.network.least(lower, upper, unique)[:, back.reshape(-1)]
    missed = np.nextafter(np.nan_to_num(least - most, nan=-np.inf), -np.inf)
    best = np.full((len(lower), len(cases)), -np.inf)
    for row, (i, _) in enumerate(rows):
        best[:, i] = np.maximum(best[:, i], missed[:, row])
    worst: Array = best.min(axis=1)
    return worst
