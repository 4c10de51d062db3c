"""The machine and the programs that a run or a check was made with."""

from __future__ import annotations

import os
import platform
from importlib import metadata
from pathlib import Path

import psutil

from harness.records import Machine

_JUDGES = ("closedlap", "numpy", "onnxruntime")


def package_version(package: str) -> str:
    """Return the version of an installed package."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def versions() -> dict[str, str]:
    """Return the versions of the programs that judge a witness."""
    return {package: package_version(package) for package in _JUDGES}


def describe_machine() -> Machine:
    """Return what timings depend on; memory in MiB."""
    usable = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else range(_cores())
    return {
        "host": platform.node(),
        "system": platform.platform(),
        "processor": _processor(),
        "cores": _cores(),
        "usable_cores": len(usable),
        "memory_mib": psutil.virtual_memory().total // 2**20,
        "python": platform.python_version(),
        **versions(),
    }


def _cores() -> int:
    return os.cpu_count() or 1


def _processor() -> str:
    """Return the model of the processor, where the system tells."""
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()
