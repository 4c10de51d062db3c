"""A folder to start a tool from."""

from __future__ import annotations

import shutil
import tempfile
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

from harness.records import Name
from racecar.errors import BadInput

_TEMPLATES = Path(__file__).parent / "templates"


def make_tool_folder(name: str, target: Path, described: bool) -> list[Path]:
    """Write a new tool's folder; return its files. BadInput if it exists or the name won't do.

    described: with a ``tool.toml`` instead of scripts.
    """
    try:
        TypeAdapter(Name).validate_python(name)
    except ValidationError:
        raise BadInput(
            f"{name!r} does not serve as a tool's name; take letters, digits and _ . + -"
        ) from None
    if target.exists():
        raise BadInput(f"{target}: it exists; give another folder with -o")
    template = _TEMPLATES / ("toml" if described else "scripts")
    target.parent.mkdir(parents=True, exist_ok=True)
    part = Path(tempfile.mkdtemp(prefix=f".{target.name}.", dir=target.parent))
    try:
        for source in sorted(template.iterdir()):
            made = part / source.name
            made.write_text(source.read_text("utf-8").replace("NAME", name), "utf-8")
            made.chmod(0o755 if source.suffix == ".sh" else 0o644)
        part.chmod(0o755)
        part.rename(target)
    except BaseException:
        shutil.rmtree(part, ignore_errors=True)
        raise
    return sorted(target.iterdir())
