"""Which parameters logs can tell apart: screening, selection, and combinations that leave the outputs unchanged."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.linear_algebra import least_squares, orthonormal
from cosim.base.text import join_names, plain
from cosim.calibration.likelihood import Jacobian, Likelihood, Point

CHANGES = (0.01, 0.1)  # of a screened parameter, relative to its scale
NO_EFFECT = 1e-9  # change of every output, relative to its spread, that is rounding
RESOLUTION = 5e-3  # least noise level for a choice, relative to the spread: models are not perfect
WIDEST = 0.5  # half-width of the expected interval of a parameter that is worth its estimate, relative to its value
APART = 0.03  # share of a sensitivity that the other parameters cannot imitate; differences are accurate to a third
SUSPECT = 0.02  # singular value relative to the largest, from which a combination is tried
MOVE = 0.1  # of the parameters of a combination that is tried
INVISIBLE = 0.01  # change of the outputs relative to that of one parameter alone
TAKES_PART = 0.2  # component of a direction relative to the largest
POWERS = (1.0, 2.0, 3.0, 0.5, 1.5)


class Choice(NamedTuple):
    """A screened parameter: its effect in standard deviations of the noise, and whether it is estimated and why."""

    name: str
    effect: float
    estimated: bool
    reason: str


@dataclass(frozen=True)
class Combination:
    """Parameters of which the logs determine one combination only.

    Attributes:
        held: Parameter that is held at its value.
        form: ratio, product, sum, difference or combination.
        expression: The combination, such as `mass / gain`.
    """

    names: tuple[str, ...]
    held: str
    form: str
    expression: str

    @property
    def sentence(self) -> str:
        """Return the combination in words."""
        if self.form == "combination":
            return f"{join_names(self.names)} are not identifiable one by one from these logs"
        return f"{join_names(self.names)} are only identifiable as their {self.form} {self.expression}"


# -- sensitivities --------------------------------------------------------------------------------


def stacked(likelihood: Likelihood, point: Point, slopes: Jacobian, sigma: Array) -> tuple[Array, Array]:
    """Return the sensitivities of parameters, and of start values, in standard deviations per scale."""
    good = [np.isfinite(t) for t in point.residuals.tables]
    rows = [s[g] / np.broadcast_to(sigma, g.shape)[g][:, None] for s, g in zip(slopes, good, strict=True)]
    shared = np.array([u.log is None for u in likelihood.unknowns], bool)
    columns = np.vstack(rows) * np.maximum(likelihood.scales, np.abs(point.x))
    return columns[:, shared], columns[:, ~shared]


def without(columns: Array, nuisance: Array) -> Array:
    """Return columns without their projection on nuisance columns."""
    if not nuisance.shape[1] or not columns.shape[1]:
        return columns
    basis = orthonormal(nuisance / np.maximum(np.linalg.norm(nuisance, axis=0), 1e-300))
    return np.asarray(columns - basis @ (basis.T @ columns))


def screen(likelihood: Likelihood, point: Point) -> tuple[list[Choice], Flags]:
    """Return the choice among the parameters, with its reasons, and which unknowns it keeps.

    Each parameter is changed by 1 % and by 10 % of its scale. Those with an effect compete by pivoted QR of their
    sensitivities: the one that the chosen ones imitate least comes next.
    """
    sigma = _noise(likelihood)
    names = [u.name for u in likelihood.unknowns if u.log is None]
    tried = [_try(likelihood, point, j, sigma) for j, u in enumerate(likelihood.unknowns) if u.log is None]
    columns = np.column_stack([t.slope for t in tried])
    nuisance = [
        _flat(moved, point.residuals.tables, sigma)
        for j, u in enumerate(likelihood.unknowns)
        if u.log is not None and (moved := _moved(likelihood, point, j, CHANGES[0])) is not None
    ]
    starts = np.column_stack(nuisance) if nuisance else np.zeros((columns.shape[0], 0))
    sizes = np.linalg.norm(columns, axis=0)
    chosen, reasons = _select(names, without(columns, starts), sizes, [t.acts for t in tried])
    choices = [Choice(n, t.effect, i in chosen, reasons[i]) for i, (n, t) in enumerate(zip(names, tried, strict=True))]
    kept = np.array([u.log is not None or names.index(u.name) in chosen for u in likelihood.unknowns])
    return choices, kept


class _Trial(NamedTuple):
    """Sensitivity to a parameter, effect of the larger change, and whether there is any."""

    slope: Array
    effect: float
    acts: bool


def _try(likelihood: Likelihood, point: Point, j: int, sigma: Array) -> _Trial:
    """Return the effects of the changes of a parameter; none if the FMU fails with each."""
    tables = point.residuals.tables
    moved = {change: _moved(likelihood, point, j, change) for change in CHANGES}
    effects = {change: _flat(m, tables, sigma) for change, m in moved.items() if m is not None}
    if not effects:
        return _Trial(np.zeros(sum(int(np.isfinite(t).sum()) for t in tables)), math.nan, False)
    slope = next(effect / change for change, effect in effects.items())
    effect = float(np.linalg.norm(effects[CHANGES[1]])) if CHANGES[1] in effects else math.nan
    return _Trial(slope, effect, max(_relative(likelihood, m) for m in moved.values()) > NO_EFFECT)


def _noise(likelihood: Likelihood) -> Array:
    """Return the noise level of each channel for choices, that of its sensor or the resolution of models."""
    noise, spread = likelihood.logs.noise, likelihood.logs.spread
    return np.array([max(noise[n], RESOLUTION * spread[n]) for n in likelihood.logs.channels])


def _moved(likelihood: Likelihood, point: Point, j: int, change: float) -> list[Array] | None:
    """Return the change of the residuals by a change of an unknown; None if the FMU fails."""
    for side in (1.0, -1.0):
        x = point.x.copy()
        x[j] += side * change * likelihood.scales[j]
        if not likelihood.low[j] <= x[j] <= likelihood.high[j]:
            continue
        log = likelihood.unknowns[j].log
        tables = []
        for k, base in enumerate(point.residuals.tables):
            table = likelihood.table(x, k) if log in (None, k) else base
            if table is None:
                break
            tables.append(side * (table - base))
        else:
            return tables
    return None


def _flat(tables: Sequence[Array], measured: Sequence[Array], sigma: Array) -> Array:
    return np.concatenate([(t / sigma)[np.isfinite(m)] for t, m in zip(tables, measured, strict=True)])


def _relative(likelihood: Likelihood, tables: Sequence[Array] | None) -> float:
    """Return the largest change of an output relative to its spread."""
    spread = np.array([likelihood.logs.spread[n] for n in likelihood.logs.channels])
    return 0.0 if tables is None else max(float(np.nanmax(np.abs(t) / spread, initial=0.0)) for t in tables)


def _select(names: Sequence[str], matrix: Array, sizes: Array, acts: Sequence[bool]) -> tuple[list[int], list[str]]:
    """Return the chosen columns by pivoted QR, and the reason for or against each."""
    reasons = ["" if act else "no effect on any measured output" for act in acts]
    chosen: list[int] = []
    rest = matrix.copy()
    while True:
        left = np.linalg.norm(rest, axis=0)
        fits = [
            i
            for i in range(len(names))
            if not reasons[i] and left[i] >= 1.96 / WIDEST and left[i] >= APART * max(sizes[i], 1e-300)
        ]
        if not fits:
            break
        best = max(fits, key=lambda i: (round(math.log10(left[i]), 3), -i))
        chosen.append(best)
        reasons[best] = f"its interval is at best ± {plain(196.0 / left[best], 2)} % of its value"
        direction = rest[:, best] / left[best]
        rest = rest - np.outer(direction, direction @ rest)
    for i, reason in enumerate(reasons):
        if not reason:
            reasons[i] = _against(names, matrix, chosen, i, float(np.linalg.norm(rest[:, i])), float(sizes[i]))
    return chosen, reasons


def _against(names: Sequence[str], matrix: Array, chosen: Sequence[int], i: int, left: float, size: float) -> str:
    if np.linalg.norm(matrix[:, i]) < 1.96 / WIDEST or not chosen:
        if size >= 1.96 / WIDEST:
            return "imitated by the start values of the logs"
        return f"its effect is within the noise: at best ± {plain(196.0 / max(size, 1e-12), 2)} % of its value"
    weights = least_squares(matrix[:, list(chosen)], matrix[:, i])
    parts = np.abs(weights) * np.linalg.norm(matrix[:, list(chosen)], axis=0)
    imitators = [names[c] for c, part in zip(chosen, parts, strict=True) if part > 0.3 * np.max(parts)]
    return f"imitated by {join_names(imitators)}"


# -- combinations ---------------------------------------------------------------------------------


def find_combination(likelihood: Likelihood, point: Point, slopes: Jacobian) -> tuple[Combination | None, Array]:
    """Return a combination of parameters that leaves the outputs unchanged, tried by simulation, and singular values.

    Suspects are the right singular vectors of the scaled sensitivities. A direction is believed if a move along it by
    10 % changes the outputs a hundred times less than the same move of one parameter alone.
    """
    columns, nuisance = stacked(likelihood, point, slopes, point.residuals.sigma)
    matrix = without(columns, nuisance)
    if not matrix.size or not np.isfinite(matrix).all():
        return None, np.zeros(0)
    parameters = [j for j, u in enumerate(likelihood.unknowns) if u.log is None]
    lengths = np.linalg.norm(matrix, axis=0)
    _, values, rows = np.linalg.svd(matrix, full_matrices=False)
    for value, direction in sorted(zip(values.tolist(), rows, strict=True), key=lambda pair: pair[0]):
        if value > SUSPECT * values[0]:
            break
        largest = float(np.max(np.abs(direction)))
        parts = [i for i in range(len(parameters)) if abs(direction[i]) > TAKES_PART * largest]
        if any(likelihood.precision[parameters[i]] > 0.0 for i in parts):
            continue  # the prior decides
        if len(parts) == 1:
            continue  # too weak alone: its interval says so
        alone = MOVE * float(np.max(lengths[parts]))
        found = _try_forms(likelihood, point, [parameters[i] for i in parts], direction[parts] / largest, alone)
        if found is not None:
            return found, values
    return None, values


def _try_forms(
    likelihood: Likelihood, point: Point, places: list[int], direction: Array, alone: float
) -> Combination | None:
    """Return the form of a combination whose move is invisible, if any."""
    scales = np.maximum(likelihood.scales, np.abs(point.x))[places]
    powers, shares = _snapped(direction), _snapped(direction * scales)
    x = point.x[places]
    moves: list[tuple[str, Array]] = []
    if np.all(x != 0.0):
        moves.append(({1: "ratio", -1: "product"}.get(_sign(powers), "combination"), x * np.exp(MOVE * powers) - x))
    sizes = float(np.min(np.abs(x[np.abs(shares) > 0.0]), initial=math.inf)) or float(np.min(scales))
    moves.append(({1: "difference", -1: "sum"}.get(_sign(shares), "combination"), MOVE * sizes * shares))
    for form, move in sorted(moves, key=lambda pair: pair[0] == "combination"):  # a name is preferred
        visible = min(_change(likelihood, point, places, side * move) for side in (1.0, -1.0))
        if visible <= INVISIBLE * alone:
            names = tuple(likelihood.unknowns[j].name for j in places)
            return Combination(names, names[-1], form, _expression(names, form))
    return None


def _snapped(direction: Array) -> Array:
    """Return a direction with components relative to the smallest, rounded to small powers where close."""
    relative = direction / np.min(np.abs(direction))
    snapped = []
    for value in relative.tolist():
        power = min(POWERS, key=lambda p: abs(abs(value) - p))
        snapped.append(math.copysign(power, value) if abs(abs(value) - power) < 0.05 * power else value)
    return np.array(snapped)


def _sign(pair: Array) -> int:
    """Return 1 or −1 for two equal or opposite components, else 0."""
    if pair.size != 2 or abs(pair[0]) != 1.0 or abs(pair[1]) != 1.0:
        return 0
    return 1 if pair[0] == pair[1] else -1


def _expression(names: Sequence[str], form: str) -> str:
    """Return the invariant of a direction of two parameters."""
    signs = {"ratio": "/", "product": "·", "sum": "+", "difference": "−"}
    if form in signs:
        return f"{names[0]} {signs[form]} {names[1]}"
    return ", ".join(names)


def _change(likelihood: Likelihood, point: Point, places: list[int], move: Array) -> float:
    """Return the change of the outputs by a move, in standard deviations; infinite if the FMU fails."""
    x = point.x.copy()
    x[places] += move
    if np.any(x < likelihood.low) or np.any(x > likelihood.high):
        return math.inf
    squares = 0.0
    for k, base in enumerate(point.residuals.tables):
        table = likelihood.table(x, k)
        if table is None:
            return math.inf
        squares += float(np.nansum(((table - base) / point.residuals.sigma) ** 2))
    return math.sqrt(squares)
