"""Experiment rigs, which apply random signals to a model and simulate the response.

The open-loop rig suits any stable model; for an unstable model, a rig with a controller is registered
(`cosim.core.registry`).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import did_you_mean
from cosim.core.units import NUMBER_PATTERN, conversion, read_quantity
from cosim.estimation.data import data_of, start_state
from cosim.estimation.subject.fmu_subject import FmuSubject
from cosim.estimation.subject.interface import Subject
from cosim.estimation.subject.model_subject import neutral_values
from cosim.logs.log import Log
from cosim.model.integrate import Stepper
from cosim.model.model import Model, Values

Signals = Mapping[str, Array]
Ranges = Mapping[str, tuple[float, float]]  # input → smallest and largest value
MAX_FREQUENCY_SHARE = 0.1  # largest frequency, as a share of the sample rate
MIN_PERIODS = 2.0  # smallest number of periods in a trial


@dataclass(frozen=True)
class RigAxis:
    """An independent signal of an experiment, with an amplitude and a frequency range [Hz]."""

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
        return Log(
            Path("trial.csv"), self.time, self.inputs, outputs, units, step=model.rate, written=units, unwrapped={}
        )

    def excess(self, limits: Mapping[str, float]) -> float:
        """Return the largest excursion relative to its limit; infinite if the model diverges."""
        if not all(np.isfinite(values).all() for values in self.outputs.values()):
            return math.inf
        outputs = self.outputs
        shares = (np.abs(outputs[n] - outputs[n][0]).max() / limit for n, limit in limits.items() if n in outputs)
        return float(max(shares, default=0.0))


class OpenLoop:
    """Open-loop rig: each input gets a signal around its start value. Other rigs derive from this class.

    A rig simulates an experiment within input ranges and writes its scenario.

    Attributes:
        axes: Signals that an experiment varies.
        usual: Description of the usual input, for comparison.
        files: Files written in addition to excitation.csv, excitation.yaml and plant.fmu.
    """

    usual = "a step of each input in turn"
    files: tuple[str, ...] = ()

    def __init__(self, model: Model, limits: Mapping[str, float], ranges: Ranges, duration: float) -> None:
        self.ranges = ranges
        fastest = MAX_FREQUENCY_SHARE / model.rate
        slowest = min(MIN_PERIODS / duration, fastest)
        self.axes = tuple(RigAxis(q.name, limits[q.name], slowest, fastest) for q in model.inputs)

    def commands(self, model: Model, signals: Signals) -> dict[str, Array]:
        """Return the inputs: start values plus axis signals, clipped to their ranges."""
        starts = zip(model.inputs, model.start_command(), strict=True)
        return {q.name: clip(start + signals[q.name], q.name, self.ranges) for q, start in starts}

    def play(self, model: Model, signals: Signals) -> Trial:
        """Simulate a model with axis signals, clipped to the ranges of the inputs."""
        rows = [*zip(*(u.tolist() for u in self.commands(model, signals).values()), strict=True)]
        return trial_of(model, len(rows), lambda k, y: rows[k], signals, {})

    def usual_signals(self, time: Array) -> Signals:
        """Return the signals of the usual input: a half-amplitude pulse of each input in turn, in both directions."""
        place = time / time[-1] * len(self.axes)
        waves = ((place >= k) * 1.0 - 2.0 * (place >= k + 0.5) + (place >= k + 1) for k in range(len(self.axes)))
        return {axis.name: 0.5 * axis.amplitude * wave for axis, wave in zip(self.axes, waves, strict=True)}

    def write(self, folder: Path, trial: Trial) -> None:
        """Write the files listed in `files`."""

    def components(self) -> Iterator[str]:
        """Yield the scenario lines of components other than `plant` and `excitation`."""
        return iter(())

    def connections(self, model: Model, trial: Trial, variance: Mapping[str, float]) -> Iterator[str]:
        """Yield the scenario lines of the connections.

        Args:
            variance: Noise variance of each output.
        """
        variables = getattr(model, "variables", {})  # of an FMU
        for q in model.inputs:
            yield f'  - {{from: excitation.{q.name}, to: "plant.{variables.get(q.name, q.name)}"}}'


class FmuOpenLoop(OpenLoop):
    """Open-loop rig that simulates an FMU with the added terms of a hypothesis.

    Args:
        first: Output → reading at the start.
    """

    def __init__(
        self,
        subject: FmuSubject,
        first: Mapping[str, float],
        limits: Mapping[str, float],
        ranges: Ranges,
        duration: float,
    ) -> None:
        super().__init__(subject.model, limits, ranges, duration)
        self.subject, self.first = subject, first
        self.kernel = subject.kernel([q.name for q in subject.outputs])

    def play(self, model: Model, signals: Signals) -> Trial:
        """Simulate the FMU with the parameters of a model, and input signals clipped to the ranges."""
        inputs = self.commands(model, signals)
        time = model.rate * np.arange(len(next(iter(signals.values()))), dtype=np.float64)
        names = [q.name for q in model.outputs]
        readings = {n: np.where(np.arange(time.size) == 0, self.first.get(n, np.nan), np.nan) for n in names}
        log = Log(Path("trial.csv"), time, inputs, readings, {}, model.rate, {}, {})
        layout = self.kernel.layout
        data = data_of(self.subject, log, layout)
        values = neutral_values(model)
        p = np.array([values.get(name, 1.0) for name in layout.parameters])
        x0 = start_state(self.subject, data, layout.outputs, layout.states)
        table = self.kernel.simulate(data, p, x0, np.zeros(layout.memory)).outputs
        return Trial(time, signals, inputs, {}, dict(zip(names, table.T, strict=True)))


def clip(values: Array, name: str, ranges: Ranges) -> Array:
    """Return values of an input clipped to its range."""
    return np.clip(values, *ranges.get(name, (-math.inf, math.inf)))


def trial_of(
    model: Model, count: int, command: Callable[[int, Values], Values], signals: Signals, references: dict[str, Array]
) -> Trial:
    """Simulate a model over `count` rows; rows after a divergence are NaN.

    Args:
        command: Function from (row index, outputs) to the inputs.
        signals: Signals of the excitation, one for each axis; they are only stored in the trial.
        references: References of the loop, also only stored.
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


LIMITS_PATTERN = re.compile(
    rf"(?P<name>[^=]+)=\s*(?P<low>{NUMBER_PATTERN})\s*\.\.\s*(?P<high>{NUMBER_PATTERN})\s*(?P<unit>.*)"
)


def inputs_to_limit(model: Model | Subject) -> tuple[str, ...]:
    """Return inputs without a declared limit."""
    return tuple(
        q.name for q in model.inputs if q.name not in model.excursion and not all(map(math.isfinite, q.bounds))
    )


def limits_and_ranges(
    model: Model, limits: Sequence[str], ranges: Sequence[str], logged: Ranges, faults: list[str]
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Return the largest allowed excursion of each limited signal, and the range of each input; extend `faults`.

    A range is the declared range, narrowed by NAME=MIN..MAX. For an input without range and limit, it is the range in
    logs.
    """
    spans = {q.name: q.bounds for q in model.inputs}
    units = {q.name: q.unit for q in (*model.outputs, *model.inputs)}
    for text in ranges:
        match, name = LIMITS_PATTERN.fullmatch(text.strip()), text.partition("=")[0].strip()
        if name not in spans:
            faults.append(f'--range {text}: no input "{name}"{did_you_mean(name, spans)} (inputs: {", ".join(spans)})')
            continue
        unit, (low, high) = units[name], spans[name]
        convert = conversion(match["unit"].strip(), unit) if match else None
        lower, upper = (convert(float(match[end])) if match and convert else math.nan for end in ("low", "high"))
        if lower < upper and max(lower, low) < min(upper, high):
            spans[name] = max(lower, low), min(upper, high)
        else:
            cure = f"give the range of {name} [{unit}], lower end first, such as {name}=0..10"
            faults.append(f"--range {text}: {cure}; the model declares {low:g}..{high:g} {unit} for {name}")
    reaches, starts = dict(model.excursion), dict(zip(spans, model.start_command(), strict=True))
    for text in limits:
        name, _, value = (part.strip() for part in text.partition("="))
        if name not in units:
            faults.append(f'--limit {text}: no input or output "{name}"{did_you_mean(name, units)}')
            continue
        size = math.nan
        with suppress(ValueError):
            size = read_quantity(value, units[name], difference=True)
        if size > 0:
            reaches[name] = size
            continue
        cure = f"give the largest deviation of {name}, above 0 [{units[name]}], such as {name}=0.1"
        faults.append(f"--limit {text}: {cure}")
    for q in model.inputs:
        if q.name in reaches:
            continue
        pairs = zip(spans[q.name], logged.get(q.name, spans[q.name]), strict=True)
        low, high = (end if math.isfinite(end) else logged_end for end, logged_end in pairs)
        reach = max(high - starts[q.name], starts[q.name] - low)
        if math.isfinite(reach) and reach > 0.0:
            spans[q.name], reaches[q.name] = (low, high), reach
        else:
            faults.append(
                f"{q.name} has no limit (start value {q.start:g}); add --limit {q.name}=VALUE or --range "
                f"{q.name}=MIN..MAX [{q.unit}]"
            )
    return reaches, {name: span for name, span in spans.items() if any(map(math.isfinite, span))}
