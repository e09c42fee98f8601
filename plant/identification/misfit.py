"""Tests of fit residuals: the shape of a mean response, and the drift of a cell.

Each test has the false alarm probability `FALSE_ALARM`. The reference is the scatter of the recordings themselves, so
no threshold is needed; correlated noise counts as fewer readings.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cosim.base.arrays import Array

FALSE_ALARM = 1e-3  # false alarm probability of each test
MIN_FREEDOM = 4  # degrees of freedom for a test of one group or two
DRAWS = 20_000  # normal samples for the quantile at `FALSE_ALARM`
SLIP, SLIP_PLACES = 8.0, 40  # standard errors of a jump, and rows on trial for it
SLIP_OVER_CURVE = 1.3  # improvement by a jump, relative to that by a smooth curve of two more terms
SHARE = 0.5  # share of a misfit that a single cause must explain


@dataclass(frozen=True)
class Misfit:
    """Mean residual of repetitions by row, and its covariance by scatter and calibration.

    Attributes:
        freedom: Degrees of freedom of the mean residual.
        repetitions: Number of repetitions.
    """

    mean: Array
    covariance: Array
    freedom: float
    repetitions: int

    def size(self, residual: Array | None = None) -> float:
        """Return the squared length of a residual, by default the mean one, relative to the covariance."""
        values = self.mean if residual is None else residual
        return float(values @ np.linalg.solve(self.covariance, values))

    def exceeds_chance(self, size: float, freedom: float) -> bool:
        """Return True if a squared length with `freedom` degrees of freedom is larger than by chance."""
        from scipy import stats

        spare = self.freedom * (self.repetitions - 1)
        return size / freedom > float(stats.f.ppf(1.0 - FALSE_ALARM, freedom, spare))

    @property
    def is_significant(self) -> bool:
        """Return True if the mean response misses the fit beyond its scatter."""
        return self.size() > 0.0 and self.exceeds_chance(self.size(), self.freedom)


def misfit(each: Array, shifts: Array, parameters: int) -> Misfit | None:
    """Return the misfit of residuals, None without scatter or with too few rows.

    Args:
        each: Residuals, shape (repetitions, rows).
        shifts: Change of the mean by each calibration point's error, shape (points, rows).
        parameters: Number of parameters fitted to each repetition.
    """
    count, rows = each.shape
    mean = each.mean(axis=0)
    scatter = each - mean
    freedom = rows - parameters
    if freedom < 1 or count < 2:
        return None
    variance = float((scatter**2).sum()) / (freedom * (count - 1))
    if variance <= 0.0:
        return None
    covariance = variance / count * np.eye(rows) + shifts.T @ shifts
    return Misfit(mean, covariance, max(1.0, freedom / _correlation_factor(scatter, 2.0)), count)


def residuals(values: Array, basis: Array) -> Array:
    """Return the residual of a least-squares fit."""
    return np.asarray(values - basis @ np.linalg.lstsq(basis, values, rcond=None)[0])


def sine_basis(angle: Array) -> Array:
    """Return sine, cosine and constant, one column each."""
    return np.column_stack((np.sin(angle), np.cos(angle), np.ones_like(angle)))


@dataclass(frozen=True)
class Drift:
    """Drift during the recordings: a coefficient for each recording, 0 without drift, and its standard error by noise.

    Attributes:
        is_above_noise: True if the mean exceeds the noise of the readings.
        is_significant: True if the mean also exceeds scatter and calibration error.
    """

    each: Array
    errors: Array
    is_above_noise: bool
    is_significant: bool

    @property
    def worst(self) -> int:
        """Return the index of the most significant recording."""
        return int(np.argmax(np.abs(self.each) / self.errors))

    @property
    def mean(self) -> float:
        """Return the mean over the recordings."""
        return float(self.each.mean())


def drift(values: Sequence[Array], bases: Sequence[Array], calibration: float = 0.0) -> Drift | None:
    """Fit each recording by its basis, and return the last column's coefficients; None for noise-free readings.

    Args:
        calibration: Common standard error of the coefficients by calibration.
    """
    from scipy import stats

    each, errors, freedom = [], [], 0
    for y, basis in zip(values, bases, strict=True):
        if y.size <= basis.shape[1] + 1:
            return None
        free = residuals(basis[:, -1], basis[:, :-1])
        rest = residuals(y, basis)
        spare = y.size - basis.shape[1]
        variance = float(rest @ rest) / spare * _correlation_factor(rest[None], 1.0)
        if variance <= 0.0 or not free @ free > 0.0:
            return None
        each.append(float(free @ y / (free @ free)))
        errors.append(float(np.sqrt(variance / (free @ free))))
        freedom += spare
    count = len(each)
    coefficients, noise = np.array(each), np.array(errors)
    mean = abs(float(coefficients.mean()))
    by_noise = float(np.sqrt((noise**2).sum())) / count
    is_above_noise = mean > stats.t.ppf(1.0 - FALSE_ALARM / 2.0, freedom) * by_noise
    if count < 2:
        return Drift(coefficients, noise, bool(is_above_noise), is_significant=False)
    scatter = float(coefficients.var(ddof=1)) / count
    variance = scatter + calibration**2
    spare = min((count - 1) * variance**2 / max(scatter**2, 1e-300), 1e6)  # Welch and Satterthwaite
    beyond = mean > stats.t.ppf(1.0 - FALSE_ALARM / 2.0, spare) * np.sqrt(variance)
    return Drift(coefficients, noise, bool(is_above_noise), bool(is_above_noise and beyond))


def find_slip(values: Sequence[Array], bases: Sequence[Array]) -> tuple[int, float] | None:
    """Return recording and size of the largest jump of the residual that no smooth curve explains; None without one.

    A jump within a recording is compared with a quadratic and a cubic term in the row number.
    """
    slips = [_largest_jump(y, basis) for y, basis in zip(values, bases, strict=True)]
    if not any(slips):
        return None
    worst = int(np.argmax(np.abs(slips)))
    return worst, slips[worst]


def _largest_jump(values: Array, basis: Array) -> float:
    """Return the size of the jump that explains most of a residual, 0 if a smooth curve or noise explains as much."""
    rows, x = np.arange(values.size), np.linspace(-1.0, 1.0, values.size)
    basis = np.column_stack((basis, x))
    rest = residuals(values, basis)
    places = np.linspace(0.1 * rows.size, 0.9 * rows.size, SLIP_PLACES).astype(int)
    jumps = [residuals(np.where(rows >= place, 1.0, 0.0), basis) for place in places]
    gains = [float(jump @ rest) ** 2 / float(jump @ jump) for jump in jumps]
    best = int(np.argmax(gains))
    size = float(jumps[best] @ rest) / float(jumps[best] @ jumps[best])
    noise = rest - size * jumps[best]
    variance = float(noise @ noise) / max(1, rows.size - basis.shape[1] - 1) * _correlation_factor(noise[None], 1.0)
    smooth = residuals(values, np.column_stack((basis, x**2, x**3)))
    by_curve = float(rest @ rest) - float(smooth @ smooth)
    return size if gains[best] > max(SLIP**2 * variance, SLIP_OVER_CURVE * by_curve) else 0.0


def is_quieter(before: Sequence[Array], after: Sequence[Array]) -> bool:
    """Return whether readings vary less from row to row than before, beyond chance."""
    from scipy import stats

    # differences of separate pairs, so that each reading counts once
    one, other = (np.concatenate([v[1::2] - v[: v.size - v.size % 2 : 2] for v in part]) for part in (before, after))
    if min(one.size, other.size) < 2 or not one.any():
        return False
    ratio = float(np.mean(other**2) / np.mean(one**2))
    return ratio < float(stats.f.ppf(FALSE_ALARM, other.size, one.size))


def odd_group(groups: Sequence[Array]) -> tuple[int, list[int]]:
    """Return the index of the group with two clusters, and the indices of the smaller cluster; (0, []) without one.

    All groups have equal scatter. The statistic is the scatter after the best split of one group relative to that
    without a split, compared with its quantile for normal values.
    """
    if sum(v.size - 1 for v in groups) < MIN_FREEDOM or not any(np.ptp(v) > 0.0 for v in groups):
        return 0, []
    rng = np.random.default_rng(0)
    normal, _, _ = _split([rng.standard_normal((DRAWS, v.size)) for v in groups])
    ratio, place, size = _split([v[None] for v in groups])
    if ratio[0] >= float(np.quantile(normal, FALSE_ALARM)):
        return 0, []
    values, first = groups[int(place[0])], int(size[0])
    order = np.argsort(values)
    chosen = order[:first] if 2 * first <= values.size else order[first:]
    return int(place[0]), sorted(int(k) for k in chosen)


def _split(groups: Sequence[Array]) -> tuple[Array, Array, Array]:
    """Return for each row the best split of a group in two: remaining scatter, group, and size of the lower part."""
    total = sum(((v - v.mean(axis=1, keepdims=True)) ** 2).sum(axis=1) for v in groups)
    gains, sizes = [], []
    for v in groups:
        low = np.cumsum(np.sort(v - v.mean(axis=1, keepdims=True), axis=1), axis=1)[:, :-1]
        size = np.arange(1, v.shape[1])
        gain = low**2 * (1.0 / size + 1.0 / (v.shape[1] - size))  # the upper part sums to -low
        best = np.argmax(gain, axis=1)
        gains.append(np.take_along_axis(gain, best[:, None], axis=1)[:, 0])
        sizes.append(size[best])
    place = np.argmax(gains, axis=0)
    rows = np.arange(place.size)
    return 1.0 - np.array(gains)[place, rows] / total, place, np.array(sizes)[place, rows]


def _correlation_factor(scatter: Array, power: float) -> float:
    """Return how many correlated rows count as one.

    Args:
        power: 1 for the variance of a mean, 2 for that of a sum of squares; assumes first-order noise.
    """
    size = scatter.shape[1]
    first = float((scatter[:, 1:] * scatter[:, :-1]).sum()) / max(float((scatter**2).sum()), 1e-300)
    near = min(first, 1.0 - 2.0 / max(size, 3)) if first > 2.0 / np.sqrt(scatter.size) else 0.0  # 0 for white noise
    return float((1.0 + near**power) / (1.0 - near**power))
