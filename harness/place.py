"""Where one instance is run: a scratch folder of the tool's, and beside it what it prints."""

from __future__ import annotations

import os
import sys
import tempfile
from contextlib import suppress
from pathlib import Path

from harness import scratch

#: Folders that are looked for in HOME where these variables are not set.
_BELOW_HOME = ("XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "XDG_STATE_HOME")
_PARTS = ("home", "tmp", "work")


class Place:
    """A new scratch folder below ``parent``, which is made if need be.

    Its path is short, since sockets below TMPDIR allow about 100 characters.
    """

    def __init__(self, parent: Path) -> None:
        parent.mkdir(mode=0o700, exist_ok=True)
        self.folder = Path(tempfile.mkdtemp(prefix="", dir=parent))
        for name in _PARTS:
            (self.folder / name).mkdir(mode=0o700)
        self._new = self._look()

    @property
    def work(self) -> Path:
        """The folder that scripts start in."""
        return self.folder / "work"

    @property
    def results(self) -> Path:
        """The result file."""
        return self.folder / "result.txt"

    @property
    def log(self) -> Path:
        """What scripts print; not in the scratch folder, so that it outlives that."""
        return self.folder.with_name(f"{self.folder.name}.log")

    def environment(self, fresh_home: bool) -> dict[str, str]:
        """Return the environment of a tool's scripts; PYTHON is the harness's own interpreter."""
        environment = {**os.environ, "PYTHON": sys.executable}
        for name in ("TMPDIR", "TMP", "TEMP", "TEMPDIR"):
            environment[name] = str(self.folder / "tmp")
        if fresh_home:
            for name in _BELOW_HOME:
                environment.pop(name, None)
            environment["HOME"] = str(self.folder / "home")
        return environment

    def restore(self) -> None:
        """Make folders anew that a script before has removed, or put something else in place of."""
        for folder in (self.folder, *(self.folder / name for name in _PARTS)):
            if folder.is_symlink() or not folder.is_dir():
                scratch.remove(str(folder))
                folder.mkdir(mode=0o700, parents=True, exist_ok=True)

    def clear(self) -> bool:
        """Make it new again where little is to be done for it; else remove it, and return False.

        Some file systems take milliseconds to remove a folder.
        """
        for file in (self.results, self.log):
            with suppress(OSError):
                file.unlink()
        if not os.path.lexists(self.log) and self._look() == self._new:
            return True
        self.remove()
        return False

    def remove(self) -> None:
        """Remove the folder and the log."""
        scratch.remove(str(self.folder))
        scratch.remove(str(self.log))

    def _look(self) -> list[object]:
        """Return what folders there are, and what is in them; empty where that can't be told."""
        seen: list[object] = []
        try:
            for folder in (self.folder, *(self.folder / name for name in _PARTS)):
                info = folder.lstat()
                seen += [info.st_dev, info.st_ino, info.st_mode, info.st_uid]
                seen.append(sorted(os.listdir(folder)))  # noqa: PTH208
        except OSError:
            return []
        return seen
