"""Result of `cosim.replay` in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.credibility.validity import validity_sentence
from cosim.files.folders import replay_record
from cosim.files.results import read_results, rows_in
from cosim.simulation.run_signals import Signals


@dataclass(frozen=True, repr=False)
class Replay(Signals):
    """Signals of an FMU and a log, and the residual for each horizon in `residual`.

    Attributes:
        validity: Validity of the free run in the region of the FMU's logs; empty for an FMU without a record of
            credibility.
        comparison: Errors of each channel; None if the result was read from a folder.
    """

    residual: Signals | None = None
    sentence: str = ""
    comparison: Any = None
    validity: Mapping[str, Any] = field(default_factory=dict)

    @property
    def _sentences(self) -> list[str]:
        return [text for text in (self.sentence, validity_sentence("FMU", self.validity)) if text]


def read_replay(folder: Path, *, kept: bool = True) -> Replay | None:
    """Return the replay in a folder; None if there is none.

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
    residual, validity = Signals("residual", missed, place), record.get("validity") or {}
    return Replay("replay", rows, place, residual, record.get("sentence", ""), validity=validity)
