"""The command ``generator instance``."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from generator.command_options import FILE, json_option
from generator.instances import ControllerFile, Question, Range, make_instance
from generator.partition import exact_decimal
from racecar.command_line import print_json
from racecar.data import parse_data
from racecar.disturbance import Disturbance
from racecar.errors import BadInput
from racecar.experiment import default_field_of_view
from racecar.instance import save_instance
from racecar.safety import PROPERTIES

#: Options that take one number or two; the command has no arguments that are numbers.
_RANGE = re.compile(r"--(start|front|speed|heading)")
_FIRST = re.compile(_RANGE.pattern + r"=\S+")
_NUMBER = re.compile(r"[+-]?\.?\d.*")


class _Ranges(click.Command):
    """A command whose range options take one value, or two: ``--front LO [HI]``."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Join the two values of a range to one, which click can read."""
        joined: list[str] = []
        for word in args:
            if _NUMBER.fullmatch(word) and _takes_another(joined):
                joined[-1] += f" {word}"
            else:
                joined.append(word)
        return super().parse_args(ctx, joined)


def _takes_another(words: list[str]) -> bool:
    """Tell whether the last of the words is the first value of a range."""
    if words and _FIRST.fullmatch(words[-1]):
        return True
    named = len(words) > 1 and _RANGE.fullmatch(words[-2]) is not None
    return named and " " not in words[-1]


class _RangeType(click.ParamType):
    name = "LO [HI]"

    def convert(
        self, value: str, param: click.Parameter | None, ctx: click.Context | None
    ) -> Range:
        words = value.split()
        if len(words) == 1:
            return words[0]
        if len(words) == 2:
            return words[0], words[1]
        return self.fail("give one number or two", param, ctx)


def _range_option(name: str, default: str | None, text: str) -> Callable[[Any], Any]:
    return click.option(
        name,
        type=_RangeType(),
        metavar="LO [HI]",
        required=default is None,
        default=default,
        show_default=default is not None,
        help=text,
    )


@click.command(cls=_Ranges)
@click.option("--onnx", type=FILE, required=True, help="The controller.")
@_range_option("--start", None, "Distance to the left wall s, m.")
@_range_option("--front", "9.9", "Distance to the front wall f, m.")
@_range_option("--speed", "0", "m/s")
@_range_option("--heading", "0", "Degrees, counter-clockwise.")
@click.option("--noise", default="0", metavar="M", help="Every reading may be off by this much, m.")
@click.option(
    "--missing", type=click.IntRange(0), default=0, metavar="K", help="Up to K rays may be missing."
)
@click.option(
    "--missing-choice",
    type=click.Choice(["run", "step"]),
    help="Which rays: chosen once, or anew at every step  [default: run]",
)
@click.option("--missing-everywhere", is_flag=True, help="Not only in the turn.")
@click.option(
    "--mirror",
    "stretches",
    nargs=4,
    multiple=True,
    metavar="S F S F",
    help="A stretch of wall that may mirror, from one end to the other, m; may be repeated: at "
    "most one of them does.",
)
@click.option(
    "--mirror-incidence",
    metavar="DEG",
    help="Rays are lost at more than this from the wall's normal  [default: 45]",
)
@click.option(
    "--property",
    "safety",
    type=click.Choice(list(PROPERTIES)),
    default="clearance",
    show_default=True,
)
@click.option("--steps", type=int, default=70, show_default=True, help="Control periods.")
@click.option(
    "--fov",
    type=click.FloatRange(0, 360, min_open=True),
    help="Field of view in degrees  [default: 230, or 270 for 1081 rays]",
)
@click.option("--id", "name", help="ID of the instance  [default: the output file's name]")
@click.option("--category", default="custom", show_default=True)
@click.option("-o", "--output", type=FILE, required=True, help="JSON file to write.")
@json_option
def instance(
    onnx: Path,
    start: Range,
    front: Range,
    speed: Range,
    heading: Range,
    noise: str,
    missing: int,
    missing_choice: str | None,
    missing_everywhere: bool,
    stretches: tuple[tuple[str, str, str, str], ...],
    mirror_incidence: str | None,
    safety: str,
    steps: int,
    fov: float | None,
    name: str | None,
    category: str,
    output: Path,
    as_json: bool,
) -> None:
    """Make one instance for any controller.

    Numbers are kept as they are typed: a number that a double cannot keep is refused. Ranges
    take one number or two.
    """
    file = ControllerFile.load(onnx)
    view = default_field_of_view(file.controller.rays) if fov is None else math.radians(fov)
    mirrors = _mirrors(stretches, mirror_incidence)
    disturbance = _disturbance(noise, missing, missing_choice, missing_everywhere, mirrors)
    question = Question(
        name or output.stem,
        category,
        start,
        front,
        speed,
        heading,
        steps,
        safety,
        disturbance,
    )
    made = make_instance(question, file, view, output)
    save_instance(made, output)
    if as_json:
        print_json({"id": made.id, "file": str(output), "controller": made.controller.file})
    else:
        click.echo(f"wrote {output}: {made.id}")


def _mirrors(
    stretches: Sequence[tuple[str, str, str, str]], incidence: str | None
) -> dict[str, Any] | None:
    """Return the mirrors asked for, as data; BadInput if the options do not fit together."""
    if not stretches:
        if incidence is not None:
            raise BadInput("--mirror-incidence says how walls mirror; give --mirror as well")
        return None
    segments = []
    for stretch in stretches:
        s0, f0, s1, f1 = (float(exact_decimal(x)) for x in stretch)
        segments.append({"hall": 0, "begin": [s0, f0], "end": [s1, f1]})
    degrees = float(exact_decimal("45" if incidence is None else incidence))
    if not 0 <= degrees < 90:
        raise BadInput(f"--mirror-incidence is {incidence} degrees; give 0 or more, below 90")
    return {"segments": segments, "incidence": math.radians(degrees)}


def _disturbance(
    noise: str, missing: int, choice: str | None, everywhere: bool, mirrors: dict[str, Any] | None
) -> Disturbance | None:
    """Return the disturbance asked for; BadInput if the options do not fit together."""
    if not missing and (choice or everywhere):
        option = "--missing-choice" if choice else "--missing-everywhere"
        raise BadInput(f"{option} says which rays may be missing; give --missing K as well")
    data: dict[str, Any] = {
        "noise": float(exact_decimal(noise)),
        "missing": missing,
        "turn_only": not everywhere,
        "choice": choice or "run",
        "mirrors": mirrors,
    }
    if data["noise"] == 0 and not missing and mirrors is None:
        return None
    try:
        return parse_data(Disturbance, json.dumps(data))
    except BadInput as error:
        raise BadInput(f"--noise or --missing: {error}") from None
