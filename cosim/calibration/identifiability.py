"""What logs determine: screened parameters, combinations without effect, covariance and intervals."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.calibration.fit_record import ChoiceEntry, CombinationEntry, Form, ProfileEntry
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Array, Flags, Rows
from cosim.core.linear_algebra import least_squares, orthonormal, square_roots
from cosim.core.text import join_names, plain
from cosim.estimation.fit import inverse as scaled_inverse
from cosim.logs.log import NORMAL_95
from cosim.residuals.residual_statistics import finite

SCREENING_STEPS = (0.01, 0.1)  # relative steps of a screened parameter
ROUNDING_CHANGE = 1e-9  # change of every output, relative to its standard deviation, below which it is rounding
MIN_NOISE_LEVEL = 5e-3  # minimum noise level for a choice, relative to the standard deviation: models are not perfect
MAX_HALF_WIDTH = 0.5  # largest half-width of the expected interval of a parameter to estimate, relative to its value
MIN_OWN_SHARE = 0.03  # share of a sensitivity not reproduced by other parameters; differences are accurate to a third
SUSPECT_SINGULAR_VALUE = 0.02  # singular value relative to the largest, below which a combination is tried
TRIED_STEP = 0.1  # relative step of a combination that is tried
MAX_INVISIBLE_CHANGE = 0.01  # change of the outputs relative to that by one parameter alone
MIN_COMPONENT = 0.2  # component of a direction relative to the largest
COMBINATION_SIGNS = {"ratio": " / ", "product": " · ", "sum": " + ", "difference": " − "}


def screen(likelihood: Likelihood) -> tuple[list[ChoiceEntry], Flags]:
    """Return selected and rejected parameters with reasons, and an array that is True for each selected unknown.

    Each parameter is changed by 1 % and by 10 % of its scale. Parameters with an effect are ranked by pivoted QR of
    their sensitivities: the next parameter is the one that selected parameters reproduce least.
    """
    logs, good = likelihood.logs, [np.isfinite(t) for t in likelihood.best.tables]
    sigma = np.maximum(logs.noise, MIN_NOISE_LEVEL * logs.spread)  # the sensor noise, or the resolution of models
    shares = np.concatenate([np.broadcast_to(sigma / logs.spread, g.shape)[g] for g in good])

    def changed(j: int, change: float) -> Array | None:
        """Return the change of the residuals, in noise levels, by a change of an unknown; None if the FMU fails."""
        for side in (1.0, -1.0):
            move = np.zeros(len(likelihood.unknowns))
            move[j] = side * change * likelihood.scales[j]
            if (tables := _changes(likelihood, move)) is not None:
                return np.concatenate([(side * t / sigma)[g] for t, g in zip(tables, good, strict=True)])
        return None

    names, effects, reasons = list[str](), list[float](), list[str]()
    columns, nuisance = list[Array](), list[Array]()
    for j, unknown in enumerate(likelihood.unknowns):
        if unknown.log is not None:
            if (moved := changed(j, SCREENING_STEPS[0])) is not None:
                nuisance.append(moved)
            continue
        tried = {c: moved for c in SCREENING_STEPS if (moved := changed(j, c)) is not None}
        largest = max((np.nanmax(np.abs(moved) * shares, initial=0.0) for moved in tried.values()), default=0.0)
        names.append(unknown.name)
        columns.append(next((moved / change for change, moved in tried.items()), np.zeros(shares.size)))
        effects.append(float(np.linalg.norm(tried[SCREENING_STEPS[1]])) if SCREENING_STEPS[1] in tried else math.nan)
        reasons.append("" if largest > ROUNDING_CHANGE else "no effect on any measured output")
    matrix = np.column_stack(columns)
    starts = np.column_stack(nuisance) if nuisance else np.zeros((matrix.shape[0], 0))
    sizes, matrix = np.linalg.norm(matrix, axis=0), _without(matrix, starts)
    chosen, rest, least = list[int](), matrix.copy(), 1.96 / MAX_HALF_WIDTH
    while True:  # pivoted QR
        left = np.linalg.norm(rest, axis=0)
        fits = [
            i for i, r in enumerate(reasons) if not r and left[i] >= max(least, MIN_OWN_SHARE * max(sizes[i], 1e-300))
        ]
        if not fits:
            break
        best = max(fits, key=lambda i: (round(math.log10(left[i]), 3), -i))
        chosen.append(best)
        reasons[best] = f"its interval is at best ± {plain(196.0 / left[best], 2)} % of its value"
        direction = rest[:, best] / left[best]
        rest = rest - np.outer(direction, direction @ rest)
    for i in (i for i, reason in enumerate(reasons) if not reason):
        if chosen and np.linalg.norm(matrix[:, i]) >= least:
            weights = least_squares(matrix[:, chosen], matrix[:, i])
            parts = np.abs(weights) * np.linalg.norm(matrix[:, chosen], axis=0)
            imitators = [names[c] for c, part in zip(chosen, parts, strict=True) if part > 0.3 * np.max(parts)]
            reasons[i] = f"not distinguishable from {join_names(imitators)}"
        elif sizes[i] >= least:
            reasons[i] = "not distinguishable from start values of the logs"
        else:
            at_best = plain(196.0 / max(float(sizes[i]), 1e-12), 2)
            reasons[i] = f"its effect is within the noise: at best ± {at_best} % of its value"
    choices = [
        ChoiceEntry(name=n, effect=finite(e), estimated=i in chosen, reason=reasons[i])
        for i, (n, e) in enumerate(zip(names, effects, strict=True))
    ]
    return choices, np.array([u.log is not None or names.index(u.name) in chosen for u in likelihood.unknowns])


def _changes(likelihood: Likelihood, move: Array) -> list[Array] | None:
    """Return the changes of the residuals by a step from the best point; None outside the bounds or after a failure."""
    best = likelihood.best
    x = best.x + move
    if np.any((x < likelihood.low) | (x > likelihood.high)):
        return None
    tables = likelihood.tables(x)
    return tables and [table - base for table, base in zip(tables, best.tables, strict=True)]


def _without(columns: Array, nuisance: Array) -> Array:
    """Return columns minus their projection on nuisance columns."""
    if not nuisance.shape[1] or not columns.shape[1]:
        return columns
    basis = orthonormal(nuisance / np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300))
    return np.asarray(columns - basis @ (basis.T @ columns))


# -- combinations ---------------------------------------------------------------------------------


def find_combination(likelihood: Likelihood) -> tuple[CombinationEntry | None, Array]:
    """Return a parameter combination without effect on the outputs, confirmed by simulation, and singular values.

    Candidates are the right singular vectors of the scaled sensitivities. A combination is confirmed if a step of 10 %
    along it changes the outputs a hundred times less than the same step of one parameter alone.
    """
    point = likelihood.best
    good, scales = [np.isfinite(t) for t in point.tables], np.maximum(likelihood.scales, np.abs(point.x))
    rows = [(s / point.sigma[:, None])[g] for s, g in zip(likelihood.slopes, good, strict=True)]
    shared = np.array([u.log is None for u in likelihood.unknowns], bool)
    columns = np.vstack(rows) * scales
    matrix = _without(columns[:, shared], columns[:, ~shared])
    if not matrix.size or not np.isfinite(matrix).all():
        return None, np.zeros(0)

    def form(pair: Array, equal: Form, opposite: Form) -> Form:
        if pair.size != 2 or np.any(np.abs(pair) != 1.0):
            return "combination"
        return equal if pair[0] == pair[1] else opposite

    def visible(places: Rows, step: Array) -> float:
        """Return the change of the outputs by a step, in standard deviations; infinite if the FMU fails."""
        move = np.zeros(point.x.size)
        move[places] = step
        if (changes := _changes(likelihood, move)) is None:
            return math.inf
        return math.sqrt(sum(float(np.nansum((c / point.sigma) ** 2)) for c in changes))

    parameters, lengths = np.flatnonzero(shared), np.linalg.norm(matrix, axis=0)
    _, values, directions = np.linalg.svd(matrix, full_matrices=False)
    for k in np.argsort(values, kind="stable").tolist():
        if values[k] > SUSPECT_SINGULAR_VALUE * values[0]:
            break
        direction = directions[k] / np.max(np.abs(directions[k]))
        parts = np.flatnonzero(np.abs(direction) > MIN_COMPONENT)
        places, direction = parameters[parts], direction[parts]
        if len(parts) == 1 or (likelihood.precision[places] > 0.0).any():
            continue  # this parameter alone is too weak, as its interval shows, or the prior determines it
        # relative to the smallest component, and rounded if close to integers
        relative = [each / np.min(np.abs(each)) for each in (direction, direction * scales[places])]
        pairs = [(each, np.rint(each)) for each in relative]
        powers, shares = (np.where(np.abs(each - whole) < 0.05 * np.abs(whole), whole, each) for each, whole in pairs)
        x = point.x[places]
        moves = [(form(powers, "ratio", "product"), x * np.exp(TRIED_STEP * powers) - x)] if np.all(x != 0.0) else []
        size = float(np.min(np.abs(x[np.abs(shares) > 0.0]), initial=math.inf)) or float(np.min(scales[places]))
        moves.append((form(shares, "difference", "sum"), TRIED_STEP * size * shares))
        largest = MAX_INVISIBLE_CHANGE * TRIED_STEP * float(np.max(lengths[parts]))
        for name, move in sorted(moves, key=lambda pair: pair[0] == "combination"):  # forms with a name are preferred
            if min(visible(places, move), visible(places, -move)) <= largest:
                names = [likelihood.unknowns[j].name for j in places.tolist()]
                expression = COMBINATION_SIGNS.get(name, ", ").join(names)
                return CombinationEntry(names=names, held=names[-1], form=name, expression=expression), values
    return None, values


# -- intervals ------------------------------------------------------------------------------------


# The estimate is θ̂ = θ + A⁻¹·Σ_t K_t'·e_t with K = J/σ², A = J'·J/σ². The residuals of each output are modelled as an
# autoregression e = ε/a(q), so that Σ K'·e = Σ K̃'·ε, where K̃ is K filtered backwards by 1/a. The sandwich A⁻¹·(Σ
# K̃'·S·K̃)·A⁻¹ with the covariance S of ε is also valid for residuals that are not white.
#
# A profile is the deviance 2·(max ln L − ln L) as a function of one parameter, with all others estimated again at each
# value. Its interval is asymmetric if the model is nonlinear in the parameter.


MOST_LAGS = 30  # largest order of an autoregression
VALUES_PER_LAG = 8  # values for each lag
MANY_RESIDUALS = 50.0  # independent residuals per unknown, above which Student's factor is accurate
REPEATED_DRAWS, DRAWS_SEED = 99, 1  # repetitions of the bootstrap for few residuals
SETTLING_ORDERS = 20  # initial transient of repeated residuals, as a multiple of the largest order
PROFILE_DOUBLINGS = 6  # of the distance from the estimate at which the end of a profile is searched
PROFILE_END_TOLERANCE = 0.005  # tolerance of the end of a profile's interval, in half-widths


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the estimates.

    Attributes:
        matrix: Covariance of all unknowns.
        halves: Half-width of the 95 % interval of each unknown.
        white: Standard deviation of each unknown, assuming white residuals.
        colour: Channel → variance of the mean of its residuals, relative to white residuals.
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
        """Return the covariance of the estimates, a square root of that of the innovations, and autoregressions."""
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
        good = np.isfinite(together := np.vstack(innovations))
        values = np.where(good, together, 0.0)  # of each pair of channels, from rows with both
        root = square_roots(values.T @ values / np.maximum(good.T.astype(float) @ good, 1.0))
        spread, middle = root @ root.T, np.diag(likelihood.precision)
        for smoothed in filtered:
            parts = smoothed.transpose(1, 0, 2)
            for c, d in np.argwhere(spread != 0.0).tolist():
                middle = middle + spread[c, d] * parts[c].T @ parts[d]
        total = sum(int(np.isfinite(t).sum()) for t in tables)
        middle = middle * total / max(1, total - unknowns)
        return inverse @ middle @ inverse, root, models

    matrix, root, models = sandwich(point.tables)
    colour, white = np.array([m.colour for m in models]), np.sqrt(np.maximum(0.0, np.diag(inverse)))
    freedom = max(1.0, float(np.sum(point.counts / np.maximum(1.0, colour))) - unknowns)
    factors, roots = np.full(unknowns, float(stdtrit(freedom, 0.975))), np.sqrt(np.maximum(0.0, np.diag(matrix)))
    if freedom >= MANY_RESIDUALS * unknowns:
        return Covariance(matrix, factors * roots, white, colour)
    # In each repetition the autoregressions generate new residuals. The linearized estimate and its standard deviation
    # are computed from them as from the log (bootstrap-t). This accounts for the slow residuals that the parameters
    # absorb, and for the uncertain autoregressions.
    rng, ratios = np.random.default_rng(DRAWS_SEED), []
    settling = SETTLING_ORDERS * MOST_LAGS
    for _ in range(REPEATED_DRAWS):
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
    """Return the profile likelihood of an unknown; None if there is no interval.

    The deviance is scaled so that, for a model linear in the parameter, it is 1.96² at the ends of the interval from
    the covariance. Residuals that are not white thus widen both intervals equally (composite likelihood).
    """
    from scipy.optimize import brentq

    best, half = likelihood.best, float(spread.halves[j])
    if not (math.isfinite(half) and half > 0.0 and spread.white[j] > 0.0):
        return None
    others, centre = np.arange(best.x.size) != j, float(best.x[j])
    scale = (NORMAL_95 * float(spread.white[j]) / half) ** 2
    deviances, unknowns = {centre: 0.0}, {centre: best.x[others]}

    def excess(value: float) -> float:
        """Return the square root of the scaled deviance at a value, minus 1.96; infinite if the FMU fails."""
        if value not in deviances:
            inner = likelihood.restricted(others, at=value)
            if inner.point(unknowns[min(unknowns, key=lambda known: abs(known - value))]) is None:
                return math.inf
            if others.any():
                inner.maximize(lambda iteration: None)
            own = 0.5 * float(likelihood.precision[j]) * (value - float(likelihood.prior[j])) ** 2
            deviances[value] = max(0.0, 2.0 * scale * (inner.best.cost + own - best.cost))
            unknowns[value] = inner.best.x
        return math.sqrt(deviances[value]) - NORMAL_95

    def end(side: float) -> float | None:
        """Return the end of the interval below or above the estimate; None if the deviance stays small."""
        inside = centre
        for step in 0.6 * half * 2.0 ** np.arange(PROFILE_DOUBLINGS):
            outside = min(max(centre + side * float(step), float(likelihood.low[j])), float(likelihood.high[j]))
            if excess(outside) >= 0.0:
                if not math.isfinite(excess(outside)):
                    return None
                return float(brentq(excess, inside, outside, xtol=PROFILE_END_TOLERANCE * half))
            if outside == inside:
                return None
            inside = outside
        return None

    ci95 = end(-1.0), end(1.0)
    values = sorted(deviances)
    return ProfileEntry(values=values, deviance=[deviances[v] for v in values], ci95=ci95)


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
    for order in range(1, min(MOST_LAGS, count // VALUES_PER_LAG) + 1):
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
