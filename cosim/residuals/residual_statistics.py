"""Statistics of the residual, measured − model: size, whiteness and correlation with inputs.

NaN marks a missing measurement or prediction; every statistic uses the available rows.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from cosim.core.arrays import Array, NamedArrays, Rows, centre, correlation
from cosim.logs.log import NORMAL_95, slowness

FREE_RUN = math.inf  # horizon [s] that means a free run
LJUNG_BOX_LAGS = 20
COUNTS_FROM = 2.0  # multiple of the noise floor above which an error has an excess that can be reduced
STANDS_OUT = 2.0  # multiple of the 95 % band (four standard errors, by chance once in 10⁴ lags) for a clear correlation


@dataclass(frozen=True)
class Score:
    """Accuracy of the model's prediction of a channel.

    Attributes:
        rmse: Root mean square of measured − model, in the channel's unit.
        fit: 100·(1 − ‖y − ŷ‖ / ‖y − mean(y)‖) [%], NaN for a constant y.
        rows: Number of compared rows.
    """

    rmse: float
    fit: float
    rows: int


@dataclass(frozen=True, eq=False)
class Whiteness:
    """Autocorrelation ρ(k), k = 0 … L, its 95 % band for white noise, and the p-value of the Ljung–Box test."""

    rho: Array
    band: float
    p_value: float

    @property
    def white(self) -> bool:
        """Return True if the test does not reject whiteness at 1 %."""
        return self.p_value > 0.01


@dataclass(frozen=True, eq=False)
class InputCorrelation:
    """Correlation of the residual with an input `lags` rows earlier; a correlation at negative lags indicates feedback.

    Attributes:
        peak: Index of the largest |ρ| at a positive lag.
        strength: |ρ| at `peak`, relative to the 95 % band.
        ahead: True if |ρ| at `peak` clearly exceeds |ρ| at zero and negative lags.
        stands_out: True if |ρ| at `peak` is too large to be due to chance.
    """

    name: str
    lags: Rows
    rho: Array
    band: float
    peak: int
    strength: float
    ahead: bool
    stands_out: bool


def rmse(*errors: Array) -> float:
    """Return the RMSE of the finite values in all arrays together."""
    finite = np.concatenate([e[np.isfinite(e)] for e in errors]) if errors else np.zeros(0)
    with np.errstate(over="ignore"):  # a diverging model may overflow
        return math.sqrt(float(np.mean(finite * finite))) if finite.size else math.nan


def remaining_excess(before: float, after: float, floor: float) -> float:
    """Return (after² − floor²)/(before² − floor²); NaN if `before` does not clearly exceed the floor."""
    if not before > COUNTS_FROM * floor:
        return math.nan
    return (after * after - floor * floor) / (before * before - floor * floor)


def fit_percent(measured: Array, model: Array) -> float:
    """Return the NRMSE fit of MATLAB's `compare`: 100·(1 − ‖y − ŷ‖ / ‖y − mean(y)‖) [%]."""
    both = np.isfinite(measured) & np.isfinite(model)
    y = measured[both]
    spread = float(np.linalg.norm(y - y.mean())) if y.size else 0.0
    return 100.0 * (1.0 - float(np.linalg.norm(y - model[both])) / spread) if spread > 0.0 else math.nan


def score(measured: Array, model: Array) -> Score:
    """Return RMSE and fit over rows with both values."""
    error = measured - model
    return Score(rmse(error), fit_percent(measured, model), int(np.isfinite(error).sum()))


def whiteness(residual: Array, lags: int) -> Whiteness:
    """Return the autocorrelation and the Ljung–Box test (1978).

    Statistic: Q = n·(n + 2)·Σ ρ(k)²/(n − k) over the first lags.
    """
    from scipy.special import gammaincc

    z, weight = centre(residual)
    count = int(weight.sum())
    rho, pairs = correlation(z, weight, z, weight, lags)
    rho, pairs = rho[lags:], pairs[lags:]
    used = [k for k in range(1, min(LJUNG_BOX_LAGS, lags) + 1) if pairs[k] > 0 and math.isfinite(rho[k])]
    if not used:
        return Whiteness(rho, math.nan, math.nan)
    # With gaps, the number of pairs weights each lag; without gaps, this equals the formula above.
    q = (count + 2) / count * sum(pairs[k] * rho[k] ** 2 for k in used)
    chance = float(gammaincc(0.5 * len(used), 0.5 * q))  # probability of a larger χ²
    return Whiteness(rho, NORMAL_95 / math.sqrt(count), chance)


def input_correlations(residual: Array, inputs: NamedArrays, lags: int) -> tuple[InputCorrelation, ...]:
    """Return the correlation of the residual with each changing input, the strongest first.

    The band is Bartlett's, 1.96·√(Σ_k ρ_r(k)·ρ_u(k) / n), because slow signals correlate by chance.
    """
    z, weight = centre(residual)
    count, reach = int(weight.sum()), max(lags, residual.size // 4)
    everywhere = np.ones(residual.size)
    correlations = []
    for name, values in inputs.items():
        u = values - values.mean()
        if count < 3 or np.ptp(values) <= 1e-9 * max(1.0, float(np.abs(values).max())) or not np.any(z):
            continue
        own, _ = correlation(z, weight, z, weight, reach)
        overlap = float(np.nansum(own * correlation(u, everywhere, u, everywhere, reach)[0]))
        rho, _ = correlation(u, everywhere, z, weight, lags)
        band = NORMAL_95 * math.sqrt(max(1.0, overlap) / count)
        apart, known = np.arange(-lags, lags + 1), np.isfinite(rho)
        peak = int(np.argmax(np.where((apart > 0) & known, np.abs(rho), -1.0)))
        highest, before = abs(float(rho[peak])), np.abs(rho[(apart <= 0) & known])
        strength, ahead = highest / band, highest > 1.2 * float(before.max(initial=0.0))
        correlations.append(InputCorrelation(name, apart, rho, band, peak, strength, ahead, strength > STANDS_OUT))
    return tuple(sorted(correlations, key=lambda c: -c.strength))


def lags_of(rows: int, step: float, seconds: float = 1.0) -> int:
    """Return the number of lags within `seconds`; more time for a slow log, at most a quarter of the rows."""
    return max(1, min(round(seconds * slowness(step) / step), rows // 4))


def pool_errors(errors: Iterable[NamedArrays]) -> dict[str, float]:
    """Return channel → RMSE over several logs."""
    channels: dict[str, list[Array]] = {}
    for log in errors:
        for name, error in log.items():
            channels.setdefault(name, []).append(error)
    return {name: rmse(*parts) for name, parts in channels.items()}


def finite(value: float) -> float | None:
    """Return a number unchanged; None for infinity and NaN."""
    return float(value) if math.isfinite(value) else None
