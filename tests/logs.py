"""Logs of a craft whose truth is known: flown by the plant's own stepper, written as a user would."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cosim.logs.log import Log, read_log
from cosim.model import Moment, Stepper
from cosim.residuals.drive import Drive, as_columns
from cosim.residuals.windows import Replay, free_run, windows
from plant.hovercraft import INPUTS, OUTPUTS, STATES, Hovercraft
from tests.blind.field_rig import runge_kutta

Array = NDArray[np.float64]
RECORDED = Path(__file__).parent / "data" / "hovercraft_10s.csv"
STEP = 0.02  # [s], sample time of the rig
IMU = ("psi", "psi_dot", "ax")
POSITION = ("x_world", "y_world")
# standard deviations of eq 5.46, and 1 mm of position
NOISE = {"psi": 2.613e-5**0.5, "psi_dot": 4.564e-4**0.5, "ax": 0.04479**0.5, "x_world": 1e-3, "y_world": 1e-3}
MOVING = {"psi": 0.4, "psi_dot": -0.3, "x_world": 0.5, "y_world": -0.2, "vx": 0.3, "vy": 0.05}


@dataclass(frozen=True)
class Flight:
    """What really happened: rows of time [s], commands, states and outputs."""

    time: Array
    commands: dict[str, Array]
    states: dict[str, Array]
    outputs: dict[str, Array]

    def start(self, row: int) -> dict[str, float]:
        """The true state at a row as start parameters of the plant."""
        return {f"{name}_start": float(values[row]) for name, values in self.states.items()}


def times(seconds: float, step: float = STEP) -> Array:
    """Equal steps, counted."""
    return step * np.arange(round(seconds / step) + 1, dtype=np.float64)


def dither(time: Array, seed: int = 1, share: float = 1.0) -> dict[str, Array]:
    """Commands held over each row: both tilts and both duties move, in many frequencies, by a share of the usual."""
    rng = np.random.default_rng(seed)

    def tones(size: float, count: int = 8) -> Array:
        frequency, phase = rng.uniform(0.2, 4.0, count), rng.uniform(0.0, 2.0 * math.pi, count)
        waves = [np.sin(2.0 * math.pi * f * time + p) for f, p in zip(frequency, phase, strict=True)]
        return share * size * np.sum(waves, axis=0) / math.sqrt(count)

    common, differential, duty = tones(0.1), tones(0.05), Hovercraft().duty_nominal
    values = (duty + tones(0.05), duty + tones(0.05), common + differential, common - differential)
    return {q.name: v for q, v in zip(INPUTS, values, strict=True)}


def fly(
    time: Array,
    model: Hovercraft | None = None,
    start: Mapping[str, float] | None = None,
    seed: int = 1,
    share: float = 1.0,
) -> Flight:
    """Fly the plant's equations in process, at any times, under a share of the usual dither."""
    commands = dither(time, seed, share)
    stepper = Stepper(model or Hovercraft())
    moment = stepper.start(float(time[0]), start)
    states, outputs = [], []
    rows = np.column_stack(list(commands.values())).tolist()
    for k, command in enumerate(map(tuple, rows)):
        states.append(moment.state[: len(STATES)])
        outputs.append(stepper.output(moment.t, moment.state, command))
        if k + 1 < len(rows):
            moment = stepper.step(Moment(float(time[k]), *_rest(moment)), command, float(time[k + 1] - time[k]))
    table, seen = np.array(states), np.array(outputs)
    return Flight(
        time, commands, {q.name: table[:, i] for i, q in enumerate(STATES)},
        {q.name: seen[:, i] for i, q in enumerate(OUTPUTS)},
    )  # fmt: skip


def _rest(moment: Moment) -> tuple[Any, Any]:
    return moment.state, moment.memory


def measured(
    flight: Flight, channels: Sequence[str] = (*IMU, *POSITION), noise: float = 0.0, seed: int = 7
) -> dict[str, Array]:
    """Columns of a log: time, commands, and `noise` times the model sheet's noise on the channels."""
    rng = np.random.default_rng(seed)
    seen = {n: flight.outputs[n] + noise * NOISE.get(n, 0.0) * rng.standard_normal(flight.time.size) for n in channels}
    return {"time": flight.time, **flight.commands, **seen}


def integrated(
    rates: Callable[[Array, Any], Any], start: Sequence[float], inputs: Iterable[Any], step: float, parts: int = 20
) -> Array:
    """Return the states at each row of inputs, which are held, by Runge-Kutta in parts of a row."""
    x, h, states = np.array(start, dtype=float), step / parts, []
    for u in inputs:
        states.append(x)
        for _ in range(parts):
            x = runge_kutta(lambda _, x, u=u: np.asarray(rates(x, u)), 0.0, x, h)
    return np.array(states)


def write_log(path: Path, columns: Mapping[str, Array]) -> Path:
    """CSV with every digit; NaN as an empty cell."""
    lines = [",".join(columns)]
    for row in zip(*(c.tolist() for c in columns.values()), strict=True):
        lines.append(",".join("" if math.isnan(v) else repr(v) for v in row))
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


def log_of(path: Path, columns: Mapping[str, Array]) -> Log:
    """The log of these columns, through its file."""
    return read_log(write_log(path, columns), INPUTS, OUTPUTS)


def replay(log: Log, fmu: Path, start: Mapping[str, Any] | None = None) -> Replay:
    """Replay a whole log in a single run of an FMU."""
    with Drive(log, fmu) as drive:
        if start is None:
            return free_run(drive)
        outputs = as_columns(drive.run(0, log.rows - 1, start), drive.outputs)
        return Replay(math.inf, {0: start}, outputs)


def replay_windows(log: Log, fmu: Path, starts: Mapping[int, Mapping[str, Any]], horizon: float) -> Replay:
    """Replay a log in windows of `horizon` seconds of an FMU."""
    with Drive(log, fmu) as drive:
        return windows(drive, starts, horizon)
