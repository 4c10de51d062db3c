"""What the blocks of all hyper-parameter files share."""

from __future__ import annotations

import hashlib
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Positive = Annotated[int, Field(gt=0)]


class Arguments(BaseModel):
    """Named numbers; unknown names are refused."""

    model_config = ConfigDict(extra="forbid")

    def sha256(self) -> str:
        """Return a hash of the values, however the file that they came from is laid out."""
        return hashlib.sha256(self.model_dump_json(exclude_none=True).encode()).hexdigest()
