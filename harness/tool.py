"""Find a tool: one that ships with the harness, or any folder with VNN-COMP's scripts."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from pathlib import Path

from harness.machine import package_version
from harness.records import ToolInfo
from racecar.errors import BadInput

SHIPPED = Path(__file__).parent / "tools"
INSTALL, PREPARE, RUN = "install_tool.sh", "prepare_instance.sh", "run_instance.sh"
#: The version of the script interface, always the first argument.
INTERFACE = "v1"


@dataclass(frozen=True)
class Tool:
    """A folder with VNN-COMP's scripts (install_tool.sh may be absent)."""

    name: str
    folder: Path
    version: str | None

    @property
    def has_install(self) -> bool:
        """Whether there is something to run before all else."""
        return (self.folder / INSTALL).is_file()

    def command(self, script: str, *arguments: str) -> list[str]:
        """Return the command for a script; through bash, so that no x bit is needed."""
        return ["bash", str(self.folder / script), INTERFACE, *arguments]

    def info(self) -> ToolInfo:
        """Return the tool as data."""
        digest = hashlib.sha256()
        for script in (INSTALL, PREPARE, RUN):
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
    return sorted(path.parent.name for path in SHIPPED.glob(f"*/{RUN}"))


def find_tool(text: str, name: str | None = None) -> Tool:
    """Return the tool of that name, or at that path; BadInput if there is none.

    name: to be used in results; default: the folder's name.
    """
    if text in shipped_tools():
        return Tool(name or text, SHIPPED / text, package_version("closedlap"))
    folder = Path(text)
    if not folder.is_dir():
        raise BadInput(
            f"tool {text!r} is unknown; choose one of {', '.join(shipped_tools())}, "
            f"or give a folder that holds {PREPARE} and {RUN}"
        )
    folder = folder.resolve()
    for script in (PREPARE, RUN):
        if not (folder / script).is_file():
            raise BadInput(f"tool {text}: it has no {script}; see docs/tool-interface.md")
    name = name or folder.name
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.+-]{0,199}", name):
        raise BadInput(
            f"tool {text}: {name!r} does not serve as a name; give another with --name "
            "(letters, digits and _ . + -)"
        )
    return Tool(name, folder, _version(folder))


def _version(folder: Path) -> str | None:
    """Return the first line of the tool's VERSION file, if it has one."""
    try:
        lines = (folder / "VERSION").read_text("utf-8", errors="replace").splitlines()
    except OSError:
        return None
    return lines[0].strip()[:200] or None if lines else None
