"""Result of `refine` in Python."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.files.folders import content_of
from cosim.fmi.building.refined import ANSWER, REFINED

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from cosim.estimation.subject.interface import Subject

COLOURS = {"before": "#8c8c8c", "recalibrated": "#56b4e9", "after": "#0072b2"}  # of the models in a figure


@dataclass(frozen=True, repr=False)
class Refined:
    """Result of a refinement: `record` is the content of refine.json; model.yaml and plant.fmu are in `folder`.

    Without a claim these two are the model as it was, and nearest.yaml predicts best.

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
        """Return the verdict in words."""
        return str(self.record.get("sentence", ""))

    @property
    def model(self) -> Path:
        """Return the path of model.yaml: the refined model, or without a claim the model as it was."""
        return self.folder / REFINED[0]

    @property
    def fmu(self) -> Path:
        """Return the path of plant.fmu: the FMU of model.yaml."""
        return self.folder / REFINED[1]

    def to_pandas(self) -> pandas.DataFrame:
        """Return the errors before and after by part and channel; raise ImportError without pandas."""
        try:
            import pandas
        except ImportError:
            raise ImportError("to_pandas needs pandas: pip install pandas") from None
        rows = [
            {"model": model, "part": part, "channel": channel, "rmse": value}
            for model, parts in dict(self.record.get("error") or {}).items()
            if isinstance(parts, Mapping)
            for part, channels in parts.items()
            if isinstance(channels, Mapping)
            for channel, value in channels.items()
        ]
        return pandas.DataFrame(rows, columns=["model", "part", "channel", "rmse"])

    def plot(self, part: str = "validation") -> Figure:
        """Plot the errors of each channel with matplotlib.

        Args:
            part: `validation` or `estimation` logs.

        Raises:
            ValueError: The record holds no errors of this part.
        """
        from cosim.report.figure import new_figure

        errors = {m: dict(self.record.get("error", {}).get(m, {}).get(part) or {}) for m in COLOURS}
        channels = list(dict.fromkeys(name for of in errors.values() for name in of))
        if not channels:
            raise ValueError(f'no errors of "{part}" are in refine.json; it holds estimation and validation')
        columns = min(4, len(channels))
        rows = -(-len(channels) // columns)
        figure = new_figure(2.4 * columns + 0.4, 2.4 * rows + 0.3)
        axes = figure.subplots(rows, columns, squeeze=False).ravel()
        for ax, channel in zip(axes, channels, strict=False):
            models = [m for m in COLOURS if errors[m].get(channel) is not None]
            ax.bar(models, [errors[m][channel] for m in models], color=[COLOURS[m] for m in models])
            ax.set_title(channel.replace("$", r"\$"), loc="left", fontsize=10)
            ax.tick_params(axis="x", labelsize=7.5)
            ax.spines[["top", "right"]].set_visible(False)
        for ax in axes[len(channels) :]:
            ax.set_axis_off()
        figure.suptitle(f"root mean square error, {part} logs", fontsize=10)
        return figure

    def __repr__(self) -> str:
        return f"{self.verdict}: {self.sentence}" if self.verdict else "stopped before a verdict"

    def _repr_html_(self) -> str:
        from cosim.core.notebook import heading, table

        rows = [
            (f"{effect['name']}.{name}", f"{p['value']:.5g}", p["unit"], " … ".join(f"{end:.5g}" for end in p["ci95"]))
            for effect in self.effects
            for name, p in effect["parameters"].items()
        ]
        found = table(("parameter", "value", "unit", "95 % interval"), rows) if rows else ""
        return heading(self.verdict, self.sentence) + found


def read_refined(folder: Path) -> Refined | None:
    """Return the result in a folder, or None."""
    record = content_of(folder / ANSWER)
    return Refined(record, folder) if record else None
