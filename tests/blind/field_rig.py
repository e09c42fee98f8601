"""Common parts of the plants in the field half: sizes of effects, integration of a run.

Nothing of the project is used. A rig states its equations once, for floats and for arrays: floats are integrated by
scipy's DOP853, arrays hold many slightly different rigs at once for `field_cost`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np
from scipy.integrate import ode

Flat = Mapping[str, Any]  # base numbers by name, effects as `effect.parameter`: floats, or one array entry a column
Truth = dict[str, dict[str, float]]
Rate = Callable[[float, Sequence[Any], Sequence[Any], Sequence[Any]], list[Any]]  # (t, state, command, push) → slopes
Look = Callable[[float, Sequence[Any], Sequence[Any]], list[Any]]  # (t, state, push) → readings of right sensors


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


@dataclass(frozen=True)
class Entry:
    """Rules for drawing the size of an effect.

    scaled:  parameters proportional to the size, from `neutral`; two parameters are its components at a random angle
    start:   first size in the search for the wanted cost; `limits`: plausible sizes
    shape:   further parameters with their ranges; `ratio`: further parameters as multiples of the size
    signed:  both signs are plausible
    inverse: the parameter is 1/size
    fixed:   the size is uniform within `limits`, regardless of its cost
    """

    scaled: tuple[str, ...]
    start: float
    limits: tuple[float, float]
    signed: bool = False
    neutral: float = 0.0
    shape: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    ratio: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    inverse: bool = False
    fixed: bool = False

    def unit(self, rng: np.random.Generator) -> dict[str, float]:
        """Return the parameters at size 1; parameters of `shape` do not depend on the size."""
        if len(self.scaled) == 2:
            turn = float(rng.uniform(0.0, 2.0 * math.pi))
            sides = dict(zip(self.scaled, (math.cos(turn), math.sin(turn)), strict=True))
        else:
            sides = {self.scaled[0]: float(rng.choice([-1.0, 1.0])) if self.signed else 1.0}
        drawn = {p: float(rng.uniform(*between)) for p, between in {**self.ratio, **self.shape}.items()}
        return sides | drawn

    def at(self, unit: Mapping[str, float], size: float) -> dict[str, float]:
        """Return the parameters of the effect at a size."""
        if self.inverse:
            return {p: v if p in self.shape else v / size for p, v in unit.items()}
        return {p: v if p in self.shape else self.neutral + size * v for p, v in unit.items()}

    def left_out(self, values: Mapping[str, float]) -> dict[str, float]:
        """Return the parameters with the effect at neutral."""
        nothing = 1e9 if self.inverse else self.neutral
        return {p: v if p in self.shape else nothing for p, v in values.items()}


@dataclass(frozen=True)
class Sensor:
    """Error of a sensor: its output, and its kind `scale`, `bias` or `late` (latency)."""

    output: str
    kind: str


@dataclass(frozen=True)
class Run:
    """Inputs of a log: row times, commands and pushes held from row to row, start state."""

    times: np.ndarray
    commands: np.ndarray
    pushes: np.ndarray
    start: np.ndarray


@dataclass(frozen=True)
class Course:
    """Simulated log: readings without noise, readings of correct sensors, and states, a row per sample."""

    readings: np.ndarray
    states: np.ndarray


class Rig:
    """A plant of the field half: parameters, equations, possible hidden effects, commands.

    sheet:   base parameter → (nominal, tolerance); `constants` are known exactly
    outputs: readings returned by `bind`, in order, with the stated standard deviation of the noise
    pushes:  range of the actuator at each place where a disturbance enters, in the unit of the push
    """

    name: ClassVar[str]
    model: ClassVar[str]  # class of the model file
    states: ClassVar[dict[str, float]]  # name → scale
    inputs: ClassVar[dict[str, float]]  # name → value before anything is commanded
    outputs: ClassVar[dict[str, float]]
    sheet: ClassVar[dict[str, tuple[float, float]]]
    constants: ClassVar[dict[str, float]] = {}
    entries: ClassVar[dict[str, Entry]]
    sensors: ClassVar[dict[str, Sensor]]
    outside: ClassVar[dict[str, Entry]]
    families: ClassVar[tuple[frozenset[str], ...]] = ()
    own_states: ClassVar[dict[str, dict[str, float]]] = {}  # effect → its states and their start values
    pushes: ClassVar[tuple[float, ...]]
    correlation_time: ClassVar[float]  # [s], of the disturbance
    step: ClassVar[float]
    rows: ClassVar[int]
    horizon: ClassVar[float]  # [s]
    preroll: ClassVar[float]  # [s] of rest command before the first row
    substeps: ClassVar[int] = 1  # of a row, for the estimate of the cost
    shaping: ClassVar[tuple[str, ...]] = ("command_delay.time",)  # numbers that decide the acting commands

    def bind(self, f: Any, p: Flat) -> tuple[Rate, Look]:
        """Return derivatives and outputs as functions, for parameters `p`; effects missing in `p` are absent.

        Args:
            f: `Floats` or `Arrays`, the math functions.
        """
        raise NotImplementedError

    def drive(self, rng: np.random.Generator) -> np.ndarray:
        """Return the commands of a log, shape (rows, inputs)."""
        raise NotImplementedError

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """Return the start state of a log, with probability ½ at rest."""
        raise NotImplementedError

    def course(self, p: Mapping[str, float], run: Run, resets: Mapping[int, np.ndarray] | None = None) -> Course:
        """Return the simulated log for parameters `p`; `resets`: row → new state."""
        return fly(self, p, run, resets)

    def first_state(self, names: Collection[str], run: Run) -> np.ndarray:
        """Return the start state of a run, with the states of the effects `names`."""
        return np.concatenate([run.start, list(self.effect_states(names).values())])

    # -- the same for every rig ---------------------------------------------------------------------

    def numbers(self, base: Mapping[str, float], truth: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        """Return all parameters for `bind` by full name."""
        nominal = {name: value for name, (value, _) in self.sheet.items()}
        effects = {f"{name}.{p}": v for name, values in truth.items() for p, v in values.items()}
        return {**self.constants, **nominal, **base, **effects}

    def effect_states(self, names: Collection[str]) -> dict[str, float]:
        """Return the states added by effects, with start values, in the order of `own_states`."""
        return {s: v for name, own in self.own_states.items() if name in names for s, v in own.items()}

    def scales(self, names: Collection[str]) -> np.ndarray:
        """Return the usual size of each state, including the states of effects."""
        base = list(self.states.values())
        return np.array([*base, *(max(abs(v), 1e-2) for v in self.effect_states(names).values())])

    def sensed(self, p: Flat, output: str, value: Any) -> Any:
        """Return a reading with the errors of its sensor except latency: first scale, then bias."""
        for kind in ("scale", "bias"):
            for name, sensor in self.sensors.items():
                if sensor.output == output and sensor.kind == kind and f"{name}.value" in p:
                    error = p[f"{name}.value"]
                    value = value * error if kind == "scale" else value + error
        return value

    def late(self) -> tuple[str, str]:
        """Return the name of the latency and its output, or two empty texts for a rig without a late sensor."""
        return next(((name, s.output) for name, s in self.sensors.items() if s.kind == "late"), ("", ""))

    def acting(self, p: Flat, run: Run, parts: int) -> np.ndarray:
        """Return the mean acting (delayed) command of each of `parts` parts of a row, shape (rows, parts, inputs)."""
        delay = float(p.get("command_delay.time", 0.0))
        step = np.append(np.diff(run.times), self.step)
        edges = run.times[:, None] + step[:, None] * np.arange(parts + 1) / parts
        known = np.concatenate([[run.times[0] - 1e3], run.times, [run.times[-1] + 1e3]])
        held = np.vstack([np.array(list(self.inputs.values())), run.commands])
        total = np.vstack([np.zeros(held.shape[1]), np.cumsum(held * np.diff(known)[:, None], axis=0)])
        at = np.stack([np.interp(edges - delay, known, column) for column in total.T], axis=-1)
        return np.diff(at, axis=1) / np.diff(edges, axis=1)[:, :, None]


def fly(
    rig: Rig, p: Mapping[str, float], run: Run, resets: Mapping[int, np.ndarray] | None = None, tolerance: float = 1e-8
) -> Course:
    """Integrate a run, restarting the integrator where the acting command or the push changes.

    `resets`: row → new state. Late readings refer to the past also across a reset.
    """
    names = {name.partition(".")[0] for name in p}
    rate, look = rig.bind(Floats, p)
    sensor, late_output = rig.late()
    delay, latency = p.get("command_delay.time", 0.0), p.get(f"{sensor}.value", 0.0)
    arrive, seen, rows = (np.round(run.times + shift, 9) for shift in (delay, -latency, 0.0))
    begin = round(float(run.times[0]) - rig.preroll, 9)
    cuts = np.unique(np.concatenate([[begin], rows, arrive[arrive < rows[-1]], seen]))
    middle = 0.5 * (cuts[1:] + cuts[:-1])
    sent = np.searchsorted(arrive, middle) - 1
    before = tuple(rig.inputs.values())
    commands = [before if k < 0 else tuple(run.commands[k].tolist()) for k in sent]
    pushed = np.maximum(np.searchsorted(rows, np.append(middle, rows[-1] + 1e-9)) - 1, 0)
    pushes = [tuple(run.pushes[k].tolist()) for k in pushed]
    row_of = {int(c): k for k, c in enumerate(np.searchsorted(cuts, rows))}
    acting: list[Any] = [before, pushes[0]]
    solver = ode(lambda t, x: rate(t, x.tolist(), *acting))
    solver.set_integrator("dop853", rtol=tolerance, atol=1e-2 * tolerance, first_step=0.5 * rig.step, nsteps=10_000)
    state = rig.first_state(names, run)
    outputs = np.empty((cuts.size, len(rig.outputs)))
    states = np.empty((rows.size, state.size))
    for k, (at, push) in enumerate(zip(cuts.tolist(), pushes, strict=True)):
        row = row_of.get(k)
        if row is not None:
            if resets and row in resets:
                state = resets[row]
            states[row] = state
        outputs[k] = look(at, state.tolist(), push)
        if k + 1 < cuts.size:
            acting[:] = commands[k], push
            solver.set_initial_value(state, at)
            state = solver.integrate(float(cuts[k + 1]))
            if not solver.successful():
                raise ArithmeticError(f"integration of {rig.name} failed at {at:.3f} s")
    at_rows = outputs[np.searchsorted(cuts, rows)]
    columns = []
    for number, output in enumerate(rig.outputs):
        values = outputs[np.searchsorted(cuts, seen), number] if output == late_output else at_rows[:, number]
        columns.append(rig.sensed(p, output, values))
    return Course(np.column_stack(columns), states)


# -- how a rig is driven ---------------------------------------------------------------------------------


def manoeuvre(
    rng: np.random.Generator, count: int, step: float, between: tuple[float, float], times: tuple[float, float]
) -> np.ndarray:
    """Return commands of different styles in sequence: full steps, levels, ramps, multisines, filtered noise.

    `between`: smallest and largest command; `times`: shortest and longest hold [s].
    """
    low, high = between
    values = np.empty(count)
    k = 0
    styles = rng.permutation(np.array(["switch", "levels", "ramps", "multisine", "noise", "switch", "levels"]))
    for style in np.resize(styles, 50):
        length = min(count - k, int(count * rng.uniform(0.12, 0.3)))
        values[k : k + length] = _STYLES[str(style)](rng, length, step, times)
        k += length
        if k == count:
            break
    return low + (high - low) * 0.5 * (1.0 + np.clip(values, -1.0, 1.0))


def _holds(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> list[int]:
    """Return lengths in rows, at least `count` in total, log-uniform within `times`."""
    lengths = []
    while sum(lengths) < count:
        lengths.append(max(1, round(math.exp(rng.uniform(*np.log(times))) / step)))
    return lengths


def _switch(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Return a signal between −1 and 1 with occasional zeros."""
    lengths = _holds(rng, count, step, times)
    sides = np.where(np.arange(len(lengths)) % 2, 1.0, -1.0) * rng.choice([0.0, 1.0, 1.0, 1.0], len(lengths))
    return np.repeat(sides, lengths)[:count]


def _levels(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Return steps to random levels."""
    lengths = _holds(rng, count, step, times)
    return np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:count]


def _ramps(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Return straight lines between random levels."""
    lengths = _holds(rng, count, step, times)
    corners = np.concatenate([[0], np.cumsum(lengths)])
    return np.interp(np.arange(count), corners, rng.uniform(-1.0, 1.0, corners.size))


def _multisine(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Return the normalised sum of eight sines with half periods between the shortest and the longest hold."""
    frequency = np.exp(rng.uniform(math.log(0.5 / times[1]), math.log(0.5 / times[0]), 8))
    phase = rng.uniform(0.0, 2.0 * math.pi, 8)
    values = np.sin(2.0 * math.pi * np.outer(np.arange(count) * step, frequency) + phase).sum(axis=1)
    return values / np.max(np.abs(values))


def _noise(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Return white noise after a first-order lag."""
    keep = math.exp(-step / math.sqrt(times[0] * times[1]))
    white = math.sqrt(1.0 - keep * keep) * rng.standard_normal(count)
    values, last = np.empty(count), 0.0
    for k, w in enumerate(white):
        values[k] = last = keep * last + w
    return 0.6 * values


_STYLES = {"switch": _switch, "levels": _levels, "ramps": _ramps, "multisine": _multisine, "noise": _noise}


def rounded(values: np.ndarray) -> np.ndarray:
    """Return values with six digits, so that logged and sent commands are equal."""
    return np.vectorize(lambda v: float(f"{v:.6g}"))(values)


def coloured(
    rng: np.random.Generator, count: int, sizes: Sequence[float], step: float, correlation_time: float
) -> np.ndarray:
    """Return stationary first-order Gauss-Markov samples, with a column per standard deviation in `sizes`."""
    keep = math.exp(-step / correlation_time)
    white = rng.standard_normal((count, len(sizes)))
    values = np.empty_like(white)
    values[0] = white[0]
    for k in range(1, count):
        values[k] = keep * values[k - 1] + math.sqrt(1.0 - keep * keep) * white[k]
    return values * np.array(sizes)
