"""Results of a comparison as plain data."""

from __future__ import annotations

import math
from typing import Any

from cosim.residuals.compare import ChannelSummary, Comparison
from cosim.residuals.residual_statistics import FREE_RUN, Score


def as_json(comparison: Comparison) -> list[dict[str, Any]]:
    """Return RMSE, fit [%], rows and noise floor of each channel and horizon.

    Infinite values are None; `horizon` [s] is that of the verdict, None for the free run.
    """
    return [_channel(c) for c in comparison.channels]


def _channel(c: ChannelSummary) -> dict[str, Any]:
    return {
        "name": c.name,
        "unit": c.unit,
        "horizon": _finite(c.measure),
        **_score(c.scores[c.measure]),
        "noise_floor": _finite(c.floor.rmse),
        "times_noise": _finite(c.excess),
        "explained": c.is_explained,
        "free_run": _score(c.scores[FREE_RUN]),
        "windows": [{"horizon": h, **_score(s)} for h, s in sorted(c.scores.items()) if h != FREE_RUN],
    }


def _score(score: Score) -> dict[str, Any]:
    return {"rmse": _finite(score.rmse), "fit": _finite(score.fit), "rows": score.rows}


def _finite(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None
