"""Local shapes of unnamed terms: range of a signal, or of time, in which an equation lacks a term.

A smoother estimates the missing input of each equation in each row. Candidate shapes are bumps at many places with
three widths, steps, and rows of bumps (splines) over time, each state, each command, and each difference of two states
with equal units. Each shape may be multiplied by a velocity, its sign, or the distance from the place. Regression
selects the most promising shapes for a filter run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate, chain, combinations, islice
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares, orthonormal
from cosim.estimation.kernel.kernel import CONSTANT, DEVIATION, DISTURBANCE
from cosim.estimation.kernel.nameless import KNOTS, LOCAL, RATE, bump, clip, rise
from cosim.estimation.problem import Problem
from cosim.estimation.screen import ScoreTest
from cosim.refinement.search.missing import DriveResponses, Smoothed, of_every_row, smooth_logs

HALF = 2.0 * np.sqrt(1.0 - 0.5 ** (1.0 / 3.0))  # ζ at which a bump has half its height
INSIDE = (2.0, 98.0)  # percentiles of the rows that bound the places
WIDTHS = (1 / 3, 1 / 6, 1 / 12)  # width of a bump at half its height, as a share of that range
STEPS = 8  # places of a step
SLIP = 0.05  # share of its range within which the sign of a velocity turns
FEWEST = 30  # least number of rows within a width
KEPT = 3  # bumps and steps of an equation that get a filter run; only one spline does
TWICE = 0.9  # correlation from which two shapes count as one
AT_ONCE = 500  # shapes with one pass of a free run's filter
EVERY = 4  # rows between linearizations, sufficient for a regression
TURN = 2.0 * np.pi
DIFFERENCE = " − "

Signals = Mapping[str, Array]


@dataclass(frozen=True)
class Shape:
    """A local shape: a function of a signal, possibly times a factor, in the equation of a state.

    Attributes:
        equation: Forced state.
        of: Signal of the shape, or two signals for their difference.
        kind: `bump`, `step` or `spline`.
        place: Centre, for a spline of its first bump.
        width: Width of a bump at half its height, of a step from end to end, of a spline from bump to bump.
        times: Signals of the factor, as in `of`; may be empty.
        dry: True if the factor is the sign of the signals, smoothed within `slip`.
        well: True if multiplied by the distance from `place`.
        turned: True for a shape over an angle, repeated every turn.
        unit: Unit of place and width.
    """

    equation: str
    of: tuple[str, ...]
    kind: str
    place: float
    width: float
    times: tuple[str, ...] = ()
    dry: bool = False
    slip: float = 1.0
    well: bool = False
    turned: bool = False
    unit: str = ""

    @classmethod
    def of_entry(cls, equation: str, entry: Mapping[str, Any]) -> Shape:
        """Return the shape of an entry of refine.json."""
        lists = {name: tuple(entry[name]) for name in ("of", "times")}
        return cls(equation, **{n: v for n, v in entry.items() if n != "sizes"} | lists)

    @property
    def entry(self) -> dict[str, Any]:
        """Return the shape as an entry of refine.json."""
        return {n: list(v) if isinstance(v, tuple) else v for n, v in vars(self).items() if n != "equation"}

    @property
    def signal(self) -> str:
        """Return the signal as text."""
        return DIFFERENCE.join(self.of)

    @property
    def factor(self) -> str:
        """Return the factor as text; "" without a factor."""
        if self.well:
            return "distance from there"
        name = DIFFERENCE.join(self.times)
        return f"sign of {name}" if self.dry else name

    @property
    def per(self) -> float:
        """Return the normalised signal ζ per unit of the signal, for a turning angle per unit of 1 − cosine."""
        if self.turned:
            return float(HALF / (1.0 - np.cos(0.5 * self.width)))
        return float({"bump": 2.0 * HALF, "step": 2.0, "spline": 1.0}[self.kind] / self.width)

    def settings(self, slot: int) -> dict[str, float]:
        """Return this shape's kernel parameters in a slot."""

        def weights(role: str, names: Sequence[str], size: float) -> dict[str, float]:
            return {f"{LOCAL}.{slot}.{role}.{n}": s * size for n, s in zip(names, (1.0, -1.0), strict=False)}

        settings = {f"{LOCAL}.{slot}.to.{self.equation}": 1.0}
        if self.turned:
            (angle,) = self.of
            circle = {"1": 1.0, f"cos {angle}": -np.cos(self.place), f"sin {angle}": -np.sin(self.place)}
            settings |= {f"{LOCAL}.{slot}.of.{n}": self.per * float(size) for n, size in circle.items()}
        else:
            settings |= weights("of", self.of, self.per) | {f"{LOCAL}.{slot}.of.1": -self.place * self.per}
        if self.well:
            return settings | weights("by", self.of, 1.0) | {f"{LOCAL}.{slot}.by.1": -self.place}
        if self.dry:
            return settings | weights("by", self.times, 1.0 / self.slip) | {f"{LOCAL}.{slot}.dry": 1.0}
        return settings | (weights("by", self.times, 1.0) or {f"{LOCAL}.{slot}.by.1": 1.0})

    def coefficients(self, slot: int) -> tuple[str, ...]:
        """Return the names of the kernel parameters that scale this shape in a slot."""
        own = {"bump": ("0",), "step": ("rise",), "spline": tuple(map(str, range(KNOTS)))}[self.kind]
        return tuple(f"{LOCAL}.{slot}.{name}" for name in own)

    def positions(self, signals: Signals) -> Array:
        """Return the values of the signal; a turning angle is wrapped to within half a turn of `place`."""
        z = _difference(signals, self.of)
        return np.mod(z - self.place + np.pi, TURN) + self.place - np.pi if self.turned else z

    def columns(self, signals: Signals) -> Array:
        """Return the regressor of each coefficient, shape (rows, coefficients)."""
        z = self.positions(signals)
        over = self.per * (1.0 - np.cos(z - self.place) if self.turned else z - self.place)
        if self.kind == "step":
            basis = rise(over)[:, None]
        else:
            count = KNOTS if self.kind == "spline" else 1
            basis = np.stack([bump(over - k) for k in range(count)], axis=1)
        if self.well:
            return np.asarray(basis * (z - self.place)[:, None])
        if not self.times:
            return np.asarray(basis)
        factor = _difference(signals, self.times)
        return np.asarray(basis * (clip(factor / self.slip) if self.dry else factor)[:, None])


def _difference(signals: Signals, names: Sequence[str]) -> Array:
    return signals[names[0]] - signals[names[1]] if len(names) > 1 else signals[names[0]]


def signals_of(problem: Problem, parts: Smoothed) -> dict[str, Array]:
    """Return name → values of the signals for local shapes."""
    layout, states = problem.layout, np.vstack([m.states for _, m in parts])
    commands = np.vstack([problem.logs[k].u[m.rows(problem.logs[k])] for k, m in parts])
    time, named = np.concatenate([m.time for _, m in parts]), dict(zip(layout.states, states.T, strict=True))
    own = {n: z for n, z in named.items() if not n.startswith((DISTURBANCE, CONSTANT))}
    if layout.is_free_run:
        own = {n: named[n] + named[DEVIATION + n] for n in layout.outputs}
        ends, steps = np.cumsum([len(m.time) for _, m in parts])[:-1], [problem.logs[k].step for k, _ in parts]
        for rate in (n for n in layout.rates.values() if n.startswith(RATE)):
            each = zip(np.split(own[rate.removeprefix(RATE)], ends), steps, strict=True)
            own[rate] = np.concatenate([np.diff(z, prepend=z[:1]) / step for z, step in each])
    return {"time": time, **own, **{f"command {n}": u for n, u in zip(layout.inputs, commands.T, strict=True)}}


def promising_shapes(test: ScoreTest, units: Mapping[str, str], worth: float) -> tuple[list[Shape], int]:
    """Return promising shapes, and the number of shapes tried.

    Args:
        test: Score test at the fit beside which shapes are tried.
        units: Units of the signals; two states with equal units also give a difference signal.
        worth: Log-likelihood gain that a shape must promise.
    """
    problem, prefix = test.problem, f"{LOCAL}.1.of."
    names = {n.removeprefix(prefix) for n in problem.layout.parameters if n.startswith(prefix)}
    compared = _compared(test) if names and problem.layout.forced else None
    if compared is None or not all(np.isfinite(z).all() for z in (*compared.lacking, *compared.signals.values())):
        return [], 0
    signals = {n: z for n, z in compared.signals.items() if n in names}
    shapes: list[Shape] = []
    tried = 0
    for column, equation in enumerate(problem.layout.forced):
        best = _Selection(compared.lacking[column], compared.plain(column, signals.get(equation)), worth)
        every = chain.from_iterable(ground.shapes() for ground in _grounds(problem, equation, signals, units))
        while some := [*islice(every, AT_ONCE)]:
            tried += best.try_all(some, signals, partial(compared.respond, column))
        shapes += best.select()
    return shapes, tried


@dataclass(frozen=True, eq=False)
class _Comparison:
    """Data and regressors with which shapes are compared.

    Attributes:
        signals: Signals of the shapes.
        lacking: Missing input of each equation, or residuals of the fit.
        plain: Function of an equation and its own signal that returns regressors beside any shape.
        respond: Function of an equation and columns over the rows that returns regressors.
    """

    signals: Signals
    lacking: Sequence[Array]
    plain: Callable[[int, Array | None], Array]
    respond: Callable[[int, Array], Array]


def _compared(test: ScoreTest) -> _Comparison:
    """Return the data and regressors for this kind of fit."""
    with np.errstate(invalid="ignore", over="ignore"):
        if test.problem.layout.is_free_run:
            return _of_free_run(test)
        parts, lacking, sigma = smooth_logs(test.problem, test.at, EVERY)
        weights = 1.0 / np.sqrt(np.mean(sigma**2, axis=0))

        def plain(column: int, own: Array | None) -> Array:
            return np.column_stack([np.ones(len(lacking)), *([] if own is None else [own])])

        signals = signals_of(test.problem, parts)
        return _Comparison(signals, [*(lacking * weights).T], plain, lambda column, columns: columns)


def _of_free_run(test: ScoreTest) -> _Comparison:
    """Return the score test of additions to unknown inputs."""
    problem, responses = test.problem, DriveResponses(test.problem, test.at)
    parts = [(k, of_every_row(problem, test.at, k)) for k in range(len(problem.logs))]
    ends = np.cumsum([len(m.time) for _, m in parts])[:-1]
    count = len(responses.scored.errors)
    plain = test.basis[:count]

    def respond(column: int, columns: Array) -> Array:
        return responses(column, np.split(columns, ends))

    lacking = [test.residual[:count]] * len(problem.layout.forced)
    return _Comparison(signals_of(problem, parts), lacking, lambda column, own: plain, respond)


class _Selection:
    """Selection of the best shapes for an equation, by regression together with further regressors."""

    def __init__(self, lacking: Array, others: Array, worth: float) -> None:
        self.plain = orthonormal(others)
        self.lacking, self.worth = self._project(lacking), worth
        self.single: list[tuple[float, Shape, Array]] = []
        self.groups: list[tuple[float, Shape, Array]] = []

    def _project(self, columns: Array) -> Array:
        """Return columns orthogonal to the further regressors."""
        return np.asarray(columns - self.plain @ (self.plain.T @ columns))

    def try_all(self, shapes: Sequence[Shape], signals: Signals, respond: Callable[[Array], Array]) -> int:
        """Keep promising shapes; return the number of coefficients tried."""
        columns = [shape.columns(signals) for shape in shapes]
        projected = self._project(respond(np.hstack(columns)))
        against, ends = projected.T @ self.lacking, [*accumulate(c.shape[1] for c in columns)]
        for shape, end, before in zip(shapes, ends, [0, *ends], strict=False):
            basis, target = projected[:, before:end], against[before:end]
            products = basis.T @ basis
            sizes = least_squares(products, target, rcond=1e-9)
            gain = 0.5 * float(sizes @ products @ sizes)
            if gain > self.worth * len(sizes):
                (self.groups if len(sizes) > 1 else self.single).append((gain, shape, basis @ sizes))
        return ends[-1] if ends else 0

    def select(self) -> list[Shape]:
        """Return the most promising distinct shapes."""
        chosen: list[tuple[Shape, Array]] = []
        for _, shape, row in sorted(self.single, key=lambda entry: -entry[0]):
            direction = row / np.linalg.norm(row)
            if all(abs(direction @ other) < TWICE for _, other in chosen):
                chosen.append((shape, direction))
            if len(chosen) == KEPT:
                break
        groups = sorted(self.groups, key=lambda entry: -entry[0])[:1]
        return [s for s, _ in chosen] + [s for _, s, _ in groups]


@dataclass(frozen=True, eq=False)
class _Ground:
    """A signal over which local shapes are tried in an equation.

    Attributes:
        flat: Template of the shapes, without place and width.
        z: Values of the signal.
        low, high: Range of the places.
        factors: Signals that may multiply a shape → range within which the sign of this factor is smoothed.
    """

    flat: Shape
    z: Array
    low: float
    high: float
    factors: Mapping[tuple[str, ...], float]

    def shapes(self) -> Iterator[Shape]:
        """Yield every shape to test on the signal."""
        if len(self.flat.of) == 1 and self.flat.unit == "rad" and self.high - self.low > TURN:
            for width in WIDTHS:
                for place in np.arange(round(2 / width)) * 0.5 * width * TURN:
                    shape = replace(self.flat, place=float(place), width=width * TURN, turned=True)
                    yield shape
                    yield from self._products(shape)
            return
        span = self.high - self.low
        for place in np.linspace(self.low, self.high, STEPS + 2)[1:-1]:
            step = replace(self.flat, kind="step", place=float(place), width=span / STEPS)
            yield step
            yield from (replace(step, times=times) for times in self.factors)
        if self.flat.of == ("time",):
            return
        yield replace(self.flat, kind="spline", place=float(self.low), width=span / (KNOTS - 1))
        for width in WIDTHS:
            for place in np.linspace(self.low, self.high, round(2 / width) + 1):
                if np.count_nonzero(abs(self.z - place) < 0.5 * width * span) >= FEWEST:
                    shape = replace(self.flat, place=float(place), width=float(width * span))
                    yield shape
                    yield replace(shape, well=True)
                    yield from self._products(shape)

    def _products(self, shape: Shape) -> Iterator[Shape]:
        """Yield the products of a shape with each factor."""
        for times, slip in self.factors.items():
            yield replace(shape, times=times)
            yield replace(shape, times=times, dry=True, slip=slip)


def _grounds(problem: Problem, equation: str, signals: Signals, units: Mapping[str, str]) -> Iterator[_Ground]:
    """Yield the signals for shapes in an equation."""
    states = [n for n in signals if n in {*problem.layout.states, *problem.layout.rates.values()}]
    pairs = [(a, b) for a, b in combinations(states, 2) if units.get(a, a) == units.get(b, b)]
    for of in (*((n,) for n in signals), *pairs):
        z = _difference(signals, of)
        low, high = np.percentile(z, INSIDE)
        if high > low and np.unique(z).size >= FEWEST:
            factors = _factors(problem, equation, signals, of)
            yield _Ground(Shape(equation, of, "bump", 0.0, 0.0, unit=units.get(of[0], "")), z, low, high, factors)


def _factors(problem: Problem, equation: str, signals: Signals, of: tuple[str, ...]) -> dict[tuple[str, ...], float]:
    """Return signals of possible factors → range within which the sign is smoothed."""
    rates = tuple(problem.layout.rates.get(n, "") for n in of)
    times = [t for t in dict.fromkeys((rates, (equation,))) if signals.keys() >= {*t} and not {*t} & {*of}]
    ranges = {t: float(np.ptp(np.percentile(_difference(signals, t), INSIDE))) for t in times}
    return {t: SLIP * span or 1.0 for t, span in ranges.items()}
