"""Runs of a sweep read back in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.base.text import counted
from cosim.storage.folders import content_of

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True, repr=False)
class Runs:
    """The runs of a sweep.

    Attributes:
        record: Content of sweep.json.
        folder: Folder with sweep.parquet.
    """

    record: Mapping[str, Any]
    folder: Path

    def to_pandas(self) -> pandas.DataFrame:
        """Return one row per run: varied values, criteria, signals; raise ImportError without pandas."""
        try:
            import pandas  # noqa: F401
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        from cosim.sweeps.store import read_table

        frame: pandas.DataFrame = read_table(self.folder / "sweep.parquet")[0].to_pandas()
        return frame

    def __repr__(self) -> str:
        return (
            f"{self.record.get('name', 'sweep')}: {counted(int(self.record.get('runs') or 0), 'run')} in {self.folder}"
        )


def read_runs(folder: Path) -> Runs | None:
    """Return a completed sweep's runs in a folder."""
    if not all((folder / name).is_file() for name in ("sweep.json", "sweep.parquet")):
        return None
    return Runs(content_of(folder / "sweep.json"), folder)
