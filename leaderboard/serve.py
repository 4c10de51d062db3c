"""Showing a built site on this machine."""

from __future__ import annotations

import functools
import http.server
from pathlib import Path

from leaderboard.output import LISTING
from racecar.errors import BadInput


class _Handler(http.server.SimpleHTTPRequestHandler):
    """Serves files as they are, and says nothing about requests."""

    def end_headers(self) -> None:
        """Add that types are as stated, and that pages are to be asked for anew."""
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("Cache-Control", "no-cache")
        super().end_headers()

    def log_message(self, format: str, *args: object) -> None:
        """Say nothing."""


def make_server(folder: Path, host: str, port: int) -> http.server.ThreadingHTTPServer:
    """Return a server of a site that is ready to run; port 0 takes any that is free.

    Raises BadInput if the folder holds no site or the address cannot be had.
    """
    if not (folder / LISTING).is_file():
        raise BadInput(
            f"{folder}: there is no site; make one with leaderboard build RUN... -o {folder}"
        )
    handler = functools.partial(_Handler, directory=str(folder))
    try:
        return http.server.ThreadingHTTPServer((host, port), handler)
    except (OSError, OverflowError) as error:
        reason = getattr(error, "strerror", None) or error
        raise BadInput(
            f"{host}:{port}: cannot be served ({reason}); choose another --port"
        ) from None
