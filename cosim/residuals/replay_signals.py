"""Result of `replay` in Python."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.files.folders import replay_record
from cosim.files.results import read_results, rows_in
from cosim.simulation.run_signals import Signals


@dataclass(frozen=True, repr=False)
class Replay(Signals):
    """Signals of an FMU and a log, and `residual` for each horizon.

    Attributes:
        comparison: Errors of each channel; None if the result was read from a folder.
    """

    residual: Signals | None = None
    sentence: str = ""
    comparison: Any = None

    @property
    def _sentences(self) -> list[str]:
        return [self.sentence] if self.sentence else []


def read_replay(folder: Path, *, kept: bool = True) -> Replay | None:
    """Return the replay in a folder, or None.

    Args:
        kept: True if the folder is permanent.
    """
    files = rows_in(folder), rows_in(folder, "residual")
    if files[1] is None:
        return None
    record = replay_record(folder)
    places = [file or folder / "results.csv" for file in files]
    rows, missed = (read_results(file, record.get("units")) for file in places)
    place = folder if kept else None
    return Replay("replay", rows, place, Signals("residual", missed, place), record.get("sentence", ""))
