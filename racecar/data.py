"""What all JSON files share: strict fields, finite numbers, no key given twice."""

from __future__ import annotations

import json
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from racecar.errors import BadInput

Number = Annotated[float, Field(allow_inf_nan=False)]
NotNegative = Annotated[float, Field(allow_inf_nan=False, ge=0)]
Positive = Annotated[float, Field(allow_inf_nan=False, gt=0)]


class Data(BaseModel):
    """Base of what files hold: unknown fields are refused."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False)


AnyData = TypeVar("AnyData", bound=BaseModel)


def parse_data(kind: type[AnyData], text: str | bytes) -> AnyData:
    """Read JSON text strictly; BadInput says in one line where and what is wrong.

    A key that an object gives twice is refused: readers differ in which of the two they take.
    """
    try:
        data = kind.model_validate_json(text, strict=True)
    except ValidationError as error:
        first, count = error.errors()[0], error.error_count()
        place = ".".join(str(x) for x in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        more = f" (and {count - 1} more)" if count > 1 else ""
        raise BadInput(f"{place + ': ' if place else ''}{message}{more}") from None
    # Numbers stay text here: only the keys matter.
    json.loads(text, object_pairs_hook=_refuse_repeats, parse_int=str, parse_float=str)
    return data


def _refuse_repeats(pairs: list[tuple[str, Any]]) -> None:
    seen = set()
    for key, _ in pairs:
        if key in seen:
            raise BadInput(f"the key {json.dumps(key)} is given twice in one object")
        seen.add(key)
