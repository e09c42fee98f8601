"""Plots of correlations over the lag, for residuals of replays and innovations of filters."""

from __future__ import annotations

import numpy as np

from cosim.base.arrays import Rows
from cosim.base.text import MISSING, plain
from cosim.report.charts import Abscissa, Charts, Drawing
from cosim.residuals.residual_statistics import Whiteness


def every_lag(count: int, most: int) -> Rows:
    """Return about `most` of `count` lags [rows]."""
    return np.arange(1, count + 1)[:: max(1, (count + 1) // most)]


def lag_drawing(charts: Charts, rows: Rows, step: float) -> Drawing:
    """Return panels over the lag [s], with half a lag free at both ends."""
    half = 0.5 * (rows[1] - rows[0] if rows.size > 1 else 1)
    ends = float(step * (rows[0] - half)), float(step * (rows[-1] + half))
    return charts.over(step * rows.astype(np.float64), Abscissa(("lag", "s"), ends))


def neighbours(test: Whiteness) -> str:
    """Return the autocorrelation of neighbouring rows as text."""
    return plain(float(test.rho[1]), 2) if test.rho.size > 1 else MISSING
