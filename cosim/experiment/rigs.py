"""Experiments that a rig can play: signals on a few axes, and what the model does under them.

Any model is played open loop; one that would not stay where it is brings a rig of its own (`cosim.base.registry`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np

from cosim.base.arrays import Array
from cosim.logs.log import Log
from cosim.model.integrate import Stepper
from cosim.model.model import Model, Values

Signals = Mapping[str, Array]
Ranges = Mapping[str, tuple[float, float]]  # input → least and largest command
FASTEST = 0.1  # of the sample rate
SLOWEST = 2.0  # periods in a trial


@dataclass(frozen=True)
class Axis:
    """Something an experiment may move: up to ±amplitude, between two frequencies [Hz]."""

    name: str
    amplitude: float
    slowest: float
    fastest: float


@dataclass(frozen=True)
class Trial:
    """A trial without noise, all by name: signals of the axes, the model's inputs, references of the loop, outputs."""

    time: Array
    signals: Signals
    inputs: dict[str, Array]
    references: dict[str, Array]
    outputs: dict[str, Array]

    def log(self, model: Model, measured: tuple[str, ...]) -> Log:
        """The log it would leave."""
        units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
        outputs = {name: self.outputs[name] for name in measured}
        return Log(Path("trial.csv"), self.time, self.inputs, outputs, units, model.rate, units, {})

    def excursion(self, name: str) -> tuple[float, float]:
        """Least and largest value of an output."""
        return float(np.min(self.outputs[name])), float(np.max(self.outputs[name]))

    def beyond(self, limits: Mapping[str, float]) -> float:
        """The largest excursion from the start, in parts of what is allowed; infinite where the trial diverged."""
        if not all(np.isfinite(values).all() for values in self.outputs.values()):
            return math.inf
        seen = (np.abs(self.outputs[n] - self.outputs[n][0]).max() / v for n, v in limits.items() if n in self.outputs)
        return float(max(seen, default=0.0))


class Rig(Protocol):
    """What plays an experiment within the ranges of the inputs, and writes down how a scenario plays it.

    usual: what is played without thinking, to compare an experiment with
    files: what it writes beside excitation.csv, excitation.yaml and plant.fmu
    """

    usual: str
    files: tuple[str, ...]
    axes: tuple[Axis, ...]

    def play(self, model: Model, signals: Signals) -> Trial:
        """What a model does under the signals of the axes, without noise."""

    def usual_signals(self, time: Array) -> Signals:
        """Signals of what is usually played."""

    def write(self, folder: Path, trial: Trial) -> None:
        """Write `files`."""

    def components(self) -> Iterator[str]:
        """Lines of the scenario: components beside `plant` and `excitation`."""

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Lines of the scenario: how they are connected; variance: of the noise of each output."""


class OpenLoop:
    """Any model: each input is an axis about its start value."""

    usual = "a step of each input in turn"
    files: tuple[str, ...] = ()

    def __init__(self, model: Model, limits: Mapping[str, float], ranges: Ranges, duration: float) -> None:
        self.ranges = ranges
        fastest = FASTEST / model.rate
        slowest = min(SLOWEST / duration, fastest)
        self.axes = tuple(Axis(q.name, limits[q.name], slowest, fastest) for q in model.inputs)

    def play(self, model: Model, signals: Signals) -> Trial:
        """Inputs played to the model; what would leave a range stays at its end."""
        rest = model.start_command()
        moved = [start + signals[q.name] for q, start in zip(model.inputs, rest, strict=True)]
        u = np.column_stack(
            [within(values, q.name, self.ranges) for q, values in zip(model.inputs, moved, strict=True)]
        )
        rows = [tuple(row) for row in u.tolist()]
        return trial_of(model, len(rows), lambda k, y: rows[k], signals, {})

    def usual_signals(self, time: Array) -> Signals:
        """One input after the other at half of what it may, forth and back."""
        place = time / time[-1] * len(self.axes)
        return {
            a.name: 0.5
            * a.amplitude
            * (((place >= k) & (place < k + 0.5)) * 1.0 - ((place >= k + 0.5) & (place < k + 1)))
            for k, a in enumerate(self.axes)
        }

    def write(self, folder: Path, trial: Trial) -> None:
        """Nothing beside the inputs."""

    def components(self) -> Iterator[str]:
        """None beside the inputs."""
        yield from ()

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Every input is played."""
        yield from played_lines(q.name for q in model.inputs)


def within(values: Array, name: str, ranges: Ranges) -> Array:
    """Commands of an input, cut at the ends of its range."""
    return np.clip(values, *ranges.get(name, (-math.inf, math.inf)))


def played_lines(names: Iterable[str]) -> Iterator[str]:
    """Lines of the scenario: inputs played to the plant."""
    yield from (f"  - {{from: excitation.{name}, to: plant.{name}}}" for name in names)


def trial_of(
    model: Model, count: int, command: Callable[[int, Values], Values], signals: Signals, references: dict[str, Array]
) -> Trial:
    """Step a model; `command` gives the inputs that act from row k, from the outputs there."""
    stepper = Stepper(model)
    moment = stepper.start()
    u: Values = model.start_command()
    inputs, outputs = np.full((count, len(model.inputs)), np.nan), np.full((count, len(model.outputs)), np.nan)
    try:
        for k in range(count):
            u = command(k, stepper.output(moment.t, moment.state, u))
            inputs[k], outputs[k] = u, stepper.output(moment.t, moment.state, u)
            moment = stepper.step(moment, u, model.rate)
    except (ArithmeticError, ValueError):  # math.sin of infinity: the rows from here on stay NaN
        pass
    return Trial(
        model.rate * np.arange(count, dtype=np.float64),
        signals,
        {q.name: inputs[:, j] for j, q in enumerate(model.inputs)},
        references,
        {q.name: outputs[:, j] for j, q in enumerate(model.outputs)},
    )
