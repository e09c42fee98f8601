"""Result of `refine`: for users of Python, and with all data for the report."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.core.extras import pandas_for_frames
from cosim.files.folders import content_of
from cosim.fmi.building.refined import REFINE_RECORD, REFINED

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from cosim.estimation.problem import Problem
    from cosim.estimation.subject.interface import Subject
    from cosim.refinement.decision.claims import Claims
    from cosim.refinement.proof.measure import Part, ReplayedLogs, Variant
    from cosim.refinement.study import Study


@dataclass(frozen=True)
class Refinement:
    """Result of a study, with all data for its report."""

    study: Study
    verdict: Claims
    record: Mapping[str, Any]
    folder: Path
    problem: Problem
    variants: Mapping[str, Variant]
    evidence: Mapping[str, Mapping[Part, ReplayedLogs]]  # before, recalibrated, after → estimation, validation
    risen: Mapping[str, tuple[float, float]]  # channel → error before and after, for errors that rise on sealed logs


@dataclass(frozen=True, repr=False)
class Refined:
    """Result of a refinement: `record` is the content of refine.json; model.yaml and plant.fmu are in `folder`.

    Without a claim, both files are the given model, and nearest.yaml is the model with the best predictions.

    Attributes:
        subject: The refined object; None if the result was read from a folder.
        details: Study, fits and verdict as objects; None if the result was read from a folder.
    """

    record: Mapping[str, Any]
    folder: Path
    subject: Subject | None = None
    details: Any = None

    @property
    def verdict(self) -> str:
        """Return the verdict: effect_found, parameter_error, sensor_error, no_effect, ambiguous or unexplained."""
        return str(self.record.get("verdict", ""))

    @property
    def effects(self) -> list[dict[str, Any]]:
        """Return the claimed effects, most important first."""
        return list(self.record.get("effects") or ())

    @property
    def sentence(self) -> str:
        """Return the verdict as text."""
        return str(self.record.get("sentence", ""))

    @property
    def model(self) -> Path:
        """Return the path of model.yaml: the refined model; without a claim, the given model."""
        return self.folder / REFINED[0]

    @property
    def fmu(self) -> Path:
        """Return the path of plant.fmu: the FMU of model.yaml."""
        return self.folder / REFINED[1]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the errors before and after by part and channel; raise ImportError without pandas."""
        rows = [
            {"model": model, "part": part, "channel": channel, "rmse": value}
            for model, parts in dict(self.record.get("error") or {}).items()
            for part, channels in (parts or {}).items()
            for channel, value in channels.items()
        ]
        frame: pandas.DataFrame = pandas_for_frames().DataFrame(rows, columns=["model", "part", "channel", "rmse"])
        return frame

    def plot(self, part: str = "validation") -> Figure:
        """Plot the errors of each channel with matplotlib.

        Args:
            part: `validation` or `estimation` logs.

        Raises:
            ValueError: There are no errors for this set of logs.
        """
        from cosim.report.cell.cell import new_figure

        models = ("before", "recalibrated", "after")
        errors = {m: dict(self.record.get("error", {}).get(m, {}).get(part) or {}) for m in models}
        channels = list(dict.fromkeys(name for of in errors.values() for name in of))
        if not channels:
            raise ValueError(f'refine.json has no errors of "{part}"; give estimation or validation')
        figure = new_figure()
        for ax, channel in zip(figure.subplots(1, len(channels), squeeze=False).ravel(), channels, strict=True):
            values = {m: of[channel] for m, of in errors.items() if channel in of}
            ax.bar(values.keys(), values.values())
            ax.set_title(channel.replace("$", r"\$"))
            ax.tick_params("x", rotation="vertical")
        figure.suptitle(f"root mean square error, {part} logs")
        return figure

    def __repr__(self) -> str:
        return f"{self.verdict}: {self.sentence}" if self.verdict else "stopped before a verdict"

    def _repr_html_(self) -> str:
        from cosim.core.notebook import heading, table

        rows = [
            (f"{effect['name']}.{name}", f"{p['value']:g}", p["unit"], " … ".join(f"{end:g}" for end in p["ci95"]))
            for effect in self.effects
            for name, p in effect["parameters"].items()
        ]
        found = table(("parameter", "value", "unit", "95 % interval"), rows) if rows else ""
        return heading(self.verdict, self.sentence) + found


def read_refined(folder: Path) -> Refined | None:
    """Return the result in a folder; None if there is none."""
    record = content_of(folder / REFINE_RECORD)
    return Refined(record, folder) if record else None
