"""Virtual environments for tools from PyPI: one for each tool, made once and kept in a cache.

Verifiers pin versions of each other's libraries and bring gigabytes; none of it belongs into
the environment of the harness.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from racecar.errors import BadInput

#: The cache folder; without it, that of the XDG base directories.
CACHE_VARIABLE = "CLOSEDLAP_CACHE"
#: Written last; holds what was installed.
_DONE = "closedlap-installed.txt"


def cache_folder() -> Path:
    """Return where tools are kept."""
    if given := os.environ.get(CACHE_VARIABLE):
        return Path(given).absolute()
    base = os.environ.get("XDG_CACHE_HOME", "")
    # The specification says that a relative one is to be ignored.
    root = Path(base) if Path(base).is_absolute() else Path.home() / ".cache"
    return root / "closedlap"


def environment_folder(name: str, installs: Sequence[Sequence[str]]) -> Path:
    """Return where the environment of a tool is, or would be: other packages, another folder."""
    what = "\n".join([f"python {sys.version_info[:2]}", *(" ".join(words) for words in installs)])
    digest = hashlib.sha256(what.encode()).hexdigest()[:12]
    return cache_folder() / "tools" / f"{name}-{digest}"


def is_installed(folder: Path) -> bool:
    """Whether an environment is complete."""
    return (folder / _DONE).is_file()


def ensure_environment(name: str, installs: Sequence[Sequence[str]], timeout_s: float) -> Path:
    """Return the environment, made if it is not there; BadInput if that fails.

    installs: arguments of ``pip install``, one list after the other. Several processes may ask
    at once; one that is killed leaves nothing that another would take for complete.
    """
    folder = environment_folder(name, installs)
    if is_installed(folder):
        return folder
    folder.parent.mkdir(parents=True, exist_ok=True)
    with folder.with_name(f"{folder.name}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if is_installed(folder):
            return folder
        shutil.rmtree(folder, ignore_errors=True)
        python = str(folder / "bin" / "python")
        _call([sys.executable, "-m", "venv", str(folder)], timeout_s)
        for words in installs:
            _call([python, "-m", "pip", "install", "--no-input", *words], timeout_s)
        (folder / _DONE).write_text("".join(" ".join(words) + "\n" for words in installs))
    return folder


def _call(command: list[str], timeout_s: float) -> None:
    """Run a command, its output to ours; BadInput if it fails."""
    try:
        status = subprocess.run(command, timeout=timeout_s, check=False).returncode
    except subprocess.TimeoutExpired:
        raise BadInput(f"{' '.join(command)}: took longer than {timeout_s:g} s") from None
    if status:
        raise BadInput(f"{' '.join(command)}: ended with status {status}")
