"""A root with a few instances of one controller, for tests that make reference results."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from racecar.instance import Instance, load_instance, save_instance

CHECKOUT = Path(__file__).resolve().parents[3]
NAME = "TD3_L21_64x64_C1"


def make_root(
    root: Path,
    timeouts: Mapping[str, float],
    base: str,
    derive: Callable[[Instance], Sequence[Instance]],
) -> Path:
    """Write a root whose category ``quick`` has the instances of ``timeouts``, in that order.

    Of these ``derive`` makes some of the published instance ``base``; the others are published,
    too. Returns the category's folder.
    """
    folder, published = root / "benchmarks" / "quick", CHECKOUT / "benchmarks" / "quick" / "json"
    (folder / "json").mkdir(parents=True)
    (root / "onnx").mkdir()
    shutil.copy(CHECKOUT / "onnx" / f"{NAME}.onnx", root / "onnx")
    for id in timeouts:
        if (published / f"{id}.json").is_file():
            shutil.copy(published / f"{id}.json", folder / "json")
    for instance in derive(load_instance(folder / "json" / f"{base}.json")):
        save_instance(instance, folder / "json" / f"{instance.id}.json")
    lines = [f"../../onnx/{NAME}.onnx,json/{id}.json,{limit}\n" for id, limit in timeouts.items()]
    (folder / "instances.csv").write_text("".join(lines))
    return folder
