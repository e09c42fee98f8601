"""Messages of an FMU that are recorded, in bounded memory."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

KEPT_FIRST, KEPT_LAST = 50, 50  # messages


class MessageLog:
    """The first and the last messages of an FMU, each text once, and the number of those between.

    Attributes:
        share: Function called with each message, if any.
    """

    def __init__(self) -> None:
        self.first: list[str] = []
        self.last: deque[str] = deque(maxlen=KEPT_LAST)
        self.omitted = 0
        self.share: Callable[[str], None] | None = None

    def __iter__(self) -> Iterator[str]:
        """Yield the messages, with a note in place of those between."""
        yield from self.first
        if self.omitted:
            yield str(
                f"{self.omitted:,} messages are left out here: the first {len(self.first)} and the last "
                f"{len(self.last)} are recorded"
            )
        yield from self.last

    def __getitem__(self, k: int) -> str:
        every: list[str] = [*self]
        return every[k]

    def append(self, text: str) -> None:
        """Add a message."""
        if self.share is not None:
            self.share(text)
        if text in self.first:
            return
        if len(self.first) < KEPT_FIRST:
            self.first.append(text)
            return
        if text in self.last:
            self.last.remove(text)
        self.omitted += len(self.last) == KEPT_LAST
        self.last.append(text)

    def state(self) -> dict[str, Any]:
        """Return the messages in JSON types."""
        return {"first": [*self.first], "last": [*self.last], "omitted": self.omitted}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the messages of a state."""
        self.first, self.omitted = list(state["first"]), int(state["omitted"])
        self.last = deque(state["last"], maxlen=KEPT_LAST)
