"""Unmodelled dynamics: terms for a residual that no effect of the catalogue explains.

At the fit of a hypothesis, a term c·φ(signal) in the equation of a forced state has a predicted gain of ½·g²/F, with g
the score and F the information of c after projection on the further free parameters. A gain is not due to chance if it
passes the χ² test for the best of all terms (Bonferroni). Such terms are fitted in addition to the hypothesis, before
any conclusion about the equation, its signals and the hypothesis itself. Among terms that these logs hardly
distinguish, the simplest is used.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Any

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import logit

from cosim.core.arrays import Array, NamedValues, Rows
from cosim.core.linear_algebra import least_squares, orthonormal
from cosim.core.units import unit_of_rate
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import DIFFERENCE, Fit, fit
from cosim.estimation.kernel.generate import KNOTS, LOCAL, RATE, READING_PREFIX, SHAPE_PREFIX, SLOTS, bump, rise
from cosim.estimation.kernel.kernel import CONSTANT_PREFIX, DEVIATION, DISTURBANCE, Filtered
from cosim.estimation.parallel import in_parallel
from cosim.estimation.problem import Noise, Problem
from cosim.estimation.screen import DIFFERENCE_SHARE, ScoreTest
from cosim.estimation.subject.candidates import Candidate, Free
from cosim.estimation.subject.interface import Subject
from cosim.refinement.decision.posterior import CERTAIN, LITTLE, MISFIT, chance_of_gain
from cosim.refinement.search.fits import SCREEN_ITERATIONS


@dataclass(frozen=True)
class UnnamedTerm:
    """A term outside the catalogue in the equation of a forced state.

    Attributes:
        equation: State whose derivative has the term, or `reading of` an output.
        signal: Basis function such as `1` or `|velocity|`; for a local shape, its signal.
        gain: Log-likelihood gain, predicted or fitted.
        sizes: Coefficients: one per term, or one per bump of a spline.
        share: Share of the variance of the equation's unknown input that all fitted terms remove.
        shape: Local shape; None for a basis function.
        slot: Number of the local shape in the kernel's parameters.
        like: Law that the local shape resembles, in words; "" for none.
    """

    equation: str
    signal: str
    gain: float = 0.0
    sizes: tuple[float, ...] = ()
    share: float | None = None
    shape: Shape | None = None
    slot: int = 1
    like: str = ""

    @property
    def names(self) -> tuple[str, ...]:
        """Return the parameter names of the coefficients."""
        return self.shape.coefficients(self.slot) if self.shape else (f"{SHAPE_PREFIX}.{self.equation}.{self.signal}",)

    @property
    def settings(self) -> dict[str, float]:
        """Return the kernel's parameters of the local shape, without its coefficients."""
        return self.shape.settings(self.slot) if self.shape else {}

    @property
    def coefficient(self) -> float:
        """Return the largest coefficient."""
        return max(self.sizes, key=abs)

    @property
    def entry(self) -> dict[str, Any]:
        """Return the term as an entry of refine.json."""
        entry = {name: getattr(self, name) for name in ("equation", "signal", "gain", "coefficient", "like")}
        if shape := self.shape:
            local = {**vars(shape), "sizes": self.sizes}
            del local["equation"]
            entry |= {"place": shape.place, "width": shape.width, "local": local}
        return entry


@dataclass(frozen=True)
class Leftover:
    """Unmodelled dynamics that are fitted in addition to a hypothesis.

    Attributes:
        terms: Terms with fitted values, most likely first.
        fit: Fit of the hypothesis with these terms; None without terms.
        gain: Log-likelihood gain of all terms together.
        among: Number of coefficients that were tried.
        is_stable: True if, without any single log, a term of the same signal is still among the most likely.
        is_placed: True if, without any single log, a term of the same equation is still among the most likely.
    """

    terms: tuple[UnnamedTerm, ...] = ()
    fit: Fit | None = None
    gain: float = 0.0
    among: int = 1
    is_stable: bool = True
    is_placed: bool = True


LINEAR = 1e-5, 1.0  # change of the innovations by a step, in standard deviations: above rounding, and still linear


def find_unnamed_terms(problem: Problem, at: Fit, units: Mapping[str, str]) -> Leftover:
    """Return terms, in addition to a fit, whose gain is not due to chance.

    Args:
        problem: Problem whose kernel includes unmodelled dynamics.
        at: Fit of the same logs without these terms.
        units: Units of time, states and commands; local shapes use differences of states with equal units.
    """
    test, price = ScoreTest(problem, at), problem.price
    simple = [n.split(".", 2)[1:] for n in problem.layout.parameters if n.startswith(f"{SHAPE_PREFIX}.")]
    shapes, tried, signals = promising_shapes(test, units)
    terms = [UnnamedTerm(equation, signal) for equation, signal in simple]
    terms += [UnnamedTerm(shape.equation, shape.signal, shape=shape) for shape in shapes]
    among = len(simple) + tried
    usual = dict(zip(problem.layout.forced, np.sqrt(problem.plain.density), strict=True))
    usual |= {READING_PREFIX + n: float(np.sqrt(r)) for n, r in zip(problem.layout.outputs, problem.r, strict=True)}

    def effects(u: UnnamedTerm) -> tuple[list[Array], list[float]]:
        """Return the change of the innovations by a detectable step of each coefficient, and the steps."""
        rows, steps = list[Array](), list[float]()
        for name in u.names:
            step = DIFFERENCE * usual[u.equation]
            row = test.row({**u.settings, name: step})
            size = float(np.linalg.norm(row))
            steps.append(step / size if size > 0.0 else step)
            is_linear = LINEAR[0] <= size <= LINEAR[1]
            rows.append(row / size if is_linear else test.row({**u.settings, name: steps[-1]}))
        return rows, steps

    found = in_parallel(effects, terms)

    def is_chance(u: UnnamedTerm, gain: float) -> bool:
        return among * chance_of_gain(gain / problem.scatter, len(u.names)) > MISFIT

    def likeliest(gains: Sequence[float]) -> list[int]:
        """Return the indices of terms that are nearly as likely as the best one, simplest first."""
        nets = [gain / problem.scatter - price * len(u.names) for u, gain in zip(terms, gains, strict=True)]
        return [k for k, net in enumerate(nets) if net >= max(nets) - float(logit(CERTAIN))]

    chosen: list[UnnamedTerm] = []
    before, sum_before = list[Array](), 0.0
    while terms and len(chosen) < SLOTS:  # each local shape needs a slot of the kernel
        gains = [test.gain([*before, *rows])[0] - sum_before for rows, _ in found]
        k = likeliest(gains)[0]
        u, (rows, steps) = terms[k], found[k]
        if is_chance(u, gains[k]):
            break
        multiples = test.gain(rows)[1]
        sizes = tuple(float(m * step) for m, step in zip(multiples, steps, strict=True))
        before, sum_before = [*before, *rows], sum_before + gains[k]
        chosen.append(replace(u, gain=gains[k], sizes=sizes, slot=len(chosen) + 1))
    if not chosen:
        return Leftover()
    without = fit(problem, at.free, at.values, at.noise, iterations=SCREEN_ITERATIONS)
    while chosen:
        scales = [(n, abs(size) or 1.0) for u in chosen for n, size in zip(u.names, u.sizes, strict=True)]
        free = [*at.free, *(Free(name, -math.inf, math.inf, scale) for name, scale in scales)]
        settings = {name: value for u in chosen for name, value in u.settings.items()}
        # Terms start at zero, so the objective can only decrease.
        fitted = fit(problem, free, {**at.values, **settings}, at.noise, iterations=SCREEN_ITERATIONS)
        refitted = []
        for u in chosen:
            sizes = tuple(fitted.values[name] for name in u.names)
            gain = 0.5 * float(np.array(sizes) @ fitted.marginal(u.names) @ np.array(sizes))  # with all terms
            refitted.append(replace(u, gain=gain, sizes=sizes))
        refitted.sort(key=lambda u: price * len(u.names) - u.gain / problem.scatter)
        if not is_chance(refitted[-1], refitted[-1].gain):
            break
        chosen = refitted[:-1]
    else:
        return Leftover()
    first = refitted[0]
    share = None
    if first.equation in problem.layout.forced and not problem.trusted:
        place = problem.layout.forced.index(first.equation)
        share = 1.0 - math.exp(float(fitted.noise.power[place] - without.noise.power[place]))
    like = ""
    if first.shape is not None:
        where = first.equation, first.signal
        own = [(u.shape, u.sizes) for u in refitted if u.shape and (u.equation, u.signal) == where]
        like = law_of(own, signals, is_rate={*problem.layout.rates.values()}.issuperset(first.shape.of))
    logs = range(max(2, len(problem.logs)))
    of_logs = [[terms[k] for k in likeliest([test.gain_without(rows, log) for rows, _ in found])] for log in logs]
    return Leftover(
        (replace(first, share=share, like=like), *refitted[1:]),
        fitted,
        without.objective - fitted.objective,
        among,
        is_stable=all(any(u.signal == first.signal for u in likely) for likely in of_logs),
        is_placed=all(any(u.equation == first.equation for u in likely) for likely in of_logs),
    )


# Local shapes of unmodelled dynamics over a signal or over time.
#
# A smoother estimates the missing input of each equation in each row. Regression on shapes over time, each state, each
# command, and each difference of two states with equal units selects the best ones for a filter run: bumps, steps, and
# rows of bumps (splines). Spectra over each signal and over time select waves. A factor, such as a velocity or a
# command, may multiply a shape.
#


LINEARIZATION_ROWS = 4  # rows between linearizations, sufficient for a regression
DIFFERENCE_SIGN = " − "
ENDS = 0.5 * (1.0 - CERTAIN), 0.5 * (1.0 + CERTAIN)  # quantiles of a signal, beyond which rows are few

Signals = Mapping[str, Array]


@dataclass(frozen=True)
class Shape:
    """A local shape: a function of a signal, possibly times a factor, in the equation of a state.

    Attributes:
        equation: Forced state, or `reading of` an output.
        of: Signal of the shape; two signals mean their difference.
        kind: `bump`, `step`, `spline` or `wave`.
        place: Centre of a bump or step, centre of the first bump of a spline, or point of zero phase of a wave.
        width: Width of a bump at half its height, length of the transition of a step, distance between the bumps of a
            spline, period of a wave.
        times: Signals that multiply the shape, possibly none.
        unit: Unit of place and width.
    """

    equation: str
    of: tuple[str, ...]
    kind: str
    place: float
    width: float
    times: tuple[str, ...] = ()
    unit: str = ""

    @property
    def signal(self) -> str:
        """Return the signal as text."""
        return DIFFERENCE_SIGN.join(self.of)

    @property
    def factor(self) -> str:
        """Return the factor as text; "" without a factor."""
        return DIFFERENCE_SIGN.join(self.times)

    @property
    def per(self) -> float:
        """Return the change of the normalised signal ζ per unit of the signal."""
        return {"spline": 1.0, "wave": 2.0 * np.pi}.get(self.kind, 2.0) / self.width

    def settings(self, slot: int) -> dict[str, float]:
        """Return this shape's kernel parameters in a slot."""
        of, by = f"{LOCAL}.{slot}.of.", f"{LOCAL}.{slot}.by."
        settings = {f"{LOCAL}.{slot}.to.{self.equation}": 1.0, f"{of}1": -self.place * self.per}
        settings |= {f"{of}{n}": s * self.per for n, s in zip(self.of, (1.0, -1.0), strict=False)}
        return settings | ({f"{by}{n}": s for n, s in zip(self.times, (1.0, -1.0), strict=False)} or {f"{by}1": 1.0})

    def coefficients(self, slot: int) -> tuple[str, ...]:
        """Return the names of the kernel parameters that scale this shape in a slot."""
        splines = tuple(map(str, range(KNOTS)))
        own = {"bump": ("0",), "step": ("rise",), "spline": splines, "wave": ("sin", "cos")}[self.kind]
        return tuple(f"{LOCAL}.{slot}.{name}" for name in own)

    def columns(self, signals: Signals) -> Array:
        """Return the regressor of each coefficient, shape (rows, coefficients)."""
        over = self.per * (values_of(signals, self.of) - self.place)
        others: dict[str, list[Any]] = {"bump": [bump], "step": [rise], "wave": [np.sin, np.cos]}
        basis = [f(over) for f in others.get(self.kind, ())] or [bump(over - k) for k in range(KNOTS)]
        return np.stack(basis, axis=1) * (values_of(signals, self.times)[:, None] if self.times else 1.0)


def values_of(signals: Signals, names: Sequence[str]) -> Array:
    """Return the values of a signal, or of the difference of two."""
    return signals[names[0]] - signals[names[1]] if len(names) > 1 else signals[names[0]]


def signals_of(problem: Problem, missing: MissingInput) -> dict[str, Array]:
    """Return name → values of the signals for local shapes."""
    layout, commands = problem.layout, missing.of_logs([log.u for log in problem.logs])
    named = dict(zip(layout.states, missing.states.T, strict=True))
    own = {n: z for n, z in named.items() if not n.startswith((DISTURBANCE, CONSTANT_PREFIX))}
    if layout.is_free_run:
        own = {n: named[n] + named[DEVIATION + n] for n in layout.outputs}
        for rate in (n for n in layout.rates.values() if n.startswith(RATE)):
            each = zip(missing.by_log(own[rate.removeprefix(RATE)]), problem.logs, strict=False)
            own[rate] = np.concatenate([np.diff(z, prepend=z[:1]) / log.step for z, log in each])
    return {"time": missing.time, **own, **{f"command {n}": u for n, u in zip(layout.inputs, commands.T, strict=True)}}


def signal_units(subject: Subject) -> dict[str, str]:
    """Return the unit of each signal: time, commands, states, outputs, and rates of states and outputs."""
    named = {q.name: q.unit for q in (*subject.outputs, *subject.states)}
    rates = {f"{RATE}{name}": unit_of_rate(unit) for name, unit in named.items()}
    return {"time": "s", **{f"command {q.name}": q.unit for q in subject.inputs}, **named, **rates}


def promising_shapes(test: ScoreTest, units: Mapping[str, str]) -> tuple[list[Shape], int, Signals]:
    """Return the most likely shape of each kind and equation, the number of shapes tried, and the signals.

    A shape is a function of a signal that may be missing in an equation.

    Args:
        test: Score test at the fit.
        units: Units of the signals; two states with equal units also give a difference signal.
    """
    problem, at, prefix = test.problem, test.at, f"{LOCAL}.1.of."
    price = problem.price
    names = {n.removeprefix(prefix) for n in problem.layout.parameters if n.startswith(prefix)}
    if not names:
        return [], 0, {}
    with np.errstate(invalid="ignore", over="ignore"):
        missing = smooth_logs(problem, at)
    signals = {n: z for n, z in signals_of(problem, missing).items() if n in names}
    if not all(np.isfinite(z).all() for z in (missing.value, *signals.values())):
        return [], 0, signals
    shapes, tried = [], 0
    variances = np.mean(missing.sigma**2, axis=0)
    for equation, value, variance in zip(missing.equations, missing.value.T, variances, strict=True):
        own = [signals[equation]] if equation in signals else []
        others = orthonormal(np.column_stack([np.ones(len(value)), *own]))
        lacking = value - others @ (others.T @ value)
        best: dict[str, tuple[float, Shape]] = {}
        for shape in _shapes(problem, equation, signals, units):
            columns = shape.columns(signals)
            columns = columns - others @ (others.T @ columns)
            products, target = columns.T @ columns, columns.T @ lacking
            net = 0.5 * float(target @ least_squares(products, target)) / variance - price * columns.shape[1]
            tried += columns.shape[1]
            if net > best.get(shape.kind, (0.0, shape))[0]:
                best[shape.kind] = net, shape
        shapes += [shape for _, shape in best.values()]
    waves, lines = _likely_waves(test, missing, signals)
    prefix = f"{LOCAL}.1.to."
    places = [n.removeprefix(prefix) for n in problem.layout.parameters if n.startswith(prefix)]
    for wave, place in product(waves, places):  # innovations show an error of a reading times a rate of the signal
        times = () if place.startswith(READING_PREFIX) else wave.times
        shapes.append(replace(wave, equation=place, times=times, unit=units.get(wave.signal, "")))
    return shapes, tried + lines * len(places), signals


def _shapes(problem: Problem, equation: str, signals: Signals, units: Mapping[str, str]) -> Iterator[Shape]:
    """Yield the shapes of an equation: over each signal, bumps of two widths, steps and a spline."""
    rates = problem.layout.rates
    states = [n for n in signals if n in {*problem.layout.states, *rates.values()}]
    pairs = [(a, b) for a, b in combinations(states, 2) if units.get(a, a) == units.get(b, b)]
    for of in (*((n,) for n in signals), *pairs):
        z = values_of(signals, of)
        low, high = (float(end) for end in np.quantile(z, ENDS))
        if not high > low or np.unique(z).size <= KNOTS:
            continue
        factors = {tuple(rates.get(n, "") for n in of), (equation,)}
        factors |= {(n,) for n in signals if n.startswith("command ")} if of == ("time",) else set()
        times = [(), *(t for t in sorted(factors) if signals.keys() >= {*t} and not {*t} & {*of})]
        width = (high - low) / (KNOTS - 1)
        shape = Shape(equation, of, "spline", low, width, unit=units.get(of[0], ""))
        yield shape
        for factor in times:
            places = np.linspace(low, high, KNOTS).tolist()
            yield from (replace(shape, kind="step", place=p, times=factor) for p in places[1:-1])
            for count in (KNOTS, 2 * KNOTS):
                bumps = np.linspace(low, high, count).tolist()
                width = 2.0 * (high - low) / (count - 1)
                yield from (replace(shape, kind="bump", place=p, width=width, times=factor) for p in bumps)


def _likely_waves(test: ScoreTest, missing: MissingInput, signals: Signals) -> tuple[list[Shape], int]:
    """Return the waves with the highest spectral lines, over time and over another signal, and the number of lines.

    Spectra are computed from the innovations, multiplied by a factor.
    """
    commands = [n for n in signals if n.startswith("command ")]
    tables = missing.by_log(missing.of_logs(innovations_of_logs(test)))
    tried, found = 0, dict[bool, tuple[float, Shape]]()
    for name, z in signals.items():
        if np.unique(z).size <= KNOTS:
            continue
        low = 2.0 * KNOTS * float(np.ptp(z)) / len(z)
        for factor in {n: None for n in ("", test.problem.layout.rates.get(name, ""), *commands) if n != name}:
            by = values_of(signals, (factor,))[:, None] if factor else np.ones((len(z), 1))
            own = zip(missing.by_log(z), tables, missing.by_log(by), strict=True)
            frequency, height = spectrum_along([(q, table * times) for q, table, times in own], low)
            line = 2 + int(np.argmax(height[2:]))  # at least one period in the travel
            over = float(height[line] / np.mean(height)) if height.any() else 0.0  # logs may be at rest
            if over > found.get(name == "time", (0.0, None))[0]:
                wave = Shape("", (name,), "wave", 0.0, 1.0 / float(frequency[line]), (factor,) if factor else ())
                found[name == "time"] = over, wave
            tried += len(height)
    return [wave for _, wave in found.values()], tried


def law_of(terms: Sequence[tuple[Shape, Sequence[float]]], signals: Signals, *, is_rate: bool) -> str:
    """Return a phrase on the laws that local shapes over one signal together resemble; "" for none.

    Each law is compared as a spline approximates it. A straight line is not a law, because parameters of the model can
    represent it.

    Args:
        terms: Shapes with their coefficients.
        is_rate: True if the signal is a velocity.
    """
    shapes = [shape for shape, _ in terms]
    if any(shape.times for shape in shapes) or all(shape.kind != "spline" for shape in shapes):
        return ""
    z, columns = values_of(signals, shapes[0].of), np.hstack([shape.columns(signals) for shape in shapes])
    line, space = (orthonormal(np.column_stack(parts)) for parts in ([np.ones_like(z), z], [*columns.T]))

    def beside_line(column: Array) -> Array:
        return np.asarray(column - line @ (line.T @ column))

    rest = beside_line(columns @ np.concatenate([sizes for _, sizes in terms]))
    if is_rate:
        laws = [
            ("dry friction", np.sign(z)),
            ("drag with the square of the speed", z * np.abs(z)),
            ("friction with the cube of the speed", z**3),
        ]
    else:
        widths = np.abs(z).max() * 0.5 ** np.arange(1, KNOTS)
        laws = [("a preload", np.sign(z)), ("a spring with the cube of the deflection", z**3)]
        laws += [("free play", np.clip(z, -width, width)) for width in widths]
    shares: dict[str, float] = {}
    for name, column in laws:
        law = beside_line(space @ (space.T @ column))
        power = float(law @ law) * float(rest @ rest)
        shares[name] = max(shares.get(name, 0.0), float(law @ rest) ** 2 / power if power else 0.0)
    return " or ".join(n for n in sorted(shares, key=lambda n: -shares[n]) if shares[n] > 1.0 - LITTLE)


# Likely periods of forces that repeat along a position, determined before a score test.
#
# A force that repeats many times over the travel has no predicted gain at another period, and no fit finds its period
# from there. The innovations of the base fit, ordered by position, show the period as a line of their spectrum.
# Innovations lag behind the force by the response of the machine, which shifts them to opposite sides for the two
# directions of motion, so that each direction has a spectrum of its own. A score test of the strongest lines and of the
# usual periods decides, and then searches around the best one.


RADIAN = 2.0 * math.pi  # standard deviations of a position in the shortest period: one radian of its phase
MAX_TESTED_LINES = 3  # strongest lines that a score test compares


def with_likely_periods(
    test: ScoreTest, candidates: Sequence[Candidate], known: Sequence[str]
) -> tuple[list[Candidate], dict[str, float]]:
    """Return the candidates, and their periods with the largest predicted gain, which the test then uses.

    Args:
        known: Names of candidates in the fit, which keep their periods.
    """
    chosen = [_with_period(test, c) if c.repeats and c.name not in known else c for c in candidates]
    periods = {c.repeats[0]: test.values[c.repeats[0]] for c in chosen if c.repeats and c.name not in known}
    return chosen, periods


def _with_period(test: ScoreTest, c: Candidate) -> Candidate:
    """Return a candidate that starts at the period with the largest predicted gain.

    Forces with shorter periods than RADIAN standard deviations of the position cannot be estimated.
    """
    from scipy.signal import find_peaks  # imported here, since the import takes half a second

    (name, along), problem, layout = c.repeats, test.problem, test.problem.layout
    (period,) = (f for f in c.free if f.name == name)
    sizes = [f for f in c.free if f.neutral is not None]
    places = [layout.states.index(n) for n in (along, DEVIATION + along) if n in layout.states]
    runs = [problem.run(test.values, test.noise, k) for k in range(len(problem.logs))]
    positions = [run.states[:, places].sum(axis=1) for run in runs]
    own = [k for k, place in enumerate(layout.stochastic) if place in places]
    known = [run.covariances[:, own][:, :, own] for run in runs if run.covariances is not None]
    variances = [0.0]
    if known and own:
        variances.append(float(np.median(np.concatenate(known).sum(axis=(1, 2)))))
    if along in layout.outputs:
        variances.append(float(np.exp(test.noise.sensors[layout.outputs.index(along)])))
    low = min(max(period.low, RADIAN * math.sqrt(max(variances))), period.high)
    travel = float(np.ptp(np.concatenate(positions)))
    if not 0.0 < travel < math.inf:
        return c

    def gain(value: float) -> float:
        start = {name: value - test.values[name]}
        return test.gain([test.row(start | {f.name: DIFFERENCE_SHARE * f.size}) for f in sizes])[0]

    def at(cycles: float, value: float) -> float:
        """Return the period with `cycles` more cycles over the travel."""
        return min(max(1.0 / (1.0 / value + cycles / travel), low), period.high)

    frequency, height = spectrum_along([*zip(positions, innovations_of_logs(test), strict=True)], low)
    height[frequency * period.high < 1.0] = 0.0
    peaks, _ = find_peaks(height, distance=2 * 2)  # two cycles over the travel
    strongest = sorted(peaks, key=lambda peak: -height[peak])[:MAX_TESTED_LINES]
    tried = [*(start[name] for start in c.starts), *(1.0 / float(frequency[peak]) for peak in strongest)]
    near = tried[int(np.argmax(in_parallel(gain, tried)))]
    climb = minimize_scalar(
        lambda cycles: -gain(at(cycles, near)), bounds=(-1.0, 1.0), method="bounded", options={"xatol": DIFFERENCE}
    )
    best = test.values[name] = at(float(climb.x), near)
    size = best**2 / (RADIAN * travel)  # changes the phase over the travel by 1 rad
    free = tuple(replace(f, low=low, size=size) if f.name == name else f for f in c.free)
    return replace(c, free=free, among=max(1, round(travel / low)), starts=({**c.starts[0], name: best},))


def innovations_of_logs(test: ScoreTest) -> list[Array]:
    """Return the normalised innovations of each log (rows, outputs), without what free parameters can imitate."""
    tables = []
    parts = test.scored.of_each_log(test.residual[: len(test.scored.errors)])
    for part, readings, log in zip(parts, test.problem.readings, test.problem.logs, strict=True):
        tables.append(np.zeros(log.y.shape))
        tables[-1].put(readings.places, part)
    return tables


def spectrum_along(tracks: Sequence[tuple[Array, Array]], low: float) -> tuple[Array, Array]:
    """Return frequencies and spectrum of tables along positions, with a separate spectrum per direction of motion.

    Args:
        tracks: Positions and table of each log, shapes (rows,) and (rows, columns).
        low: Shortest period.
    """
    first = min(float(q.min()) for q, _ in tracks)
    count = 2 + int(2.0 * (max(float(q.max()) for q, _ in tracks) - first) / low)  # two cells in the shortest period
    cells = np.zeros((2, tracks[0][1].shape[1], count))
    for q, table in tracks:
        middle = (2.0 * (0.5 * (q[1:] + q[:-1]) - first) / low).astype(np.intp)
        for direction, moving in enumerate((np.diff(q) > 0.0, np.diff(q) < 0.0)):
            for column, values in enumerate(table[1:].T):
                cells[direction, column] += np.bincount(middle[moving], values[moving], count)
    height = np.sum(np.abs(np.fft.rfft(cells, 2 * count)) ** 2, axis=(0, 1))
    frequency = np.arange(len(height)) / (count * low)
    height[frequency * low > 1.0] = 0.0
    return frequency, height


# The part of each derivative that a model lacks, in each row, and the contribution of a hypothesis to it.
#
# Each forced equation has an unknown input, a state of the filter. A Rauch-Tung-Striebel smoother (1965) estimates it
# in each row from the readings before and after, along the filtered states x̂ with covariances P,
#
#     xₖ = x̂ₖ + G·(xₖ₊₁ − f(x̂ₖ))      G = P·F'·(F·P·F' + Q)⁻¹      F = ∂f/∂x by differences of single kernel steps
#
# The power of the unknown inputs is the fitted power, at least `NoiseRange.plain`. The contribution of a hypothesis is
# a model step with the hypothesis minus a step without, divided by the step.
#


MAX_SMOOTHED_ROWS = 3000  # largest number of smoothed rows of a log
LOGS = 2  # number of smoothed logs, from the first
NUDGE = 1e-4  # difference step relative to the size of a state; kernel steps are smooth at this scale


@dataclass(frozen=True, eq=False)
class MissingInput:
    """Missing input d of each forced equation in the rows of the first logs, log after log.

    The unit of d is the unit of the state per second.

    Attributes:
        rows: Rows of each log.
        sigma: Standard deviation of `value`.
        states: All kernel states, filtered by the base fit.
    """

    equations: tuple[str, ...]
    rows: Sequence[slice]
    time: Array
    value: Array
    sigma: Array
    states: Array

    def of_logs(self, tables: Sequence[Array]) -> Array:
        """Return the rows `rows` of a table for each log, log after log."""
        return np.concatenate([table[rows] for table, rows in zip(tables, self.rows, strict=False)])

    def by_log(self, values: Array) -> list[Array]:
        """Return values of all rows split by log."""
        return np.split(values, np.cumsum([rows.stop - rows.start for rows in self.rows])[:-1])


def next_rows(problem: Problem, values: NamedValues, index: int, points: tuple[Rows, Array, Array]) -> Array:
    """Return the states at the next row for each of some rows with given states and memories."""
    runs = problem.simulate_from(values, index, (points[0].tolist(), *points[1:]))
    return np.array([run.states[1] for run in runs])


def smooth_logs(problem: Problem, base: Fit) -> MissingInput:
    """Return the smoothed missing inputs of the first logs; for free runs, the inputs that drive the deviations.

    A fit without unknown inputs counts model errors as sensor noise; the stated sensor noise then replaces it.
    """
    layout, noise, found = problem.layout, base.noise, list[tuple[Any, ...]]()
    bare = np.allclose(noise.power, problem.noise.smallest)
    sensors = np.minimum(noise.sensors, np.log(problem.r)) if bare else noise.sensors
    noise = replace(problem.plain, sensors=sensors, power=np.maximum(noise.power, problem.noise.plain))
    reached, places = list(layout.stochastic), list(layout.noisy)
    for index in range(min(LOGS, len(problem.logs))):
        data, run = problem.data(base.values, index), problem.run(base.values, noise, index)
        count = min(len(data.u), MAX_SMOOTHED_ROWS)
        scored, x = slice(min(count_unscored(data), count - 1), count - 1), run.states[:count, reached]
        if run.covariances is None:  # filtered inputs, with the uncertainty before any reading
            sigma = np.tile(np.exp(0.5 * noise.power), (count, 1))
        else:
            if layout.is_free_run:
                F = _transitions_of_deviations(problem, base.values, noise, index)[:count]
                ahead = np.einsum("kij,kj->ki", F, x)
            else:
                ahead, F = _linearized_steps(problem, base.values, index, run, count)
            x, P, Q = x.copy(), run.covariances[:count].copy(), np.diag(problem.densities(noise)) * data.step
            for k in range(count - 2, -1, -1):
                spread = F[k] @ P[k] @ F[k].T + Q
                gain = least_squares(spread, F[k] @ P[k]).T
                x[k] += gain @ (x[k + 1] - ahead[k])
                P[k] += gain @ (P[k + 1] - spread) @ gain.T
            sigma = np.sqrt(np.maximum(np.diagonal(P, axis1=1, axis2=2)[:, places], 0.0))
        found.append((scored, data.times[scored], x[scored, places], sigma[scored], run.states[scored]))
    rows, *parts = zip(*found, strict=True)
    return MissingInput(layout.forced, rows, *map(np.concatenate, parts))


def _transitions_of_deviations(problem: Problem, values: NamedValues, noise: Noise, index: int) -> Array:
    """Return the transition matrices of a free run's random states, from each row to the next.

    Random states are the previous row's deviations, the inputs that drive deviations, the deviations, and constants.
    """
    layout, data = problem.layout, problem.data(values, index)
    ny, n = len(layout.outputs), len(layout.stochastic)
    F = np.tile(np.eye(n), (len(data.u), 1, 1))
    earlier, drive, deviation = (slice(k * ny, (k + 1) * ny) for k in (0, 1, 2))
    _, propagation = problem.kernel.responses(data, problem.start(values, index)[0])  # type: ignore[attr-defined]
    F[:, earlier, earlier], F[:, earlier, deviation] = 0.0, np.eye(ny)
    F[:, drive, drive] *= math.exp(-data.step / math.exp(noise.memory))
    F[:, deviation, deviation], F[:, deviation, earlier] = propagation[:, :ny], propagation[:, ny:]
    F[:, deviation, drive] = data.step * np.eye(ny)
    return F


def unknown_inputs(problem: Problem, at: Fit, units: Mapping[str, str]) -> dict[str, float]:
    """Return forced state → size of its unknown input relative to the derivatives of states with the same unit.

    Args:
        units: Units of the states.
    """
    names, deviations = problem.layout.forced, np.exp(0.5 * at.noise.power)  # `power` is ln of the variance
    largest: dict[tuple[str, int], float] = {}  # unit and order → range of the derivatives
    orders = [1] * len(problem.layout.noisy)
    if problem.layout.is_free_run:  # 2 if the output also depends on its row before the last: its velocity is hidden
        propagation = problem.kernel.responses(problem.logs[0], problem.x0[0])[1]  # type: ignore[attr-defined]
        orders = [1 + bool(propagation[:, j].any()) for j in range(len(orders), 2 * len(orders))]
    kinds = {n: (units[n], order) for n, order in zip(names, orders, strict=True)}
    runs = [problem.run(at.values, at.noise, k) for k in range(len(problem.logs))]
    for name, place in zip(names, problem.layout.forced_places, strict=True):
        change = [
            np.diff(run.states[count_unscored(d) :, place], kinds[name][1]) / d.step
            for run, d in zip(runs, problem.logs, strict=True)
        ]
        low, high = np.quantile(np.concatenate(change), (0.5 * (1.0 - CERTAIN), 0.5 * (1.0 + CERTAIN)))
        largest[kinds[name]] = max(largest.get(kinds[name], np.finfo(float).tiny), float(high - low))
    return {n: float(p) / largest[kinds[n]] for n, p in zip(names, deviations, strict=True)}


def contributions(problem: Problem, base: Fit, after: Fit, index: int) -> Array:
    """Return the contribution of a claim to each forced equation in the smoothed rows.

    Both steps (with and without the claim) start from the refined model's estimate of measured states, and from their
    own estimates of the other states.
    """
    layout, data = problem.layout, problem.logs[index]
    runs = [problem.run(f.values, f.noise, index) for f in (base, after)]
    rows, shared = min(len(data.u), MAX_SMOOTHED_ROWS) - 1, list(layout.stochastic)
    states = [np.array([problem.drop_unknown_inputs(x) for x in run.states[:rows]]) for run in runs]
    states[0][:, shared] = states[1][:, shared]
    without, with_it = (
        next_rows(problem, f.values, index, (np.arange(rows), x, run.memory[:rows]))
        for f, x, run in zip((base, after), states, runs, strict=True)
    )
    return np.asarray((with_it - without)[min(count_unscored(data), rows) :, layout.forced_places] / data.step)


def _linearized_steps(
    problem: Problem, values: NamedValues, index: int, run: Filtered, rows: int
) -> tuple[Array, Array]:
    """Return the prediction of each next row from the filtered states, and its derivative by finite differences."""
    reached, states, memory = list(problem.layout.stochastic), run.states[: rows - 1], run.memory[: rows - 1]
    size = NUDGE * np.maximum(np.abs(states[:, reached]).max(axis=0), np.sqrt(np.diag(problem.P0)))
    size = np.where(size > 0.0, size, NUDGE)  # a fixed parameter per log may be 0
    every_row, some = np.arange(rows - 1), np.arange(0, rows - 1, LINEARIZATION_ROWS)
    ahead = next_rows(problem, values, index, (every_row, states, memory))[:, reached]
    F = np.empty((rows - 1, len(reached), len(reached)))
    for j, state in enumerate(reached):
        nudged = states[some].copy()
        nudged[:, state] += size[j]
        moved = next_rows(problem, values, index, (some, nudged, memory[some]))[:, reached]
        F[:, :, j] = ((moved - ahead[some]) / size[j])[every_row // LINEARIZATION_ROWS]
    return ahead, F
