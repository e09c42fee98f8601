"""Common parts of all rigs: sizes of effects, random streams, inputs, disturbance, start, integration of a run, files.

Nothing of the project is used. A rig states its equations once, for floats and for arrays: floats are integrated by
scipy's DOP853, arrays hold many slightly different rigs at once for `field_cost`.
"""

# ruff: noqa: RUF012 - what a rig declares are attributes of its class
import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import ode

Array = Any  # of floats, which NumPy's own types do not remain beside Any
Random = np.random.Generator
LOGS = ("e1", "e2", "v1")
BLOCK = ("known",) * 11 + ("nothing",) * 5 + ("outside",) * 4  # of twenty consecutive seeds, in shuffled order
STUDY_LOGS = "logs:\n  estimation: [e1.csv, e2.csv]\n  validation: [v1.csv]\n"
Flat = Mapping[str, Any]  # base numbers by name, effects as `effect.parameter`: floats, or one array entry a column
Truth = dict[str, dict[str, float]]
Rate = Callable[[Any, Any, Any, Any], list[Any]]  # (t, state, command, push) → slopes
Look = Callable[[Any, Any, Any], list[Any]]  # (t, state, push) → readings of right sensors


class Floats:
    """Math functions for equations on floats."""

    sin, cos, tanh, exp, sqrt = math.sin, math.cos, math.tanh, math.exp, math.sqrt
    maximum, minimum, absolute = max, min, abs

    @staticmethod
    def where(condition: bool, then: float, otherwise: float) -> float:
        return then if condition else otherwise


class Arrays:
    """Math functions for equations on NumPy arrays."""

    sin, cos, tanh, exp, sqrt = np.sin, np.cos, np.tanh, np.exp, np.sqrt
    maximum, minimum, absolute, where = np.maximum, np.minimum, np.abs, np.where


def grouped(p: Flat) -> dict[str, dict[str, Any]]:
    """Return effect → its parameters."""
    effects: dict[str, dict[str, Any]] = {}
    for key, value in p.items():
        name, _, parameter = key.partition(".")
        effects.setdefault(name, {})[parameter] = value
    return effects


def laws_in(p: Flat, laws: Mapping[str, Callable[..., Any]]) -> list[Callable[..., Any]]:
    """Return the laws of the effects in `p`, for their parameters."""
    effects = grouped(p)
    return [partial(law, **effects[name]) for name, law in laws.items() if name in effects]


def hidden_in(p: Flat) -> Callable[..., Any]:
    """Return (name, term) → the term of an effect for its parameters in `p`, else 0."""
    effects = grouped(p)
    return lambda name, term: term(**effects[name]) if name in effects else 0.0


def pulses(f: Any, t: Any) -> Callable[..., Any]:
    """Return a term that has the size of its effect for a length of each period, and is 0 between."""
    return lambda period, length, **size: f.where(t % period < length, *size.values(), 0.0)


@dataclass(frozen=True)
class Entry:
    """Rules for drawing the size of an effect.

    names:   parameters proportional to the size, from `neutral`; of two, components at a random angle
    start:   first size in the search for the wanted cost; `low` … `high`: plausible sizes
    shape:   further parameters with their ranges; `ratio`: further parameters as multiples of the size
    signed:  both signs are plausible
    inverse: the parameter is 1/size
    fixed:   the size is uniform within the plausible ones, regardless of its cost
    output:  output of a sensor error; `error` is its kind: `scale`, `bias`, `late` (latency), of FMUs also others
    """

    names: str
    start: float
    low: float
    high: float
    signed: bool = False
    neutral: float = 0.0
    shape: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ratio: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    inverse: bool = False
    fixed: bool = False
    output: str = ""
    error: str = ""

    def unit(self, rng: Random) -> dict[str, float]:
        """Return the parameters at size 1; parameters of `shape` do not depend on the size."""
        scaled = self.names.split()
        if len(scaled) == 2:
            turn = float(rng.uniform(0.0, 2.0 * math.pi))
            sides = dict(zip(scaled, (math.cos(turn), math.sin(turn)), strict=True))
        else:
            sides = {scaled[0]: float(rng.choice([-1.0, 1.0])) if self.signed else 1.0}
        return sides | {p: float(rng.uniform(*between)) for p, between in {**self.ratio, **self.shape}.items()}

    def at(self, unit: Mapping[str, float], size: float) -> dict[str, float]:
        """Return the parameters of the effect at a size."""
        scaled = {p: v / size if self.inverse else self.neutral + size * v for p, v in unit.items()}
        return scaled | {p: unit[p] for p in self.shape}

    def left_out(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters with the effect at neutral."""
        nothing = 1e9 if self.inverse else self.neutral
        return {p: v if p in self.shape else nothing for p, v in values.items()}


def sensor(output: str, error: str, start: float, low: float, high: float) -> Entry:
    """Return an error of a sensor, of any sign, or a latency: `scale`, `bias` or `late`."""
    late, neutral = error == "late", 1.0 if error == "scale" else 0.0
    return Entry("value", start, low, high, signed=not late, neutral=neutral, fixed=late, output=output, error=error)


@dataclass(frozen=True)
class Run:
    """Inputs of a log: row times, commands and pushes held from row to row, start state."""

    times: Array
    commands: Array
    pushes: Array
    start: Array


@dataclass(frozen=True)
class Course:
    """Simulated log: readings without noise, readings of correct sensors, and states, a row per sample."""

    readings: Array
    states: Array


class Rig:
    """A plant of the field half: parameters, equations, possible hidden effects, commands.

    sheet:   base parameter → (nominal, tolerance); `constants` are known exactly
    outputs: readings returned by `bind`, in order, with the stated standard deviation of the noise
    pushes:  range of the actuator at each place where a disturbance enters, in the unit of the push
    """

    name: str
    model: str  # class of the model file
    states: dict[str, float]  # name → scale
    inputs: dict[str, float]  # name → value before anything is commanded
    outputs: dict[str, float]
    sheet: dict[str, tuple[float, float]]
    constants: dict[str, float] = {}
    entries: dict[str, Entry]
    outside: dict[str, Entry]
    families: tuple[frozenset[str], ...] = ()
    own_states: dict[str, dict[str, float]] = {}  # effect → its states and their start values
    pushes: tuple[float, ...]
    correlation_time: float  # [s], of the disturbance
    step: float
    rows: int
    horizon: float  # [s]
    preroll: float  # [s] of rest command before the first row
    substeps: int = 1  # of a row, for the estimate of the cost
    shaping: tuple[str, ...] = ("command_delay.time",)  # numbers that decide the acting commands
    # smallest, largest command, and shortest, longest hold [s] of each input; rows at rest at the beginning
    manoeuvres: tuple[tuple[float, float, tuple[float, float]], ...] = ()
    rest_rows: int = 0
    rest: Sequence[float] = ()  # state at rest, by default 0
    moves: tuple[
        float, ...
    ] = ()  # largest distance of each state from rest at the start of a log that begins in motion

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return derivatives and outputs as functions, for parameters `p`; effects missing in `p` are absent.

        Args:
            f: `Floats` or `Arrays`, the math functions.
        """
        raise NotImplementedError

    def drive(self, rng: Random) -> Array:
        """Return the commands of a log, shape (rows, inputs)."""
        return rounded(self.exact_drive(rng))

    def exact_drive(self, rng: Random) -> Array:
        """Return the commands of a log in all digits: of each input steps, levels, ramps, multisines, noise."""
        columns = [manoeuvre(rng, self.rows, self.step, (low, high), holds) for low, high, holds in self.manoeuvres]
        commands = np.column_stack(columns)
        commands[: self.rest_rows] = list(self.inputs.values())
        return commands

    def begin(self, rng: Random) -> Array:
        """Return the start state of a log, with probability ½ at rest."""
        still = np.array(self.rest) if len(self.rest) else np.zeros(len(self.moves))
        return still + rng.choice([0.0, 1.0]) * rng.uniform(-1.0, 1.0, len(self.moves)) * self.moves

    def course(
        self, p: Mapping[str, float], run: Run, resets: Mapping[int, Array] | None = None, tolerance: float = 1e-8
    ) -> Course:
        """Integrate a run, restarting the integrator where the acting command or the push changes.

        `resets`: row → new state. Late readings refer to the past also across a reset.
        """
        rate, look = self.bind(Floats, p)
        sensor, late_output = self.late()
        delay, latency = p.get("command_delay.time", 0.0), p.get(f"{sensor}.value", 0.0)
        arrive, seen, rows = (np.round(run.times + shift, 9) for shift in (delay, -latency, 0.0))
        begin = round(float(run.times[0]) - self.preroll, 9)
        cuts = np.unique(np.concatenate([[begin], rows, arrive[arrive < rows[-1]], seen]))
        middle = 0.5 * (cuts[1:] + cuts[:-1])
        before = tuple(self.inputs.values())
        commands = [before if k < 0 else tuple(run.commands[k].tolist()) for k in np.searchsorted(arrive, middle) - 1]
        pushed = np.maximum(np.searchsorted(rows, np.append(middle, rows[-1] + 1e-9)) - 1, 0)
        pushes = [tuple(run.pushes[k].tolist()) for k in pushed]
        row_of = {int(c): k for k, c in enumerate(np.searchsorted(cuts, rows))}
        acting: list[Any] = [before, pushes[0]]
        integrator = solver(lambda t, x: rate(t, x.tolist(), *acting), tolerance, self.step)
        state = self.first_state({name.partition(".")[0] for name in p}, run)
        outputs, states = np.empty((cuts.size, len(self.outputs))), np.empty((rows.size, state.size))
        for k, (at, push) in enumerate(zip(cuts.tolist(), pushes, strict=True)):
            row = row_of.get(k)
            if row is not None:
                state = (resets or {}).get(row, state)
                states[row] = state
            outputs[k] = look(at, state.tolist(), push)
            if k + 1 < cuts.size:
                acting[:] = commands[k], push
                state = advanced(integrator, state, at, float(cuts[k + 1]))
        readings = outputs[np.searchsorted(cuts, rows)]
        if late_output:
            late = list(self.outputs).index(late_output)
            readings[:, late] = outputs[np.searchsorted(cuts, seen), late]
        return Course(self.all_sensed(p, readings), states)

    def first_state(self, names: Collection[str], run: Run) -> Array:
        """Return the start state of a run, with the states of the effects `names`."""
        return np.concatenate([run.start, self.effect_states(names)])

    # -- the same for every rig ---------------------------------------------------------------------

    @property
    def every_entry(self) -> dict[str, Entry]:
        """Return the effects of the catalogue and outside of it."""
        return {**self.entries, **self.outside}

    @cached_property
    def sensors(self) -> dict[str, Entry]:
        """Return the errors of sensors in the catalogue."""
        return {name: entry for name, entry in self.entries.items() if entry.output}

    def numbers(self, base: Mapping[str, float], truth: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        """Return all parameters for `bind` by full name."""
        nominal = {name: value for name, (value, _) in self.sheet.items()}
        return {**self.constants, **nominal, **base, **flat(truth)}

    def effect_states(self, names: Collection[str]) -> list[float]:
        """Return the start values of the states added by effects, in the order of `own_states`."""
        return [value for name, own in self.own_states.items() if name in names for value in own.values()]

    def scales(self, names: Collection[str]) -> Array:
        """Return the usual size of each state, including the states of effects."""
        return np.array([*self.states.values(), *(max(abs(v), 1e-2) for v in self.effect_states(names))])

    def sensed(self, p: Flat, output: str, value: Any) -> Any:
        """Return a reading with the errors of its sensor except latency: first scale, then bias."""
        for kind in ("scale", "bias"):
            for name, entry in self.sensors.items():
                if (entry.output, entry.error) == (output, kind) and f"{name}.value" in p:
                    error = p[f"{name}.value"]
                    value = value * error if kind == "scale" else value + error
        return value

    def all_sensed(self, p: Flat, readings: Array) -> Array:
        """Return columns of readings with the errors of their sensors."""
        return np.column_stack([self.sensed(p, o, column) for o, column in zip(self.outputs, readings.T, strict=True)])

    def late(self) -> tuple[str, str]:
        """Return the name of the latency and its output, or two empty texts for a rig without a late sensor."""
        return next(((name, s.output) for name, s in self.sensors.items() if s.error == "late"), ("", ""))

    def acting(self, p: Flat, run: Run, parts: int) -> Array:
        """Return the mean acting (delayed) command of each of `parts` parts of a row, shape (rows, parts, inputs)."""
        delay = float(p.get("command_delay.time", 0.0))
        step = np.append(np.diff(run.times), self.step)
        edges = run.times[:, None] + step[:, None] * np.arange(parts + 1) / parts
        known = np.concatenate([[run.times[0] - 1e3], run.times, [run.times[-1] + 1e3]])
        held = np.vstack([np.array(list(self.inputs.values())), run.commands])
        total = np.vstack([np.zeros(held.shape[1]), np.cumsum(held * np.diff(known)[:, None], axis=0)])
        at = np.stack([np.interp(edges - delay, known, column) for column in total.T], axis=-1)
        return np.diff(at, axis=1) / np.diff(edges, axis=1)[:, :, None]


def flat(truth: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
    """Return the parameters of effects by full name."""
    return {f"{name}.{p}": v for name, values in truth.items() for p, v in values.items()}


def solver(rate: Callable[..., Any], tolerance: float, step: float) -> Any:
    """Return scipy's DOP853."""
    settings = {"rtol": tolerance, "atol": 1e-2 * tolerance, "first_step": 0.5 * step, "nsteps": 10_000}
    return ode(rate).set_integrator("dop853", **settings)


def advanced(integrator: Any, state: Array, begin: float, end: float) -> Array:
    """Return the state at `end`; ArithmeticError if the integration fails."""
    integrator.set_initial_value(state, begin)
    state = integrator.integrate(end)
    if not integrator.successful():
        raise ArithmeticError(f"integration failed at {begin:.3f} s")
    return state


def runge_kutta(rate: Callable[[Any, Array], Array], t: Any, x: Array, h: Any) -> Array:
    """Return the state after a step of order 4."""
    k1 = rate(t, x)
    k2 = rate(t + 0.5 * h, x + 0.5 * h * k1)
    k3 = rate(t + 0.5 * h, x + 0.5 * h * k2)
    return x + h / 6.0 * (k1 + 2.0 * (k2 + k3) + rate(t + h, x + h * k3))


# -- what is drawn ---------------------------------------------------------------------------------------


def random_stream(suite: int, seed: int, *purpose: int) -> Random:
    """Return an independent random stream of a suite for a purpose of a seed."""
    return np.random.default_rng([suite, seed, *purpose])


def dealt(suite: int, deck: Sequence[Any], number: int, *purpose: int) -> tuple[Any, int]:
    """Return card `number` of an endless pile of equal decks, each shuffled, and how many equal cards are above it."""
    pile, place = divmod(number, len(deck))
    order = [deck[k] for k in random_stream(suite, pile, *purpose).permutation(len(deck))]
    card = order[place]
    return card, pile * deck.count(card) + order[:place].count(card)


def base_numbers(sheet: Mapping[str, tuple[float, float]], rng: Random) -> dict[str, float]:
    """Return base parameters: nominal·(1 + N(0, tolerance/2)), truncated at the tolerance."""
    drawn = {}
    for name, (value, tolerance) in sheet.items():
        away = math.inf
        while abs(away) > tolerance:
            away = float(rng.normal(0.0, 0.5 * tolerance))
        drawn[name] = value * (1.0 + away)
    return drawn


def log_uniform(rng: Random, between: tuple[float, float]) -> float:
    """Return a random number, log-uniform."""
    return math.exp(rng.uniform(*np.log(between)))


def coloured(rng: Random, count: int, sizes: Sequence[float], step: float, correlation_time: float) -> Array:
    """Return stationary first-order Gauss-Markov samples, with a column per standard deviation in `sizes`."""
    keep = math.exp(-step / correlation_time)
    values = rng.standard_normal((count, len(sizes)))
    for last, row in pairwise(values):
        row[:] = keep * last + math.sqrt(1.0 - keep * keep) * row
    return values * np.array(sizes)


def manoeuvre(rng: Random, count: int, step: float, between: tuple[float, float], times: tuple[float, float]) -> Array:
    """Return commands of different styles in sequence: full steps, levels, ramps, multisines, filtered noise.

    `between`: smallest and largest command; `times`: shortest and longest hold [s].
    """
    low, high = between
    values = np.empty(count)
    k = 0
    styles = rng.permutation(np.array(["switch", "levels", "ramps", "multisine", "noise", "switch", "levels"]))
    for style in np.resize(styles, 50):
        length = min(count - k, int(count * rng.uniform(0.12, 0.3)))
        values[k : k + length] = _styled(str(style), rng, length, step, times)
        k += length
        if k == count:
            break
    return low + (high - low) * 0.5 * (1.0 + np.clip(values, -1.0, 1.0))


def _styled(style: str, rng: Random, count: int, step: float, times: tuple[float, float]) -> Array:
    """Return a signal between −1 and 1 in a style; holds are log-uniform within `times`."""
    if style == "multisine":  # half periods between the shortest and the longest hold
        frequency = np.exp(rng.uniform(math.log(0.5 / times[1]), math.log(0.5 / times[0]), 8))
        phase = rng.uniform(0.0, 2.0 * math.pi, 8)
        values = np.sin(2.0 * math.pi * np.outer(np.arange(count) * step, frequency) + phase).sum(axis=1)
        return values / np.max(np.abs(values))
    if style == "noise":  # white noise after a lag
        keep = math.exp(-step / math.sqrt(times[0] * times[1]))
        values = math.sqrt(1.0 - keep * keep) * rng.standard_normal(count)
        for k in range(1, count):
            values[k] += keep * values[k - 1]
        return 0.6 * values
    lengths: list[int] = []
    while sum(lengths) < count:
        lengths.append(max(1, round(log_uniform(rng, times) / step)))
    if style == "ramps":
        corners = np.concatenate([[0], np.cumsum(lengths)])
        return np.interp(np.arange(count), corners, rng.uniform(-1.0, 1.0, corners.size))
    if style == "levels":
        levels = rng.uniform(-1.0, 1.0, len(lengths))
    else:
        levels = np.where(np.arange(len(lengths)) % 2, 1.0, -1.0) * rng.choice([0.0, 1.0, 1.0, 1.0], len(lengths))
    return np.repeat(levels, lengths)[:count]


def kept_level(pumps: Array, levels: Array, high: float, pull: float, step: float) -> Array:
    """Return voltages of two pumps, corrected on paper so that nominal tanks run neither over nor dry."""
    for volts in pumps:
        volts += pull * (np.minimum(high - levels, 0.0) + np.maximum(0.12 - levels, 0.0))
        np.clip(volts, 0.0, 10.0, out=volts)
        fall = levels[0] - levels[1]
        across, out = 1.2e-4 * fall * (fall * fall + 1e-4) ** -0.25, 1.2e-4 * math.sqrt(max(levels[1], 1e-3))
        levels = levels + step / 0.02 * (6e-6 * volts + np.array([-across, across - out]))
    return pumps


def rounded(values: Array) -> Array:
    """Return values with six digits, so that logged and sent commands are equal."""
    return np.vectorize(lambda v: float(f"{v:.6g}"))(values)


# -- files -----------------------------------------------------------------------------------------------


def write_study(folder: Path, model: str, logs: Sequence[str], tolerance: Mapping[str, float] | None = None) -> Path:
    """Write study.yaml and the logs (their text); return the path of study.yaml."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in zip(LOGS, logs, strict=True):
        (folder / f"{name}.csv").write_text(text)
    shares = ", ".join(f"{name}: {share:g}" for name, share in (tolerance or {}).items())
    path = folder / "study.yaml"
    path.write_text(f"model: {model}\n{STUDY_LOGS}" + (f"tolerance: {{{shares}}}\n" if shares else ""))
    return path


def csv(names: Sequence[str], *columns: tuple[str, Array]) -> str:
    """Return a log: groups of columns with their format; missing cells are empty."""
    cells = [["" if math.isnan(v) else format(v, how) for v in column] for how, x in columns for column in x.T.tolist()]
    return "\n".join(map(",".join, [names, *zip(*cells, strict=True)])) + "\n"
