"""What is closed when the block that uses it ends, however it ends."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import AbstractContextManager
from types import TracebackType


class Closing(AbstractContextManager):
    """Base of objects that hold something: a lock, a process, a connection."""

    @abstractmethod
    def close(self) -> None:
        """Let go of it; a second time does nothing."""

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()
