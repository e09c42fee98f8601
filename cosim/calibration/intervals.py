"""Covariance of estimates under coloured residuals, and 95 % intervals.

The estimate is θ̂ = θ + A⁻¹·Σ_t K_t'·e_t with K = J/σ², A = J'·J/σ². The residuals of each output are modelled as an
autoregression e = ε/a(q), so that Σ K'·e = Σ K̃'·ε, where K̃ is K filtered backwards by 1/a. The sandwich
A⁻¹·(Σ K̃'·S·K̃)·A⁻¹ with the covariance S of ε needs no white residuals.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import pseudo_inverse
from cosim.calibration.likelihood import Jacobian, Likelihood, Point

MOST_LAGS = 30  # order of an autoregression
FEW = 8  # values for each lag
MANY = 50.0  # independent residuals for each unknown from which Student's factor is right
DRAWS, SEED = 99, 1  # repetitions for the factors of few residuals
SETTLING = 20  # multiple of the largest order before repeated residuals begin


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the estimates.

    Attributes:
        matrix: Covariance of all unknowns.
        factors: Half-width of the 95 % interval of each unknown in standard deviations.
        colour: Channel → variance of a mean of its residuals relative to white residuals.
    """

    matrix: Array
    factors: Array
    colour: Array

    def half(self, j: int) -> float:
        """Return the half-width of the 95 % interval of an unknown."""
        return float(self.factors[j]) * math.sqrt(max(0.0, float(self.matrix[j, j])))


@dataclass(frozen=True)
class Autoregression:
    """Residuals e of a channel: a(q)·e = ε, ε white with variance `variance`."""

    a: Array
    variance: float
    colour: float


def covariance(likelihood: Likelihood, point: Point, slopes: Jacobian) -> Covariance:
    """Return the covariance of the estimates at a point."""
    from scipy.special import stdtrit

    tables, counts, unknowns = point.residuals.tables, point.residuals.counts, point.x.size
    information, _ = likelihood.equations(point, slopes)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    inverse = pseudo_inverse(information / np.outer(scale, scale)) / np.outer(scale, scale)
    sandwich = _Sandwich(slopes, point.residuals.sigma, inverse, np.diag(likelihood.precision))
    models = sandwich.models(tables)
    matrix, spread = sandwich.covariance(tables, models)
    colour = np.array([m.colour for m in models])
    freedom = max(1.0, float(np.sum(counts / np.maximum(1.0, colour))) - unknowns)
    factors = np.full(unknowns, float(stdtrit(freedom, 0.975)))
    if freedom < MANY * unknowns:
        factors = np.maximum(factors, sandwich.quantiles(tables, models, spread))
    return Covariance(matrix, factors, colour)


@dataclass(frozen=True, eq=False)
class _Sandwich:
    """Everything that the covariances of the estimate and of its repetitions have in common."""

    slopes: Jacobian
    sigma: Array
    inverse: Array
    prior: Array

    def models(self, tables: Sequence[Array]) -> list[Autoregression]:
        """Return the autoregression of each channel."""
        return [_autoregression([t[np.isfinite(t[:, c]), c] for t in tables]) for c in range(self.sigma.size)]

    def covariance(self, tables: Sequence[Array], models: Sequence[Autoregression]) -> tuple[Array, Array]:
        """Return the covariance of the estimates, and of the channels' innovations."""
        innovations, filtered = [], []
        for table, slope in zip(tables, self.slopes, strict=True):
            whitened, smoothed = np.full(table.shape, np.nan), np.zeros(slope.shape)
            for c, model in enumerate(models):
                rows = np.isfinite(table[:, c])
                whitened[rows, c] = _whitened(model, table[rows, c])
                smoothed[rows, c] = _backwards(model, slope[rows, c] / self.sigma[c] ** 2)
            innovations.append(whitened)
            filtered.append(smoothed)
        spread = _spread(np.vstack(innovations))
        middle = self.prior
        for smoothed in filtered:
            rows = smoothed.transpose(1, 0, 2)
            for c, d in np.argwhere(spread != 0.0).tolist():
                middle = middle + spread[c, d] * rows[c].T @ rows[d]
        total = sum(int(np.isfinite(t).sum()) for t in tables)
        middle = middle * total / max(1, total - self.inverse.shape[0])
        return self.inverse @ middle @ self.inverse, spread

    def quantiles(self, tables: Sequence[Array], models: Sequence[Autoregression], spread: Array) -> Array:
        """Return the 95 % quantiles of |error|/standard deviation of the estimates, over repetitions.

        In each repetition the autoregressions make new residuals, from which the linearized estimate and its standard
        deviation are computed as from the log (bootstrap-t). That allows for the part of slow residuals that the
        parameters absorb, and for the uncertain colour.
        """
        rng, ratios = np.random.default_rng(SEED), []
        values, vectors = np.linalg.eigh(spread)
        root = vectors * np.sqrt(np.maximum(values, 0.0))
        for _ in range(DRAWS):
            drawn = [self._draw(t, models, root, rng) for t in tables]
            gradient = sum(
                np.einsum("tci,tc->i", np.nan_to_num(s), np.nan_to_num(e) / self.sigma**2)
                for s, e in zip(self.slopes, drawn, strict=True)
            )
            shift = -self.inverse @ gradient
            left = [e + s @ shift for s, e in zip(self.slopes, drawn, strict=True)]
            matrix, _ = self.covariance(left, self.models(left))
            ratios.append(np.abs(shift) / np.sqrt(np.maximum(np.diag(matrix), 1e-300)))
        return np.asarray(np.quantile(ratios, 0.95, axis=0))

    @staticmethod
    def _draw(table: Array, models: Sequence[Autoregression], root: Array, rng: np.random.Generator) -> Array:
        """Return residuals of the autoregressions at measured values."""
        from scipy.signal import lfilter

        count, settling = table.shape[0], SETTLING * MOST_LAGS
        noise = rng.standard_normal((count + settling, root.shape[0])) @ root.T
        drawn = np.full(table.shape, np.nan)
        for c, model in enumerate(models):
            rows = np.isfinite(table[:, c])
            drawn[rows, c] = lfilter([1.0], model.a, noise[:, c])[settling:][: int(rows.sum())]
        return drawn


def _autoregression(parts: Sequence[Array]) -> Autoregression:
    """Return the autoregression of a channel by Burg's method, of the order that Akaike's criterion prefers.

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
        k = _reflection(forward, backward)
        longer = np.append(a, 0.0)
        a = longer + k * longer[::-1]
        variance *= max(1e-12, 1.0 - k * k)
        pairs = [(f + k * b, b + k * f) for f, b in zip(forward, backward, strict=True)]
        forward, backward = [f for f, _ in pairs], [b for _, b in pairs]
        criterion = count * math.log(variance) + 2.0 * order * count / max(1, count - order - 2)
        if criterion < least:
            least, best = criterion, Autoregression(a, variance, variance / float(np.sum(a)) ** 2 / square)
    return best


def _reflection(forward: Sequence[Array], backward: Sequence[Array]) -> float:
    """Return the reflection coefficient with the smallest prediction errors."""
    pairs = [(float(f @ b), float(f @ f + b @ b)) for f, b in zip(forward, backward, strict=True)]
    size = sum(size for _, size in pairs)
    return -2.0 * sum(cross for cross, _ in pairs) / size if size > 0.0 else 0.0


def _whitened(model: Autoregression, values: Array) -> Array:
    from scipy.signal import lfilter

    return np.asarray(lfilter(model.a, [1.0], values))


def _backwards(model: Autoregression, columns: Array) -> Array:
    """Return columns filtered by 1/a from their end."""
    from scipy.signal import lfilter

    return np.asarray(lfilter([1.0], model.a, columns[::-1], axis=0)[::-1])


def _spread(innovations: Array) -> Array:
    """Return the covariance of the channels' innovations, from the rows that have both."""
    good = np.isfinite(innovations)
    values, weights = np.where(good, innovations, 0.0), good.astype(np.float64)
    pairs = weights.T @ weights
    matrix = values.T @ values / np.maximum(pairs, 1.0)
    roots = np.linalg.eigh(matrix)
    return np.asarray((roots[1] * np.maximum(roots[0], 0.0)) @ roots[1].T)
