"""What logs determine: screened parameters, combinations without effect, covariance and intervals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cosim.calibration.fit_record import ChoiceEntry, CombinationEntry, Form, ProfileEntry
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Array, Flags, Rows
from cosim.core.linear_algebra import least_squares, orthonormal
from cosim.core.text import join_names, plain
from cosim.estimation.fit import inverse
from cosim.logs.log import NORMAL_95
from cosim.residuals.residual_statistics import finite

SCREENING_STEPS = (0.01, 0.1)  # relative steps of a screened parameter
ROUNDING_CHANGE = 1e-9  # change of every output, relative to its standard deviation, below which it is rounding
MIN_NOISE_LEVEL = 5e-3  # minimum noise level for a choice, relative to the standard deviation: models are not perfect
MAX_HALF_WIDTH = 0.5  # largest half-width of the expected interval of a parameter to estimate, relative to its value
IMITATOR_SHARE = 0.3  # of the largest part in a reproduced sensitivity, from which a parameter is named
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
    noise_shares = np.concatenate([np.broadcast_to(sigma / logs.spread, g.shape)[g] for g in good])

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
        largest = max((np.nanmax(np.abs(moved) * noise_shares, initial=0.0) for moved in tried.values()), default=0.0)
        names.append(unknown.name)
        columns.append(next((moved / change for change, moved in tried.items()), np.zeros(noise_shares.size)))
        effects.append(float(np.linalg.norm(tried[SCREENING_STEPS[1]])) if SCREENING_STEPS[1] in tried else math.nan)
        why_not = "no effect on any measured output" if tried else "the FMU fails with each changed value"
        reasons.append("" if largest > ROUNDING_CHANGE else why_not)
    matrix = np.column_stack(columns)
    starts = np.column_stack(nuisance) if nuisance else np.zeros((matrix.shape[0], 0))
    sizes, matrix = np.linalg.norm(matrix, axis=0), _without(matrix, starts)
    chosen, rest, least_norm = list[int](), matrix.copy(), NORMAL_95 / MAX_HALF_WIDTH
    while True:  # pivoted QR, in which only chosen columns take part
        norms = np.linalg.norm(rest, axis=0)
        fits = [
            i
            for i, r in enumerate(reasons)
            if not r and norms[i] >= max(least_norm, MIN_OWN_SHARE * max(sizes[i], 1e-300))
        ]
        if not fits:
            break
        best = max(fits, key=lambda i: (round(math.log10(norms[i]), 3), -i))  # the first of nearly equal ones
        chosen.append(best)
        reasons[best] = f"its interval is at best ± {plain(100.0 * NORMAL_95 / norms[best], 2)} % of its value"
        direction = rest[:, best] / norms[best]
        rest = rest - np.outer(direction, direction @ rest)
    for i in (i for i, reason in enumerate(reasons) if not reason):
        if chosen and np.linalg.norm(matrix[:, i]) >= least_norm:
            weights = least_squares(matrix[:, chosen], matrix[:, i])
            parts = np.abs(weights) * np.linalg.norm(matrix[:, chosen], axis=0)
            imitators = [
                names[c] for c, part in zip(chosen, parts, strict=True) if part > IMITATOR_SHARE * np.max(parts)
            ]
            reasons[i] = f"not distinguishable from {join_names(imitators)}"
        elif sizes[i] >= least_norm:
            reasons[i] = "not distinguishable from start values of the logs"
        else:
            at_best = plain(100.0 * NORMAL_95 / max(float(sizes[i]), 1e-12), 2)
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


# A profile is the deviance 2·(max ln L − ln L) as a function of one parameter, with all others estimated again at each
# value. Its interval is asymmetric if the model is nonlinear in the parameter.


BLOCKS = 8  # blocks of time of all logs, of which each is long compared with the correlation of residuals
OMITTED_SHARE = 0.9  # of the weight of a block; the rest keeps start values determined that only this block shows
FIRST_PROFILE_STEP = 0.6  # in half-widths of the interval
PROFILE_DOUBLINGS = 6  # of the distance from the estimate at which the end of a profile is searched
PROFILE_END_TOLERANCE = 0.005  # tolerance of the end of a profile's interval, in half-widths


@dataclass(frozen=True, eq=False)
class Covariance:
    """Covariance of the estimates.

    Attributes:
        matrix: Covariance of all unknowns, assuming white residuals.
        halves: Half-width of the 95 % interval of each unknown.
        colour: Channel → variance of the mean of its residuals, relative to white residuals.
    """

    matrix: Array
    halves: Array
    colour: Array


def covariance(likelihood: Likelihood) -> Covariance:
    """Return the covariance of the estimates at the best point, and their intervals.

    The intervals come from the jackknife over blocks of time, which allows for residuals that are not white: without
    block b, the estimate moves by (A − A_b)⁻¹·g_b, with the information A and the score g of `weight_of`. They are at
    least as wide as for white residuals.
    """
    from scipy.special import stdtrit

    sizes = [len(table) for table in likelihood.best.tables]
    blocks = [
        (k, rows)
        for k, size in enumerate(sizes)
        for rows in np.array_split(np.arange(size), max(1, round(BLOCKS * size / sum(sizes))))
    ]
    weights = [likelihood.weight_of(k, rows) for k, rows in blocks]
    information = np.diag(likelihood.precision) + sum(weight for weight, _ in weights)
    matrix, count = inverse(information), len(blocks)
    moves = [inverse(information - OMITTED_SHARE * weight) @ score for weight, score in weights]
    deviations = np.sqrt(np.sum(np.square(moves), axis=0) * (count - 1) / count)
    white = np.sqrt(np.maximum(0.0, np.diag(matrix)))
    halves = np.maximum(float(stdtrit(count - 1, 0.975)) * deviations, NORMAL_95 * white)
    sums = sum(np.nansum(likelihood.best.tables[k][rows], axis=0) ** 2 for k, rows in blocks)
    colour = sums / np.maximum(sum(np.nansum(table**2, axis=0) for table in likelihood.best.tables), 1e-300)
    return Covariance(matrix, halves, np.asarray(colour))


def profile(likelihood: Likelihood, spread: Covariance, j: int) -> ProfileEntry | None:
    """Return the profile likelihood of an unknown; None if there is no interval.

    The deviance is scaled so that, for a model linear in the parameter, it is 1.96² at the ends of the interval from
    the covariance. Residuals that are not white thus widen both intervals equally (composite likelihood).
    """
    from scipy.optimize import brentq

    best, half, variance = likelihood.best, float(spread.halves[j]), float(spread.matrix[j, j])
    if not (half > 0.0 and variance > 0.0):
        return None
    others, centre = np.arange(best.x.size) != j, float(best.x[j])
    scale = NORMAL_95**2 * variance / half**2
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
        """Return the end of the interval below or above the estimate.

        None: the deviance stays below 1.96² up to the bound or the last step, or the FMU fails.
        """
        inside = centre
        for step in FIRST_PROFILE_STEP * half * 2.0 ** np.arange(PROFILE_DOUBLINGS):
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
