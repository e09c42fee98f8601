"""Errors before and after a refinement as a matplotlib figure."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from cosim.report.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

MODELS = {"before": "#8c8c8c", "recalibrated": "#56b4e9", "after": "#0072b2"}


def errors_figure(record: Mapping[str, Any], part: str) -> Figure:
    """Draw the RMSE of each channel with a bar per model.

    Raises:
        ValueError: The record has no errors of this part.
    """
    errors = {m: dict(record.get("error", {}).get(m, {}).get(part) or {}) for m in MODELS}
    channels = list(dict.fromkeys(name for of in errors.values() for name in of))
    if not channels:
        raise ValueError(f'no errors of "{part}" are in refine.json; it holds estimation and validation')
    columns = min(4, len(channels))
    rows = -(-len(channels) // columns)
    figure = new_figure(2.4 * columns + 0.4, 2.4 * rows + 0.3)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    for ax, channel in zip(axes, channels, strict=False):
        models = [m for m in MODELS if errors[m].get(channel) is not None]
        ax.bar(models, [errors[m][channel] for m in models], color=[MODELS[m] for m in models])
        ax.set_title(channel.replace("$", r"\$"), loc="left", fontsize=10)
        ax.tick_params(axis="x", labelsize=7.5)
        ax.spines[["top", "right"]].set_visible(False)
    for ax in axes[len(channels) :]:
        ax.set_axis_off()
    figure.suptitle(f"root mean square error, {part} logs", fontsize=10)
    return figure
