"""Identifiability of parameters: screening, selection, and combinations without effect on the outputs."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from cosim.calibration.fit_record import ChoiceEntry, CombinationEntry, Form
from cosim.calibration.likelihood import Likelihood
from cosim.core.arrays import Array, Flags, Rows
from cosim.core.linear_algebra import least_squares, orthonormal
from cosim.core.text import join_names, plain
from cosim.residuals.residual_statistics import finite

CHANGES = (0.01, 0.1)  # relative steps of a screened parameter
NO_EFFECT = 1e-9  # change of every output, relative to its standard deviation, below which it is rounding
RESOLUTION = 5e-3  # minimum noise level for a choice, relative to the standard deviation: models are not perfect
WIDEST = 0.5  # largest half-width of the expected interval of a parameter to estimate, relative to its value
APART = 0.03  # share of a sensitivity not reproduced by other parameters; differences are accurate to a third
SUSPECT = 0.02  # singular value relative to the largest, below which a combination is tried
MOVE = 0.1  # relative step of a combination that is tried
INVISIBLE = 0.01  # change of the outputs relative to that by one parameter alone
TAKES_PART = 0.2  # component of a direction relative to the largest
SIGNS = {"ratio": " / ", "product": " · ", "sum": " + ", "difference": " − "}


def screen(likelihood: Likelihood) -> tuple[list[ChoiceEntry], Flags]:
    """Return the choice among the parameters with reasons, and an array that is True for each selected unknown.

    Each parameter is changed by 1 % and by 10 % of its scale. Parameters with an effect are ranked by pivoted QR of
    their
    sensitivities: the next one is least reproducible by those already chosen.
    """
    logs, good = likelihood.logs, [np.isfinite(t) for t in likelihood.best.tables]
    sigma = np.maximum(logs.noise, RESOLUTION * logs.spread)  # the sensor noise, or the resolution of models
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
            if (moved := changed(j, CHANGES[0])) is not None:
                nuisance.append(moved)
            continue
        tried = {c: moved for c in CHANGES if (moved := changed(j, c)) is not None}
        largest = max((np.nanmax(np.abs(moved) * shares, initial=0.0) for moved in tried.values()), default=0.0)
        names.append(unknown.name)
        columns.append(next((moved / change for change, moved in tried.items()), np.zeros(shares.size)))
        effects.append(float(np.linalg.norm(tried[CHANGES[1]])) if CHANGES[1] in tried else math.nan)
        reasons.append("" if largest > NO_EFFECT else "no effect on any measured output")
    matrix = np.column_stack(columns)
    starts = np.column_stack(nuisance) if nuisance else np.zeros((matrix.shape[0], 0))
    chosen = _select(names, _without(matrix, starts), np.linalg.norm(matrix, axis=0), reasons)
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
    """Return columns after removal of their projection on nuisance columns."""
    if not nuisance.shape[1] or not columns.shape[1]:
        return columns
    basis = orthonormal(nuisance / np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300))
    return np.asarray(columns - basis @ (basis.T @ columns))


def _select(names: Sequence[str], matrix: Array, sizes: Array, reasons: list[str]) -> list[int]:
    """Return the columns selected by pivoted QR, and add the reason for or against each to `reasons`."""
    chosen: list[int] = []
    rest = matrix.copy()
    least = 1.96 / WIDEST
    while True:
        left = np.linalg.norm(rest, axis=0)
        fits = [i for i, r in enumerate(reasons) if not r and left[i] >= max(least, APART * max(sizes[i], 1e-300))]
        if not fits:
            break
        best = max(fits, key=lambda i: (round(math.log10(left[i]), 3), -i))
        chosen.append(best)
        reasons[best] = f"its interval is at best ± {plain(196.0 / left[best], 2)} % of its value"
        direction = rest[:, best] / left[best]
        rest = rest - np.outer(direction, direction @ rest)
    for i, reason in enumerate(reasons):
        if reason:
            continue
        if chosen and np.linalg.norm(matrix[:, i]) >= least:
            weights = least_squares(matrix[:, chosen], matrix[:, i])
            parts = np.abs(weights) * np.linalg.norm(matrix[:, chosen], axis=0)
            imitators = [names[c] for c, part in zip(chosen, parts, strict=True) if part > 0.3 * np.max(parts)]
            reasons[i] = f"imitated by {join_names(imitators)}"
        elif sizes[i] >= least:
            reasons[i] = "not distinguishable from start values of the logs"
        else:
            size = max(float(sizes[i]), 1e-12)
            reasons[i] = f"its effect is within the noise: at best ± {plain(196.0 / size, 2)} % of its value"
    return chosen


# -- combinations ---------------------------------------------------------------------------------


def find_combination(likelihood: Likelihood) -> tuple[CombinationEntry | None, Array]:
    """Return a parameter combination without effect on the outputs, confirmed by simulation, and singular values.

    Candidates are the right singular vectors of the scaled sensitivities. A combination is confirmed if a step of 10 %
    along it changes the outputs a hundred times less than the same step of one parameter alone.
    """
    point = likelihood.best
    good = [np.isfinite(t) for t in point.tables]
    rows = [
        s[g] / np.broadcast_to(point.sigma, g.shape)[g][:, None] for s, g in zip(likelihood.slopes, good, strict=True)
    ]
    shared = np.array([u.log is None for u in likelihood.unknowns], bool)
    columns = np.vstack(rows) * np.maximum(likelihood.scales, np.abs(point.x))
    matrix = _without(columns[:, shared], columns[:, ~shared])
    if not matrix.size or not np.isfinite(matrix).all():
        return None, np.zeros(0)
    parameters, lengths = np.flatnonzero(shared), np.linalg.norm(matrix, axis=0)
    _, values, directions = np.linalg.svd(matrix, full_matrices=False)
    for k in np.argsort(values, kind="stable").tolist():
        if values[k] > SUSPECT * values[0]:
            break
        direction = directions[k] / np.max(np.abs(directions[k]))
        parts = np.flatnonzero(np.abs(direction) > TAKES_PART)
        if len(parts) == 1 or (likelihood.precision[parameters[parts]] > 0.0).any():
            continue  # too weak alone, as its interval shows, or determined by the prior
        alone = MOVE * float(np.max(lengths[parts]))
        if (form := _invisible_form(likelihood, parameters[parts], direction[parts], alone)) is not None:
            names = [likelihood.unknowns[j].name for j in parameters[parts].tolist()]
            expression = SIGNS.get(form, ", ").join(names)
            return CombinationEntry(names=names, held=names[-1], form=form, expression=expression), values
    return None, values


def _invisible_form(likelihood: Likelihood, places: Rows, direction: Array, alone: float) -> Form | None:
    """Return the form (product, ratio, sum, …) of a combination without effect on the outputs, if any."""
    point = likelihood.best
    scales, x = np.maximum(likelihood.scales, np.abs(point.x))[places], point.x[places]

    def form(pair: Array, equal: Form, opposite: Form) -> Form:
        if pair.size != 2 or np.any(np.abs(pair) != 1.0):
            return "combination"
        return equal if pair[0] == pair[1] else opposite

    def visible(part: Array) -> float:
        """Return the change of the outputs by a step, in standard deviations; infinite if the FMU fails."""
        move = np.zeros(point.x.size)
        move[places] = part
        if (changes := _changes(likelihood, move)) is None:
            return math.inf
        return math.sqrt(sum(float(np.nansum((c / point.sigma) ** 2)) for c in changes))

    # relative to the smallest component, and rounded if close to integers
    relative = [each / np.min(np.abs(each)) for each in (direction, direction * scales)]
    pairs = [(each, np.rint(each)) for each in relative]
    powers, shares = (np.where(np.abs(each - whole) < 0.05 * np.abs(whole), whole, each) for each, whole in pairs)
    moves = [(form(powers, "ratio", "product"), x * np.exp(MOVE * powers) - x)] if np.all(x != 0.0) else []
    size = float(np.min(np.abs(x[np.abs(shares) > 0.0]), initial=math.inf)) or float(np.min(scales))
    moves.append((form(shares, "difference", "sum"), MOVE * size * shares))
    for name, move in sorted(moves, key=lambda pair: pair[0] == "combination"):  # forms with a name are preferred
        if min(visible(move), visible(-move)) <= INVISIBLE * alone:
            return name
    return None
