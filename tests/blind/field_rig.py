"""What the truths of the field half have in common: how effects are sized, how a run is integrated.

Nothing of the project is in it. A rig writes its equations once, for floats and for arrays: floats run under scipy's
DOP853, arrays carry many slightly different rigs at once, which is how `field_cost` finds what an effect is worth.
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
    """Functions of single numbers."""

    sin, cos, tanh, exp, sqrt = math.sin, math.cos, math.tanh, math.exp, math.sqrt
    maximum, minimum, absolute = max, min, abs

    @staticmethod
    def where(condition: bool, then: float, otherwise: float) -> float:
        return then if condition else otherwise


class Arrays:
    """The same of arrays."""

    sin, cos, tanh, exp, sqrt = np.sin, np.cos, np.tanh, np.exp, np.sqrt
    maximum, minimum, absolute, where = np.maximum, np.minimum, np.abs, np.where


@dataclass(frozen=True)
class Entry:
    """How the size of an effect is drawn.

    scaled: parameters that grow with the size, from `neutral`; two of them share it like the sides of a circle
    start:  the size that the search for the wanted evidence begins with; `limits` are what is plausible of a rig
    shape:  further parameters with their ranges; `ratio`: further parameters as multiples of the size
    signed: either sign makes sense
    inverse: the parameter is 1/size
    fixed:  the size is drawn within the limits and not by the evidence
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
        """What a size of 1 means, by parameter; a shape keeps its value whatever the size."""
        if len(self.scaled) == 2:
            turn = float(rng.uniform(0.0, 2.0 * math.pi))
            sides = dict(zip(self.scaled, (math.cos(turn), math.sin(turn)), strict=True))
        else:
            sides = {self.scaled[0]: float(rng.choice([-1.0, 1.0])) if self.signed else 1.0}
        drawn = {p: float(rng.uniform(*between)) for p, between in {**self.ratio, **self.shape}.items()}
        return sides | drawn

    def at(self, unit: Mapping[str, float], size: float) -> dict[str, float]:
        """Parameter values of the effect at a size."""
        if self.inverse:
            return {p: v / size for p, v in unit.items()}
        return {p: v if p in self.shape else self.neutral + size * v for p, v in unit.items()}

    def left_out(self, values: Mapping[str, float]) -> dict[str, float]:
        """The same with the effect gone."""
        nothing = 1e9 if self.inverse else self.neutral
        return {p: v if p in self.shape else nothing for p, v in values.items()}


@dataclass(frozen=True)
class Sensor:
    """An error of a sensor: of which output, and whether it is a `scale`, a `bias` or a latency (`late`)."""

    output: str
    kind: str


@dataclass(frozen=True)
class Run:
    """One log's course: row times, commands from each row on, pushes held from row to row, the state it starts in."""

    times: np.ndarray
    commands: np.ndarray
    pushes: np.ndarray
    start: np.ndarray


@dataclass(frozen=True)
class Course:
    """What came of it, a row each: readings without noise, what they would be of right sensors, states."""

    readings: np.ndarray
    states: np.ndarray


class Rig:
    """A plant of the field half: numbers, equations, what may be hidden in it and how it is driven.

    sheet:  base number → (nominal, tolerance); `constants` are known exactly
    outputs: readings that `bind` gives, in order, with the stated standard deviation of the noise
    pushes: range of the actuator at each place where a disturbance enters, in the unit of the push
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
        """Equations and outputs of the rig with these numbers; effects that are not in `p` are not there."""
        raise NotImplementedError

    def drive(self, rng: np.random.Generator) -> np.ndarray:
        """Commands of a log, a row each."""
        raise NotImplementedError

    def begin(self, rng: np.random.Generator) -> np.ndarray:
        """State before a log: half of them at rest."""
        raise NotImplementedError

    # -- the same for every rig ---------------------------------------------------------------------

    def numbers(self, base: Mapping[str, float], truth: Mapping[str, Mapping[str, float]]) -> dict[str, float]:
        """Everything `bind` takes, flat."""
        nominal = {name: value for name, (value, _) in self.sheet.items()}
        effects = {f"{name}.{p}": v for name, values in truth.items() for p, v in values.items()}
        return {**self.constants, **nominal, **base, **effects}

    def effect_states(self, names: Collection[str]) -> dict[str, float]:
        """States that effects add, with their start values, in the order of `own_states`."""
        return {s: v for name, own in self.own_states.items() if name in names for s, v in own.items()}

    def scales(self, names: Collection[str]) -> np.ndarray:
        """How large each state usually is, those of effects included."""
        base = list(self.states.values())
        return np.array([*base, *(max(abs(v), 1e-2) for v in self.effect_states(names).values())])

    def sensed(self, p: Flat, output: str, value: Any) -> Any:
        """A reading with the errors of its sensor but a latency; a scale comes before a bias."""
        for kind in ("scale", "bias"):
            for name, sensor in self.sensors.items():
                if sensor.output == output and sensor.kind == kind and f"{name}.value" in p:
                    error = p[f"{name}.value"]
                    value = value * error if kind == "scale" else value + error
        return value

    def late(self) -> tuple[str, str]:
        """The error that is a latency, and its output; nothing where no sensor is late."""
        return next(((name, s.output) for name, s in self.sensors.items() if s.kind == "late"), ("", ""))

    def acting(self, p: Flat, run: Run, parts: int) -> np.ndarray:
        """Mean command over each of `parts` equal parts of every row, delay included: (rows, parts, inputs)."""
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
    """Integrate a run; the integrator restarts wherever the acting command or the push changes.

    `resets`: row → state to go on from. Late readings look back on what was there, reset or not.
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
    state = np.concatenate([run.start, list(rig.effect_states(names).values())])
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
    """What people do to a rig, one after another: full steps, levels, ramps, multisines, filtered noise.

    `between`: least and largest command; `times` [s]: the shortest and the longest that anything is held.
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
    """Lengths in rows that fill `count`, log-uniform within `times`."""
    lengths = []
    while sum(lengths) < count:
        lengths.append(max(1, round(math.exp(rng.uniform(*np.log(times))) / step)))
    return lengths


def _switch(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Full range, on and off, now and then nothing."""
    lengths = _holds(rng, count, step, times)
    sides = np.where(np.arange(len(lengths)) % 2, 1.0, -1.0) * rng.choice([0.0, 1.0, 1.0, 1.0], len(lengths))
    return np.repeat(sides, lengths)[:count]


def _levels(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Steps to anywhere."""
    lengths = _holds(rng, count, step, times)
    return np.repeat(rng.uniform(-1.0, 1.0, len(lengths)), lengths)[:count]


def _ramps(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Straight lines from one level to the next."""
    lengths = _holds(rng, count, step, times)
    corners = np.concatenate([[0], np.cumsum(lengths)])
    return np.interp(np.arange(count), corners, rng.uniform(-1.0, 1.0, corners.size))


def _multisine(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Eight sines, from one a longest hold to one in two shortest, as large as fits."""
    frequency = np.exp(rng.uniform(math.log(0.5 / times[1]), math.log(0.5 / times[0]), 8))
    phase = rng.uniform(0.0, 2.0 * math.pi, 8)
    values = np.sin(2.0 * math.pi * np.outer(np.arange(count) * step, frequency) + phase).sum(axis=1)
    return values / np.max(np.abs(values))


def _noise(rng: np.random.Generator, count: int, step: float, times: tuple[float, float]) -> np.ndarray:
    """Noise through a lag."""
    keep = math.exp(-step / math.sqrt(times[0] * times[1]))
    white = math.sqrt(1.0 - keep * keep) * rng.standard_normal(count)
    values, last = np.empty(count), 0.0
    for k, w in enumerate(white):
        values[k] = last = keep * last + w
    return 0.6 * values


_STYLES = {"switch": _switch, "levels": _levels, "ramps": _ramps, "multisine": _multisine, "noise": _noise}


def rounded(values: np.ndarray) -> np.ndarray:
    """Six digits: what is logged is what is sent."""
    return np.vectorize(lambda v: float(f"{v:.6g}"))(values)


def coloured(
    rng: np.random.Generator, count: int, sizes: Sequence[float], step: float, correlation_time: float
) -> np.ndarray:
    """First-order Gauss-Markov samples, started in the steady state; a column of each size."""
    keep = math.exp(-step / correlation_time)
    white = rng.standard_normal((count, len(sizes)))
    values = np.empty_like(white)
    values[0] = white[0]
    for k in range(1, count):
        values[k] = keep * values[k - 1] + math.sqrt(1.0 - keep * keep) * white[k]
    return values * np.array(sizes)
