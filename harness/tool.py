"""Find a tool: one that ships with the harness, or any folder with VNN-COMP's scripts or a TOML."""

from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

from harness.description import (
    ABOUT,
    DESCRIPTION,
    About,
    Description,
    fill,
    load_about,
    load_description,
    own_files,
)
from harness.environments import cache_folder
from harness.installed import installed_values
from harness.machine import package_version
from harness.records import ToolInfo
from racecar.errors import BadInput

SHIPPED = Path(__file__).parent / "tools"
INSTALL, PREPARE, RUN = "install_tool.sh", "prepare_instance.sh", "run_instance.sh"
#: The version of the script interface, always the first argument.
INTERFACE = "v1"
#: The adapter's word for what a script does.
_ACTIONS = {INSTALL: "install", PREPARE: "prepare", RUN: "run"}
#: A command that prints the version may take so long (s).
_VERSION_LIMIT_S = 20.0


@dataclass(frozen=True)
class Tool:
    """A folder with VNN-COMP's scripts (install_tool.sh may be absent), or with a description."""

    name: str
    folder: Path
    version: str | None
    description: Description | None = None
    about: About | None = None

    @property
    def has_install(self) -> bool:
        """Whether there is something to run before all else."""
        if self.description is not None:
            return bool(self.description.install.packages or self.description.programs)
        return (self.folder / INSTALL).is_file()

    def command(self, script: str, *arguments: str) -> list[str]:
        """Return the command for a script; through bash, so that no x bit is needed."""
        if self.description is not None:
            # -P: the scratch folder, in which it runs, must not hold modules to import.
            # --cache: the tool may be given another HOME than the one it was installed in.
            adapter = [
                sys.executable,
                "-P",
                "-m",
                "harness.adapter",
                "--cache",
                str(cache_folder()),
            ]
            return [*adapter, _ACTIONS[script], str(self.folder), INTERFACE, *arguments]
        return ["bash", str(self.folder / script), INTERFACE, *arguments]

    def info(self) -> ToolInfo:
        """Return the tool as data."""
        digest = hashlib.sha256()
        scripts = [INSTALL, PREPARE, RUN]
        if self.description is not None:
            scripts = [DESCRIPTION, *own_files(self.description)]
        for script in scripts:
            path = self.folder / script
            digest.update(script.encode() + b"\0")
            digest.update(path.read_bytes() if path.is_file() else b"")
        return ToolInfo(
            name=self.name,
            version=self.version,
            folder=str(self.folder),
            scripts_sha256=digest.hexdigest(),
        )


def shipped_tools() -> list[str]:
    """Return the names of the tools that ship with the harness."""
    files = [*SHIPPED.glob(f"*/{RUN}"), *SHIPPED.glob(f"*/{DESCRIPTION}")]
    return sorted({file.parent.name for file in files})


def find_tool(text: str, name: str | None = None) -> Tool:
    """Return the tool of that name, or at that path; BadInput if there is none.

    name: to be used in results; default: the description's, or the folder's.
    """
    if text in shipped_tools():
        return _open(SHIPPED / text, name or text, text)
    folder = Path(text)
    if not folder.is_dir():
        raise BadInput(
            f"tool {text!r} is unknown; choose one of {', '.join(shipped_tools())}, "
            f"or give a folder that holds {DESCRIPTION}, or {PREPARE} and {RUN}"
        )
    return _open(folder.resolve(), name, text)


def _open(folder: Path, name: str | None, text: str) -> Tool:
    """Return the tool in a folder; ``text`` is what it is called in complaints."""
    description = None
    if (folder / DESCRIPTION).is_file():
        if any((folder / script).is_file() for script in (PREPARE, RUN)):
            raise BadInput(f"tool {text}: it has both {DESCRIPTION} and scripts; remove one")
        description = load_description(folder / DESCRIPTION)
    else:
        for script in (PREPARE, RUN):
            if not (folder / script).is_file():
                raise BadInput(
                    f"tool {text}: it has neither {DESCRIPTION} nor {script}; "
                    "see docs/tool-interface.md"
                )
    name = name or (description.name if description else folder.name)
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,199}", name):
        raise BadInput(
            f"tool {text}: {name!r} does not serve as a name; give another with --name "
            "(letters, digits and _ . + -)"
        )
    about: About | None = description
    if about is None and (folder / ABOUT).is_file():
        about = load_about(folder / ABOUT)
    version = _described_version(description, folder) if description else _version(folder)
    return Tool(name, folder, version, description, about)


def _version(folder: Path) -> str | None:
    """Return the first line of the tool's VERSION file; of a tool of this package its version."""
    try:
        lines = (folder / "VERSION").read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return package_version("closedlap") if folder.parent == SHIPPED else None
    return lines[0].strip()[:200] or None if lines else None


def _described_version(tool: Description, folder: Path) -> str | None:
    """Return the version that a description names, or that its command prints now, if it does."""
    if tool.version is None:
        return None
    if tool.version.command is None:
        return tool.version.text
    try:
        values = installed_values(tool, folder)
        command = [fill(word, values) for word in tool.version.command]
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            timeout=_VERSION_LIMIT_S,
            check=False,
        )
    except (BadInput, OSError, subprocess.TimeoutExpired):
        return None  # not installed yet, or of no use: the run will say
    match = re.search(tool.version.pattern, done.stdout.decode("utf-8", errors="replace"))
    return match[match.re.groups and 1].strip()[:200] or None if match else None
