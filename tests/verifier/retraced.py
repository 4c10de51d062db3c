"""Patches of constants that kernels are made of: the kernels are traced anew."""

from __future__ import annotations

import pytest

from verifier.compiled.kernel import forget


class RetracingMonkeyPatch(pytest.MonkeyPatch):
    def setattr(self, *args, **kwargs) -> None:
        super().setattr(*args, **kwargs)
        forget()

    def undo(self) -> None:
        super().undo()
        forget()
