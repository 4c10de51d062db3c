from __future__ import annotations

from collections.abc import Iterator

import pytest
from retraced import RetracingMonkeyPatch


@pytest.fixture
def monkeypatch() -> Iterator[pytest.MonkeyPatch]:
    """Return pytest's, for constants of kernels as well."""
    patch = RetracingMonkeyPatch()
    yield patch
    patch.undo()
