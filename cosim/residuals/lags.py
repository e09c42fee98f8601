"""Correlations over the lag, drawn and worded alike for what a replay leaves and for what a filter does not expect."""

from __future__ import annotations

import numpy as np

from cosim.arrays import Array, Rows
from cosim.report.panels import Panel
from cosim.report.svg import Plot, make_axis, make_plot
from cosim.residuals.statistics import Whiteness
from cosim.text import MISSING, plain


def stem_rows(test: Whiteness, most: int) -> Rows:
    """The lags, in rows, of about `most` stems of an autocorrelation; zero is left out."""
    return np.arange(1, test.rho.size)[:: max(1, test.rho.size // most)]


def stems(rho: Array, rows: Rows, step: float, shift: float = 0.0) -> tuple[Array, Array]:
    """Lags [s] and values of a curve that goes from zero to ρ at each row, with a gap; `shift`: of all, in rows."""
    values = np.stack((np.zeros(rows.size), rho[rows], np.full(rows.size, np.nan)), axis=1).ravel()
    return np.repeat((rows + shift) * step, 3), values


def over_lag(panel: Panel, lag: Array) -> Plot:
    """Draw a panel whose traces are over the lag [s], from the least to the largest."""
    axis = make_axis(float(lag.min()), float(lag.max()), 6)
    return make_plot(panel, lag, axis, limit=2 * lag.size, over="lag in s")


def neighbours(test: Whiteness) -> str:
    """The correlation from one row to the next, as text."""
    return plain(float(test.rho[1]), 2) if test.rho.size > 1 else MISSING
