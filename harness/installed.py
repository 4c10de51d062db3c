"""Install a described tool, and find what is installed: its environment and its programs."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

from harness.description import Description
from harness.environments import ensure_environment, environment_folder, is_installed
from racecar.errors import BadInput


def install(tool: Description) -> None:
    """Make the tool's environment, and see that its programs are there."""
    for name in tool.programs:
        find_program(tool, name)
    if tool.install.packages:
        timeout = tool.install.timeout_s
        print(ensure_environment(tool.name, tool.install.packages, timeout), flush=True)


def find_program(tool: Description, name: str) -> str:
    """Return the path of a program of the user's; BadInput says how to get it."""
    program = tool.programs[name]
    given = os.environ.get(program.variable)
    if given:
        if Path(given).exists():
            return str(Path(given).absolute())
        raise BadInput(f"{tool.name}: {program.variable} is {given}, but there is no such file")
    found = shutil.which(program.default) if program.default else None
    if found is None:
        raise BadInput(
            f"{tool.name}: {program.help}; then set {program.variable} to its path"
            + (f", or put {program.default} on PATH" if program.default else "")
        )
    return found


def installed_values(tool: Description, folder: Path) -> dict[str, str]:
    """Return what the placeholders of an installed tool stand for; BadInput if it is not there."""
    values = {"folder": str(folder), "python": sys.executable}
    if tool.install.packages:
        environment = environment_folder(tool.name, tool.install.packages)
        if not is_installed(environment):
            raise BadInput(f"{tool.name} is not installed; run it without --no-install")
        values["bin"] = str(environment / "bin")
    return values | {name: find_program(tool, name) for name in tool.programs}
