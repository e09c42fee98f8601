"""Rigs that play experiments: signals on a few axes, and the model's response.

Any model can be played in open loop; an unstable one registers its own rig (`cosim.core.registry`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.core.arrays import Array
from cosim.logs.log import Log
from cosim.model.integrate import Stepper
from cosim.model.model import Model, Values

Signals = Mapping[str, Array]
Ranges = Mapping[str, tuple[float, float]]  # input → least and largest command
FASTEST = 0.1  # share of the sample rate
SLOWEST = 2.0  # periods in a trial


@dataclass(frozen=True)
class RigAxis:
    """An independent signal of an experiment: up to ±amplitude, between two frequencies [Hz]."""

    name: str
    amplitude: float
    slowest: float
    fastest: float


@dataclass(frozen=True)
class Trial:
    """A noise-free simulation of an experiment.

    Each field maps names to values over time: chosen signals, model inputs, references of the loop, and outputs.
    """

    time: Array
    signals: Signals
    inputs: dict[str, Array]
    references: dict[str, Array]
    outputs: dict[str, Array]

    def log(self, model: Model, measured: tuple[str, ...]) -> Log:
        """Return the trial as a log."""
        units = {q.name: q.unit for q in (*model.inputs, *model.outputs)}
        outputs = {name: self.outputs[name] for name in measured}
        return Log(Path("trial.csv"), self.time, self.inputs, outputs, units, model.rate, units, {})

    def excess(self, limits: Mapping[str, float]) -> float:
        """Return the largest excursion relative to its limit, infinite after divergence."""
        if not all(np.isfinite(values).all() for values in self.outputs.values()):
            return math.inf
        limited = {n: limit for n, limit in limits.items() if n in self.outputs}
        shares = (np.abs(self.outputs[n] - self.outputs[n][0]).max() / limit for n, limit in limited.items())
        return float(max(shares, default=0.0))


class OpenLoop:
    """Open-loop rig for any model: each input gets a signal around its start value. Other rigs derive from it.

    A rig plays an experiment within input ranges and writes its scenario.

    Attributes:
        axes: Signals that an experiment varies.
        usual: Description of the usual input, for comparison.
        files: Files beside excitation.csv, excitation.yaml and plant.fmu.
    """

    usual = "a step of each input in turn"
    files: tuple[str, ...] = ()

    def __init__(self, model: Model, limits: Mapping[str, float], ranges: Ranges, duration: float) -> None:
        self.ranges = ranges
        fastest = FASTEST / model.rate
        slowest = min(SLOWEST / duration, fastest)
        self.axes = tuple(RigAxis(q.name, limits[q.name], slowest, fastest) for q in model.inputs)

    def play(self, model: Model, signals: Signals) -> Trial:
        """Return a model's response to axis signals, clipped to the ranges of the inputs."""
        starts = {q.name: start for q, start in zip(model.inputs, model.start_command(), strict=True)}
        commands = [clip(start + signals[name], name, self.ranges).tolist() for name, start in starts.items()]
        rows = [*zip(*commands, strict=True)]
        return trial_of(model, len(rows), lambda k, y: rows[k], signals, {})

    def usual_signals(self, time: Array) -> Signals:
        """Return the signals of the usual input: a half-amplitude pulse of each input in turn, in both directions."""
        place = time / time[-1] * len(self.axes)
        waves = ((place >= k) * 1.0 - 2.0 * (place >= k + 0.5) + (place >= k + 1) for k in range(len(self.axes)))
        return {axis.name: 0.5 * axis.amplitude * wave for axis, wave in zip(self.axes, waves, strict=True)}

    def write(self, folder: Path, trial: Trial) -> None:
        """Write the files listed in `files`."""

    def components(self) -> Iterator[str]:
        """Yield the scenario lines of further components, besides `plant` and `excitation`."""
        yield from ()

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Yield the scenario lines of the connections.

        Args:
            variance: Noise variance of each output.
        """
        yield from (f"  - {{from: excitation.{q.name}, to: plant.{q.name}}}" for q in model.inputs)


def clip(values: Array, name: str, ranges: Ranges) -> Array:
    """Return commands of an input clipped to its range."""
    return np.clip(values, *ranges.get(name, (-math.inf, math.inf)))


def trial_of(
    model: Model, count: int, command: Callable[[int, Values], Values], signals: Signals, references: dict[str, Array]
) -> Trial:
    """Simulate a model over `count` rows.

    Args:
        command: Function from (row index, outputs) to the inputs.
        signals, references: Axis signals and references of the loop, stored in the trial.
    """
    stepper = Stepper(model)
    moment, u = stepper.start(), model.start_command()
    inputs, outputs = np.full((count, len(model.inputs)), np.nan), np.full((count, len(model.outputs)), np.nan)
    try:
        for k in range(count):
            u = command(k, stepper.output(moment.t, moment.state, u))
            inputs[k], outputs[k] = u, stepper.output(moment.t, moment.state, u)
            moment = stepper.step(moment, u, model.rate)
    except (ArithmeticError, ValueError):  # math.sin of infinity fails; the remaining rows stay NaN
        pass
    return Trial(
        model.rate * np.arange(count, dtype=np.float64),
        signals,
        {q.name: inputs[:, j] for j, q in enumerate(model.inputs)},
        references,
        {q.name: outputs[:, j] for j, q in enumerate(model.outputs)},
    )
