"""What all commands share: exit statuses, one-line errors, JSON output.

Exit status 0: done; 1: a check failed; 2: bad input or usage; 130: interrupted.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Sequence
from typing import Any, NoReturn

import click

from racecar.errors import BadInput

DONE, CHECK_FAILED, BAD_INPUT, INTERRUPTED = 0, 1, 2, 130


class Commands(click.Group):
    """A click group that ends with the project's exit statuses.

    Bad input, wrong usage and files that cannot be read or written give one line on
    standard error and status 2; an interrupt gives status 130.
    """

    def main(self, args: Sequence[str] | None = None, **extra: Any) -> NoReturn:  # type: ignore[override]
        """Run the command line and end the process."""
        extra["standalone_mode"] = False
        try:
            status = super().main(args, **extra)
        except BadInput as error:
            _fail(str(error))
        except click.exceptions.NoArgsIsHelpError as error:
            click.echo(error.ctx.get_help(), err=True)
            sys.exit(BAD_INPUT)
        except click.ClickException as error:
            _fail(error.format_message())
        except (click.Abort, KeyboardInterrupt):
            click.echo("interrupted", err=True)
            sys.exit(INTERRUPTED)
        except BrokenPipeError:
            sys.stderr.close()
            sys.exit(DONE)
        except OSError as error:
            _fail(f"{error.filename or 'system'}: {error.strerror or error}")
        sys.exit(status if isinstance(status, int) else DONE)


def _fail(message: str) -> NoReturn:
    click.echo("error: " + " ".join(message.split()), err=True)
    sys.exit(BAD_INPUT)


def print_json(record: dict[str, Any]) -> None:
    """Print one result as one line of strict JSON; values that are not finite become null."""
    click.echo(json.dumps(_finite(record), allow_nan=False))


def _finite(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if hasattr(value, "item"):  # a NumPy scalar
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
