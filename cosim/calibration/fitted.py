"""Result of `cosim.fit` in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.extras import pandas_for_frames
from cosim.files.folders import content_of

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, repr=False)
class Fitted:
    """Result of a fit: `record` is the content of fit.json.

    Attributes:
        folder: Folder of the files; None if nothing was written.
        warnings: Warnings and notes of the estimate.
    """

    record: Mapping[str, Any]
    folder: Path | None = None
    warnings: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """Return the verdict: improved, unchanged, worse or stopped."""
        return str(self.record.get("verdict", ""))

    @property
    def sentence(self) -> str:
        """Return the verdict as a sentence."""
        return str(self.record.get("sentence", ""))

    @property
    def _entries(self) -> dict[str, Any]:
        return dict(self.record.get("parameters") or {})

    @property
    def values(self) -> dict[str, float]:
        """Return parameter → estimate."""
        return {name: entry["value"] for name, entry in self._entries.items()}

    @property
    def intervals(self) -> dict[str, tuple[float, float] | None]:
        """Return parameter → 95 % interval; None if the logs do not determine the parameter alone."""
        return {name: entry["ci95"] and tuple(entry["ci95"]) for name, entry in self._entries.items()}

    def to_pandas(self) -> pandas.DataFrame:
        """Return one row per parameter; raise ImportError without pandas."""
        rows = []
        for name, entry in self._entries.items():
            low, high = entry["ci95"] or (None, None)
            rows.append({"parameter": name, **entry, "ci95_low": low, "ci95_high": high})
        frame: pandas.DataFrame = pandas_for_frames().DataFrame(rows)
        return frame.drop(columns="ci95", errors="ignore")

    def plot(self) -> Figure:
        """Plot the estimates with their intervals, relative to the values before, with matplotlib."""
        from cosim.report.cell.cell import new_figure

        figure = new_figure()
        axes = figure.add_subplot()
        for row, entry in enumerate(self._entries.values()):
            ends = *(entry["ci95"] or ()), entry["value"]
            changes = [(end - entry["start"]) / (abs(entry["start"]) or 1.0) for end in ends]
            axes.plot([min(changes), max(changes)], [row, row], "-")
            axes.plot(changes[-1:], [row], "o")
        axes.set_yticks(range(len(self._entries)), list(self._entries))
        axes.axvline(0.0, linestyle="--")
        axes.set_xlabel("change relative to the value before")
        return figure

    def __repr__(self) -> str:
        values = ", ".join(f"{name} = {value:.5g}" for name, value in self.values.items())
        return f"{self.sentence}\n  {values}".rstrip()

    def _repr_html_(self) -> str:
        from cosim.core.notebook import heading, table

        rows = [
            (
                *(name, f"{entry['start']:.5g}", f"{entry['value']:.5g}", entry["unit"]),
                " … ".join(f"{end:.5g}" for end in entry["ci95"] or ()) or entry["status"],
            )
            for name, entry in self._entries.items()
        ]
        estimates = table(("parameter", "before", "estimate", "unit", "95 % interval"), rows) if rows else ""
        return heading(self.verdict, self.sentence) + estimates


def read_fitted(folder: Path) -> Fitted | None:
    """Return the fit in a folder; None if it has none."""
    record = content_of(folder / "fit.json")
    return Fitted(record, folder) if record else None
