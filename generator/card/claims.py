"""What the dataset is meant to be, held against its reference results."""

from __future__ import annotations

from dataclasses import dataclass

from generator.card.facts import CategoryFacts, Dataset

#: Categories in which both verdicts are to occur.
BOTH = ("closed_loop", "full_range", "open_loop", "unrolled", "faults")
#: Categories of which, together, at least so large a share is to be open.
WIDER, OPEN_SHARE = ("state_box", "noise", "faults", "lap"), 0.1
#: All of the dataset is to take less than so many bytes.
MOST_BYTES = 100_000_000


@dataclass(frozen=True)
class Claim:
    """Something that is to hold; holds: None if there are no reference results to say so."""

    text: str
    holds: bool | None
    found: str


def claims(dataset: Dataset) -> list[Claim]:
    """Return what is to hold of a dataset, and whether it does."""
    size = dataset.size
    return [
        *(_both(name, dataset.category(name)) for name in BOTH),
        _open(dataset),
        Claim("All of it takes less than 100 MB.", size < MOST_BYTES, f"{size / 1e6:.1f} MB"),
    ]


def _both(name: str, category: CategoryFacts | None) -> Claim:
    sat, unsat = (category.count(verdict) if category else 0 for verdict in ("sat", "unsat"))
    known = bool(category and category.results)
    found = f"{sat} sat, {unsat} unsat" if known else "no reference results yet"
    return Claim(f"Both verdicts occur in `{name}`.", sat > 0 < unsat if known else None, found)


def _open(dataset: Dataset) -> Claim:
    parts = [part for name in WIDER if (part := dataset.category(name)) and part.results]
    text = f"At least a tenth of {_listed(WIDER)} together is open."
    if not parts:
        return Claim(text, None, "no reference results yet")
    # Only what the reference has tried: an instance that nobody asked about says nothing.
    tried = sum(len(part.results) for part in parts)
    undecided = sum(part.count("unknown") for part in parts)
    holds = len(parts) == len(WIDER) and undecided >= OPEN_SHARE * tried
    missing = [name for name in WIDER if name not in {part.name for part in parts}]
    found = f"{undecided} of {tried} tried"
    if missing:
        return Claim(text, None, f"{found}; no reference results yet for {_listed(missing)}")
    return Claim(text, holds, found)


def _listed(names: tuple[str, ...] | list[str]) -> str:
    quoted = [f"`{name}`" for name in names]
    return ", ".join(quoted[:-1]) + (" and " if quoted[1:] else "") + quoted[-1]
