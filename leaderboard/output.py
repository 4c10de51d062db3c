"""The site's folder: only what changed is touched, what is no longer part of it is removed."""

from __future__ import annotations

import json
from pathlib import Path

from racecar.errors import BadInput

#: Lists the files of a site; where it stands, the folder is one.
LISTING = "files.json"


class Output:
    """A folder to which a site is written.

    Raises BadInput if it holds something else already. written, kept, removed: how many files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.written = self.kept = self.removed = 0
        self._files: set[str] = set()
        listing = folder / LISTING
        if folder.exists() and not folder.is_dir():
            raise BadInput(f"{folder}: it is a file; give a folder with -o")
        if listing.is_file():
            self._before = _read_listing(listing)
        elif folder.is_dir() and any(folder.iterdir()):
            raise BadInput(
                f"{folder}: it is not empty and not a site that was built before; give another"
            )
        else:
            self._before = set()
            self._write(LISTING, _listing(self._before))

    def write(self, name: str, content: bytes) -> None:
        """Put a file (name: relative, with forward slashes) in the site."""
        self._files.add(name)
        path = self.folder / name
        try:
            if path.read_bytes() == content:
                self.kept += 1
                return
        except OSError:
            pass
        self._write(name, content)
        self.written += 1

    def _write(self, name: str, content: bytes) -> None:
        """Replace a file at once, so that no reader sees half of it."""
        path = self.folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        part = path.with_name(f".{path.name}.part")
        part.write_bytes(content)
        part.replace(path)

    def keep_if_made_from(self, name: str, first_line: str) -> bool:
        """Keep a file as it is if that is its first line; say whether."""
        try:
            with (self.folder / name).open("rb") as file:
                same = file.readline() == first_line.encode() + b"\n"
        except OSError:
            return False
        if same:
            self._files.add(name)
            self.kept += 1
        return same

    def finish(self) -> None:
        """Remove the files of an earlier build that are not part of this one."""
        for name in sorted(self._before - self._files):
            path = self.folder / name
            if path.is_file():
                path.unlink()
                self.removed += 1
                for parent in path.parents:
                    if parent == self.folder or any(parent.iterdir()):
                        break
                    parent.rmdir()
        content = _listing(self._files)
        if (self.folder / LISTING).read_bytes() != content:
            self._write(LISTING, content)


def _listing(files: set[str]) -> bytes:
    data = {"format": "closedlap-site", "version": "1.0", "files": sorted(files)}
    return (json.dumps(data, indent=0) + "\n").encode()


def _read_listing(path: Path) -> set[str]:
    """Return the names in a listing; BadInput if one of them leads out of the folder."""
    try:
        data = json.loads(path.read_bytes())
        names = {str(name) for name in data["files"]}
        if data["format"] != "closedlap-site":
            raise ValueError
    except (OSError, ValueError, KeyError, TypeError):
        raise BadInput(f"{path}: not the listing of a site; remove the folder") from None
    for name in names:
        parts = Path(name).parts
        if Path(name).is_absolute() or ".." in parts or not parts:
            raise BadInput(f"{path}: it names {name!r}, which lies outside of the site")
    return names
