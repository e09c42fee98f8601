"""Consistency of estimators: normalised errors and innovations compared with their χ² distribution.

    NEES  ε = (x − x̂)'·P⁻¹·(x − x̂),   n degrees of freedom, n states
    NIS   ε = ν'·S⁻¹·ν,               m degrees of freedom, m measurements

For N independent runs of a consistent estimator, N·(mean of ε at one time) is χ² with N·n degrees of freedom
(Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation, 5.4). Two tests follow:

    mean over all times    n if consistent; the scatter between independent runs is the uncertainty
    each single time       2.5 % of the times lie above the 95 % region, 2.5 % below

Errors of successive times are correlated, so shares of times scatter like those of fewer independent times.
Innovations of a consistent estimator are white: all times count, and the mean of K times is χ² with N·K·m. The two
tests share the error probability of 5 %.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from controller.closed_loop import ClosedLoop
from controller.design_model import Matrix, discrete_model, measurement_matrix
from controller.observers import AT, ESTIMATED_STATES, ExtendedFilter, LinearFilter, carried
from controller.settings import ESTIMATORS, PLANT_STATES, SENSED, ExtendedSettings, Settings, variances_of
from cosim.core.arrays import Array
from cosim.core.errors import Fault, InputError, refuse
from cosim.core.settings import Count, Seed
from cosim.core.text import counted, percent, plain
from cosim.model import Moment, Stepper
from cosim.model.namespaces import arrays
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Band, Panel, Trace
from cosim.report.template import render
from plant.hovercraft import Hovercraft

TEMPLATE = Path(__file__).with_name("templates") / "consistency.html.j2"
CONFIDENCE_LEVEL = 0.95
SIDE_SHARE = 0.5 * (1.0 - CONFIDENCE_LEVEL)  # expected share of times on either side of their region
HALF = 0.25 * (1.0 - CONFIDENCE_LEVEL)  # tail probability on each side of each of the two tests
CONSISTENT, OPTIMISTIC, PESSIMISTIC = "consistent", "optimistic", "pessimistic"
BOTH = f"{OPTIMISTIC} and {PESSIMISTIC}"
ROWS_AT_ONCE = 256  # rows of the correlation matrix processed at once
MIN_RUNS = 2
MIN_STEPS = 100  # errors count after the first second
MAX_SAMPLES = 20_000_000  # samples of all runs of a case: about 400 bytes each, 8 GB in total


class Consistency(NamedTuple):
    """Result of a χ² test of normalised squared errors (NEES) or innovations (NIS), called squares here.

    Attributes:
        mean: Mean over runs and times.
        region: Range of `mean` for a consistent estimator.
        at_times: Mean over the runs at each time, shape (times,).
        at_time: 95 % range of each of `at_times` for a consistent estimator.
        above, below: Shares of `at_times` above and below `at_time`; 2.5 % is expected.
        most: Upper limit of `above` and `below` for a consistent estimator.
        times: Number of independent times for which the shares would have the same scatter.
    """

    degrees: int
    runs: int
    mean: float
    region: tuple[float, float]
    above: float
    below: float
    most: float
    times: float
    at_times: Array
    at_time: tuple[float, float]

    @property
    def share(self) -> float:
        """Return the share of times with a mean inside the 95 % range; 0.95 is expected."""
        return 1.0 - self.above - self.below

    @property
    def verdict(self) -> str:
        """Return the verdict: consistent, optimistic (errors larger than the covariance), pessimistic, or both."""
        low, high = self.region
        optimistic = self.mean > high or self.above > self.most
        pessimistic = self.mean < low or self.below > self.most
        if optimistic and pessimistic:
            return BOTH
        return OPTIMISTIC if optimistic else PESSIMISTIC if pessimistic else CONSISTENT

    @property
    def factor(self) -> float:
        """Return the mean squared error divided by the variance that the estimator claims."""
        return self.mean / self.degrees


def consistency_of(squares: Array, degrees: int, *, white: bool = False) -> Consistency:
    """Return the consistency of normalised squared errors or innovations.

    Args:
        squares: Normalised squares, shape (runs, times).
        degrees: Degrees of freedom of each square.
        white: True for squares that are not correlated within a run, such as those of innovations.

    Raises:
        ValueError: A square is not finite.
    """
    from scipy.stats import beta, chi2, t

    if not np.isfinite(squares).all():
        raise ValueError("normalised squares must be finite")
    runs, count = squares.shape

    def range_of_mean(number: int, tail: float) -> tuple[float, float]:
        low, high = chi2.ppf([tail, 1.0 - tail], number * degrees) / number
        return float(low), float(high)

    low, high = range_of_mean(runs, SIDE_SHARE)
    at_times = squares.mean(axis=0)
    if white:
        region, times = range_of_mean(squares.size, HALF), float(count)
    else:
        off = float(t.ppf(1.0 - HALF, runs - 1) * squares.mean(axis=1).std(ddof=1) / math.sqrt(runs))
        region, times = (degrees - off, degrees + off), independent_times(squares)
    rest = max(times - 1.0, 1e-6)  # beta distribution with this mean and the variance p·(1 − p)/times
    most = float(beta.ppf(1.0 - HALF, SIDE_SHARE * rest, (1.0 - SIDE_SHARE) * rest))
    above, below = float(np.mean(at_times > high)), float(np.mean(at_times < low))
    return Consistency(degrees, runs, float(squares.mean()), region, above, below, most, times, at_times, (low, high))


def independent_times(squares: Array) -> float:
    """Return the number K of independent times for which the share of times above the limit has the same scatter.

    p·(1 − p)/K is the mean covariance of the events z_j > c and z_k > c. Here z_j is the nearly normal mean over the
    runs at time j, with correlations from the runs; c is the 97.5 % quantile, exceeded with p = 2.5 %.
    """
    from scipy.integrate import cumulative_simpson
    from scipy.stats import norm

    off = squares - squares.mean(axis=0)
    size = np.sqrt((off * off).sum(axis=0))
    z = np.divide(off, size, out=np.zeros_like(off), where=size > 0.0)
    # covariance of two standard normal variables both exceeding c, by their correlation ρ:
    # ∫₀^asin ρ exp(−c²/(1 + sin θ)) dθ/2π
    angle = np.linspace(-0.5 * math.pi, 0.5 * math.pi, 2001)
    with np.errstate(divide="ignore"):
        density = np.exp(-(norm.ppf(SIDE_SHARE) ** 2) / (1.0 + np.sin(angle))) / (2.0 * math.pi)
    integral = cumulative_simpson(density, x=angle, initial=0.0)
    grid, covariance = np.sin(angle), integral - integral[1000]
    total = sum(
        np.interp(z[:, k : k + ROWS_AT_ONCE].T @ z, grid, covariance).sum() for k in range(0, z.shape[1], ROWS_AT_ONCE)
    )
    return float(np.clip(SIDE_SHARE * (1.0 - SIDE_SHARE) * z.shape[1] ** 2 / max(total, 1e-300), 1.0, z.shape[1]))


class ConsistencyRow(NamedTuple):
    """Result of one case on one flight in one test, such as NEES or NIS.

    Attributes:
        case: Estimator and true plant.
        flight: Name of the motion.
        motion: Description of the motion.
        of: Name of the test, such as NEES or NIS.
        at: Times of the tested errors or innovations [s].
    """

    case: str
    flight: str
    motion: str
    of: str
    result: Consistency
    at: Array

    def as_json(self) -> Mapping[str, Any]:
        """Return names, measures and verdict as plain data for scripts."""
        names = ("degrees", "runs", "mean", "region", "share", "above", "below", "most", "times", "verdict", "factor")
        of_row = dict(zip(self._fields[:4], self, strict=False))
        return of_row | {name: getattr(self.result, name) for name in names}

    def as_text(self) -> dict[str, str]:
        """Return names, measures and verdict as texts for tables."""
        r = self.result
        return {
            "case": self.case,
            "flight": self.flight,
            "of": self.of,
            "degrees": str(r.degrees),
            "mean": plain(r.mean, 4),
            "region": f"{plain(r.region[0], 4)} … {plain(r.region[1], 4)}",
            **{name: percent(getattr(r, name)) for name in ("above", "below", "most")},
            "verdict": r.verdict,
        }


def headline(rows: Sequence[ConsistencyRow]) -> str:
    """Return a headline: the number of passed tests, then the case with the largest errors if it fails."""
    passed = sum(row.result.verdict == CONSISTENT for row in rows)
    largest = max((row for row in rows if row.of == "NEES"), key=lambda row: row.result.factor)
    text = f"In {passed} of {len(rows)} tests, the errors match the variance that the estimator claims."
    if (factor := largest.result.factor) > 1.0 and largest.result.verdict != CONSISTENT:
        worst = f"{largest.case}, {largest.flight}: mean square error {factor:.3g} times the claimed variance."
        text += f" Largest errors: {worst}"
    return text


def consistency(
    runs: Count = 50, steps: Count = 500, seed: Seed = 1, progress: Callable[[int, int], None] | None = None
) -> Sequence[ConsistencyRow]:
    """Test the estimators of the hovercraft by Monte Carlo runs.

    Args:
        runs: Number of Monte Carlo runs of each case, at least 2.
        steps: Number of samples of each run, at least 100.
        seed: Seed for all random numbers.
        progress: Function of (completed cases, all cases).

    Returns:
        One row per case and kind of squares (NEES, NIS) with mean, region and verdict.

    Raises:
        InputError: Too few or too many runs or steps.
    """
    check_size(runs, steps, seed)
    rows = []
    for k, case in enumerate(CASES):
        squares = squares_of(case, runs, steps, np.random.default_rng([seed, k]))
        for name, (values, degrees, at) in squares.items():
            result, motion = consistency_of(values, degrees, white=name != "NEES"), MOTIONS[case.flight]
            rows.append(ConsistencyRow(case.title, case.flight, motion, name, result, at))
        if progress is not None:
            progress(k + 1, len(CASES))
    return rows


def check_size(runs: int, steps: int, seed: int) -> None:
    """Raise InputError for too few runs or steps, or for more samples than fit into memory."""
    bounds = (("runs", runs, MIN_RUNS), ("steps", steps, MIN_STEPS), ("seed", seed, 0))
    refuse(Fault(Path(name), 0, 0, f"is {v}; use at least {least}") for name, v, least in bounds if v < least)
    if runs * steps > MAX_SAMPLES:
        text = f"{runs:,} runs of {steps:,} steps exceed the {MAX_SAMPLES:,} samples that fit into memory; use fewer"
        raise InputError.at(Path("--runs"), text)


# -- simulated runs -------------------------------------------------------------------------------
# The truth is the linear model with the disturbance V of eq 5.47, the plant with the extended filter's process noise,
# or the undisturbed plant. All runs share the commands of a flight; the seed determines the noise.

SETTLING_SAMPLES = 50  # samples before errors count
FIX_EVERY = 5  # samples, 10 Hz
# P of the world position is singular
OWN_AXIS_STATES = [k for k, name in enumerate(PLANT_STATES) if not name.endswith("_world")]
SENSED_AT = [[q.name for q in Hovercraft.outputs].index(name) for name in SENSED]
# NEES, NIS, NIS of fixes → (runs, times), degrees of freedom, times [s]
Squares = Mapping[str, tuple[Matrix, int, Matrix]]
Truth = tuple[Matrix, Matrix, Matrix]  # states, readings and positions of every run; each (samples, runs, values)


def sines(steps: int) -> Matrix:
    """Return commands with sinusoidal tilts [rad] and nominal duties."""
    t = Settings().sample_time * np.arange(steps)
    along, about = 0.08 * np.sin(0.9 * t), 0.05 * np.sin(2.3 * t)
    duty = np.full(steps, Hovercraft().duty_nominal)
    return np.stack([duty, duty, along + about, along - about], axis=1)


@cache
def flown_manoeuvre(steps: int) -> Matrix:
    """Return the commands of the LQR for the manoeuvre of App. G, simulated without noise."""
    craft = Hovercraft()
    rig = ClosedLoop(craft, craft.excursion, {}, craft.rate * steps)
    trial = rig.play(craft, rig.usual_signals(craft.rate * np.arange(steps, dtype=np.float64)))
    return np.column_stack([*trial.inputs.values()])


SINES, MANOEUVRE = "sines of the tilts", "manoeuvre of App. G"  # motions
MOTIONS = {
    SINES: "tilts of ±0.08 rad together and ±0.05 rad against each other",
    MANOEUVRE: (
        "by the LQR: turn right by 90° at 1 s, forward 1.5 m at 5 s, turn about at 10 s, forward at 17 s, right at 22 s"
    ),
}


class FlightCase(NamedTuple):
    """A case of the Monte Carlo test: an estimator, a true plant and a flight, with or without position fixes."""

    title: str
    truth: str
    estimator: str
    fixes: bool = False
    flight: str = SINES


ON_SINES = (
    FlightCase("consistent on its own model, disturbed with V", "linear", "consistent"),
    FlightCase("consistent on its own model, with fixes", "linear", "consistent", fixes=True),
    FlightCase("appendix_f on the model of consistent, disturbed with V", "linear", "appendix_f"),
    FlightCase("lagged on the model of consistent, disturbed with V", "linear", "lagged"),
    FlightCase("extended on the plant, disturbed with its Q", "disturbed", "extended"),
    FlightCase("extended on the disturbed plant, with fixes", "disturbed", "extended", fixes=True),
    FlightCase("appendix_f on the plant as it is", "plant", "appendix_f"),
    FlightCase("lagged on the plant as it is", "plant", "lagged"),
    FlightCase("consistent on the plant as it is", "plant", "consistent"),
    FlightCase("extended on the plant as it is", "plant", "extended"),
)
CASES = (*ON_SINES, *(case._replace(flight=MANOEUVRE) for case in ON_SINES))


def linear_truth(runs: int, u: Matrix, rng: np.random.Generator) -> Truth:
    """Return runs of the linear model `consistent` with process noise; readings and positions have no sensor noise.

    x⁺ = F·x + G·u + w, z = H·x + v, from x = 0; w by V, v by W.
    """
    p = Settings(estimator="consistent")
    (F, G), H = discrete_model(p), measurement_matrix(p, p.estimator)
    x, states = np.zeros((runs, 5)), []
    for k in range(len(u)):
        x = x @ F.T + u[k, 2:] @ G.T + rng.normal(0.0, np.sqrt(p.process_variances), (runs, 5))
        states.append(x)
    S = np.array(states)
    return S, S @ H.T, S[..., [0]]


def plant_truth(runs: int, u: Matrix, rng: np.random.Generator, *, disturbed: bool) -> Truth:
    """Return runs of the plant's equations, optionally with the extended filter's process noise.

    Readings and positions have no noise.
    """
    p, stepper = ExtendedSettings(), Stepper(Hovercraft(), arrays())
    deviation = np.sqrt(variances_of(p, "process", PLANT_STATES)) * float(disturbed)
    state = np.tile(np.array(Hovercraft().start()), (runs, 1))
    states, sensors = [], []
    for k in range(len(u)):
        G = np.array([carried(psi) for psi in state[:, AT("psi")]])
        moment = stepper.step(Moment(0.0, tuple(state.T)), tuple(u[k]), p.sample_time)
        noise = np.einsum("rij,rj->ri", G, rng.normal(0.0, 1.0, state.shape) * deviation)
        state = np.stack(np.broadcast_arrays(*moment.state), axis=1) + noise
        y = stepper.output(0.0, tuple(state.T), tuple(u[k]))
        states.append(state)
        sensors.append(np.stack([y[j] for j in SENSED_AT], axis=1))
    S = np.array(states)
    return S, np.array(sensors), S[..., [AT("x"), AT("y")]]


def squares_of(case: FlightCase, runs: int, steps: int, rng: np.random.Generator) -> Squares:
    """Return normalised errors and innovations, each (runs, times), after the first second."""
    u, craft = (flown_manoeuvre if case.flight == MANOEUVRE else sines)(steps), Hovercraft()
    if case.truth == "linear":
        assumed: Settings | ExtendedSettings = Settings()
        states, *exact = linear_truth(runs, u, rng)
    else:
        assumed = ExtendedSettings()
        states, *exact = plant_truth(runs, u, rng, disturbed=case.truth == "disturbed")
    readings, positions = (
        values + rng.normal(0.0, np.sqrt(variances_of(assumed, "measurement", names)), values.shape)
        for values, names in zip(exact, (SENSED, ("x", "y")[: exact[1].shape[-1]]), strict=True)
    )
    stepper = Stepper(craft)
    nees, nis, fixed = (np.zeros((runs, steps)) for _ in range(3))
    for r in range(runs):
        estimator: LinearFilter | ExtendedFilter
        if case.estimator in ESTIMATORS:
            estimator = LinearFilter(Settings(estimator=case.estimator), (0.0,) * 5)
        else:
            estimator = ExtendedFilter(craft, ExtendedSettings(), _jacobians(), {})
        for k in range(steps):
            fix = float((k + 1) // FIX_EVERY) if case.fixes else 0.0
            estimator.step(readings[k, r], u[k], fix, positions[k, r])
            kf, state = estimator.filter, states[k, r]
            e, P = kf.x - state[: len(kf.x)], kf.P
            if isinstance(estimator, ExtendedFilter):
                e, P = e[OWN_AXIS_STATES], P[np.ix_(OWN_AXIS_STATES, OWN_AXIS_STATES)]
            elif len(state) > len(kf.x):  # the plant's thrust acceleration (F_Rx + F_Lx)/m is a_x without friction
                ax = float(stepper.output(0.0, tuple(state.tolist()), ())[SENSED_AT[2]])
                a = ax + craft.friction / craft.mass * float(state[AT("vx")])
                e = kf.x - np.array([*(state[AT(name)] for name in ESTIMATED_STATES), a])
            nees[r, k] = e @ np.linalg.solve(P, e)
            nis[r, k], fixed[r, k] = estimator.nis, estimator.fix_nis
    settled, with_fix = slice(SETTLING_SAMPLES, None), slice(SETTLING_SAMPLES + FIX_EVERY - 1, None, FIX_EVERY)
    t = Settings().sample_time * np.arange(1.0, steps + 1.0)
    squares = {"NEES": (nees[:, settled], len(e), t[settled]), "NIS": (nis[:, settled], 3, t[settled])}
    if case.fixes:  # every fifth sample has a new fix
        squares["NIS of fixes"] = (fixed[:, with_fix], positions.shape[-1], t[with_fix])
    return squares


@cache
def _jacobians() -> Mapping[str, Any]:
    from cosim.model.symbolic.linearize import load_names, printed_jacobians

    return load_names(printed_jacobians(Hovercraft(), ("ax",)))


# -- page -----------------------------------------------------------------------------------------


def page(rows: Sequence[ConsistencyRow], steps: int, seed: int) -> str:
    """Return the self-contained HTML page of a consistency test."""
    charts, runs, plots = Charts(), rows[0].result.runs, dict[tuple[str, str], list[Plot]]()
    for row in rows:
        r = row.result
        traces = (Trace(f"mean of {counted(r.runs, 'run')}", r.at_times, "true"),)
        low, high = (np.full(row.at.size, edge) for edge in r.at_time)
        band = Band("95 % range of a consistent estimator", low, high)
        panel = Panel(row.of, "1", traces, band, (float(r.degrees),), "expected mean")
        plots.setdefault((row.case, row.flight), []).extend(charts.over(row.at).plots([panel]))
    is_good = all(row.result.verdict == CONSISTENT for row in rows)
    values = {
        "badges": [f"{counted(runs, 'run')} of {counted(steps, 'sample')} each", f"seed {seed}"],
        "headline": headline(rows),
        "tone": "good" if is_good else "bad",
        "flights": list({row.flight: row.motion for row in rows}.items()),
        "rows": [{**row.as_text(), "good": row.result.verdict == CONSISTENT} for row in rows],
        "cases": [(f"{case}; {flight}", drawn) for (case, flight), drawn in plots.items()],
        "repeat": f"cosim consistency --runs {runs} --steps {steps} --seed {seed}",
    }
    return render(TEMPLATE, values, charts)
