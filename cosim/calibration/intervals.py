"""Covariance of estimates with coloured residuals, and 95 % intervals.

The estimate is θ̂ = θ + A⁻¹·Σ_t K_t'·e_t with K = J/σ², A = J'·J/σ². The residuals of each output are modelled as an
autoregression e = ε/a(q), so that Σ K'·e = Σ K̃'·ε, where K̃ is K filtered backwards by 1/a. The sandwich A⁻¹·(Σ
K̃'·S·K̃)·A⁻¹ with the covariance S of ε is also valid for residuals that are not white.

A profile is the deviance 2·(max ln L − ln L) as a function of one parameter, with all others estimated again at each
value. Its interval is asymmetric if the model is nonlinear in the parameter.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.calibration.fit_record import ProfileEntry
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Array
from cosim.estimation.fit import inverse as scaled_inverse
from cosim.logs.channel_noise import NORMAL_95

MOST_LAGS = 30  # largest order of an autoregression
FEW = 8  # values for each lag
MANY = 50.0  # independent residuals per unknown, above which Student's factor is accurate
DRAWS, SEED = 99, 1  # repetitions of the bootstrap for few residuals
SETTLING = 20  # initial transient of repeated residuals, as a multiple of the largest order
MOST_PROFILED = 10  # values of a profile on each side
NEAR_END = 0.02  # tolerance of the end of a profile's interval, in standard deviations
FARTHER = 2.0  # largest step of a profile, in half-widths


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the estimates.

    Attributes:
        matrix: Covariance of all unknowns.
        halves: Half-width of the 95 % interval of each unknown.
        white: Standard deviation of each unknown under the assumption of white residuals.
        colour: Channel → variance of a mean of its residuals relative to white residuals.
    """

    matrix: Array
    halves: Array
    white: Array
    colour: Array


class Autoregression(NamedTuple):
    """Residuals e of a channel: a(q)·e = ε, ε white with variance `variance`."""

    a: Array
    variance: float
    colour: float


def covariance(likelihood: Likelihood) -> Covariance:
    """Return the covariance of the estimates at the best point."""
    from scipy.signal import lfilter
    from scipy.special import stdtrit

    point, slopes = likelihood.best, likelihood.slopes
    sigma, unknowns = point.sigma, point.x.size
    weighted = [(s / sigma[:, None])[np.isfinite(t)] for s, t in zip(slopes, point.tables, strict=True)]
    information = np.diag(likelihood.precision) + sum(rows.T @ rows for rows in weighted)
    inverse = scaled_inverse(information)

    def sandwich(tables: Sequence[Array]) -> tuple[Array, Array, Sequence[Autoregression]]:
        """Return the covariance of the estimates, that of the channels' innovations, and the autoregressions."""
        models = [_autoregression([t[np.isfinite(t[:, c]), c] for t in tables]) for c in range(sigma.size)]
        innovations, filtered = [], []
        for table, slope in zip(tables, slopes, strict=True):
            whitened, smoothed = np.full(table.shape, np.nan), np.zeros(slope.shape)
            for c, model in enumerate(models):
                rows = np.isfinite(table[:, c])
                whitened[rows, c] = lfilter(model.a, [1.0], table[rows, c])
                backwards = (slope[rows, c] / sigma[c] ** 2)[::-1]
                smoothed[rows, c] = lfilter([1.0], model.a, backwards, axis=0)[::-1]
            innovations.append(whitened)
            filtered.append(smoothed)
        spread = _spread(np.vstack(innovations))
        middle = np.diag(likelihood.precision)
        for smoothed in filtered:
            parts = smoothed.transpose(1, 0, 2)
            for c, d in np.argwhere(spread != 0.0).tolist():
                middle = middle + spread[c, d] * parts[c].T @ parts[d]
        total = sum(int(np.isfinite(t).sum()) for t in tables)
        middle = middle * total / max(1, total - unknowns)
        return inverse @ middle @ inverse, spread, models

    matrix, spread, models = sandwich(point.tables)
    colour, white = np.array([m.colour for m in models]), np.sqrt(np.maximum(0.0, np.diag(inverse)))
    freedom = max(1.0, float(np.sum(point.counts / np.maximum(1.0, colour))) - unknowns)
    factors, roots = np.full(unknowns, float(stdtrit(freedom, 0.975))), np.sqrt(np.maximum(0.0, np.diag(matrix)))
    if freedom >= MANY * unknowns:
        return Covariance(matrix, factors * roots, white, colour)
    # In each repetition the autoregressions generate new residuals. The linearized estimate and its standard deviation
    # are computed from them as from the log (bootstrap-t). This accounts for the slow residuals that the parameters
    # absorb, and for the uncertain autoregressions.
    rng, ratios = np.random.default_rng(SEED), []
    values, vectors = np.linalg.eigh(spread)
    root, settling = vectors * np.sqrt(np.maximum(values, 0.0)), SETTLING * MOST_LAGS
    for _ in range(DRAWS):
        drawn = []
        for table in point.tables:
            noise = rng.standard_normal((table.shape[0] + settling, root.shape[0])) @ root.T
            residual = np.full(table.shape, np.nan)
            for c, model in enumerate(models):
                rows = np.isfinite(table[:, c])
                residual[rows, c] = lfilter([1.0], model.a, noise[:, c])[settling:][: int(rows.sum())]
            drawn.append(residual)
        gradient = sum(
            np.einsum("tci,tc->i", np.nan_to_num(s), np.nan_to_num(e) / sigma**2)
            for s, e in zip(slopes, drawn, strict=True)
        )
        shift = -inverse @ gradient
        repeated, _, _ = sandwich([e + s @ shift for s, e in zip(slopes, drawn, strict=True)])
        ratios.append(np.abs(shift) / np.sqrt(np.maximum(np.diag(repeated), 1e-300)))
    return Covariance(matrix, np.maximum(factors, np.quantile(ratios, 0.95, axis=0)) * roots, white, colour)


def profile(likelihood: Likelihood, spread: Covariance, j: int) -> ProfileEntry | None:
    """Return the profile of an unknown, None if it has no interval.

    The deviance is scaled to 1.96² at the ends of the interval from the covariance if the model is linear in the
    parameter: residuals that are not white widen both intervals equally (composite likelihood).
    """
    best, half = likelihood.best, float(spread.halves[j])
    if not (math.isfinite(half) and half > 0.0 and spread.white[j] > 0.0):
        return None
    others = np.arange(best.x.size) != j
    scale = (NORMAL_95 * float(spread.white[j]) / half) ** 2

    def root(value: float, start: Array) -> tuple[float, Array]:
        """Return the root of the scaled deviance at a value, infinite if the FMU fails, and the other unknowns."""
        inner = likelihood.restricted(others, at=value)
        if inner.point(start) is None:
            return math.inf, start
        if others.any():
            inner.maximize(lambda iteration: None)
        own = 0.5 * float(likelihood.precision[j]) * (value - float(likelihood.prior[j])) ** 2
        return math.sqrt(max(0.0, 2.0 * scale * (inner.best.cost + own - best.cost))), inner.best.x

    centre, ends = float(best.x[j]), list[float | None]()
    points = {centre: 0.0}
    for side, bound in ((-1.0, float(likelihood.low[j])), (1.0, float(likelihood.high[j]))):
        inside, outside, start = (centre, 0.0), (math.nan, math.inf), best.x[others]
        step, end = 0.5 * half, None
        for _ in range(MOST_PROFILED):
            value = inside[0] + side * step
            value = max(value, bound) if side < 0.0 else min(value, bound)
            here, reached = root(value, start)
            if math.isfinite(here):
                points[value] = here**2
            if abs(here - NORMAL_95) < NEAR_END:
                end = value
                break
            if here < NORMAL_95:
                inside, start = (value, here), reached
                if value == bound:
                    break
            else:
                outside = value, here
            step = abs(outside[0] - inside[0])  # NaN until a value is outside
            if math.isfinite(outside[1]):  # the root of the deviance is nearly linear
                step = step * ((NORMAL_95 - inside[1]) / (outside[1] - inside[1]))
            elif math.isfinite(step):
                step = 0.5 * step
            else:
                slope = inside[1] / abs(inside[0] - centre) if inside[1] else 0.0
                step = min((NORMAL_95 - inside[1]) / slope if slope else math.inf, FARTHER * half)
        ends.append(end)
    values = sorted(points)
    return ProfileEntry(values=values, deviance=[points[v] for v in values], ci95=(ends[0], ends[1]))


def _autoregression(parts: Sequence[Array]) -> Autoregression:
    """Return the autoregression of a channel by Burg's method; Akaike's criterion selects the order.

    Args:
        parts: Residuals of each log without missing values.
    """
    parts = [p for p in parts if p.size]
    count = sum(p.size for p in parts)
    square = sum(float(p @ p) for p in parts) / max(1, count)
    a, best = np.ones(1), Autoregression(np.ones(1), square, 1.0)
    if square <= 0.0:
        return best
    forward, backward, variance, least = list(parts), list(parts), square, count * math.log(square)
    for order in range(1, min(MOST_LAGS, count // FEW) + 1):
        forward, backward = [f[1:] for f in forward], [b[:-1] for b in backward]
        products = [(float(f @ b), float(f @ f + b @ b)) for f, b in zip(forward, backward, strict=True)]
        size = sum(size for _, size in products)
        # reflection coefficient with the smallest prediction error
        k = -2.0 * sum(cross for cross, _ in products) / size if size > 0.0 else 0.0
        longer = np.append(a, 0.0)
        a = longer + k * longer[::-1]
        variance *= max(1e-12, 1.0 - k * k)
        pairs = [(f + k * b, b + k * f) for f, b in zip(forward, backward, strict=True)]
        forward, backward = [f for f, _ in pairs], [b for _, b in pairs]
        criterion = count * math.log(variance) + 2.0 * order * count / max(1, count - order - 2)
        if criterion < least:
            least, best = criterion, Autoregression(a, variance, variance / float(np.sum(a)) ** 2 / square)
    return best


def _spread(innovations: Array) -> Array:
    """Return the covariance of the channels' innovations, for each pair of channels from rows with both."""
    good = np.isfinite(innovations)
    values, weights = np.where(good, innovations, 0.0), good.astype(np.float64)
    pairs = weights.T @ weights
    matrix = values.T @ values / np.maximum(pairs, 1.0)
    roots = np.linalg.eigh(matrix)
    return np.asarray((roots[1] * np.maximum(roots[0], 0.0)) @ roots[1].T)
