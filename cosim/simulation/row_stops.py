"""Stop signals while the rows of a run are written, which takes long for many rows."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from cosim.base.messages import Note
from cosim.simulation import messages
from cosim.storage.results import Results

MANY_VALUES = 500_000  # written as text in about one second
SAME_PRESS = 0.5  # time [s] in which a program that started the command may pass on the same Ctrl-C once more


@dataclass
class RowStops:
    """What stop signals do while rows are written: a note on the first, the end of the rows at the next.

    Attributes:
        can_end: Whether the rows may end early.
        told: Time of the note [s]; None before it.
        is_over: Whether the rows shall end.
        written: Number of rows when they ended early; None for all rows.
    """

    results: Results
    file: Path
    tell: Callable[[str], None]
    can_end: bool = True
    told: float | None = None
    is_over: bool = False
    written: int | None = None

    def __post_init__(self) -> None:
        self.can_end &= self.file.suffix == ".csv"

    @property
    def count(self) -> int:
        """Return the number of rows in the file."""
        return len(self.results.time) if self.written is None else self.written

    def receive(self) -> None:
        """Take a stop signal."""
        rows, now = len(self.results.time), time.monotonic()
        if self.results.values.size < MANY_VALUES:
            return
        if self.told is None:
            self.told = now
            self.tell(
                messages.ROWS_ARE_WRITTEN(
                    rows=rows,
                    file=self.file,
                    end=Note("; Ctrl-C now ends that and keeps the rows written by then") * self.can_end,
                )
            )
        elif self.can_end and now - self.told > SAME_PRESS:
            self.is_over = True

    def go_on(self, rows: int) -> bool:
        """Return whether rows are to follow after a number of rows."""
        if self.is_over and rows < len(self.results.time):
            self.written = rows
        return self.written is None
