"""A model run along a log: commands as recorded, states as read where an output shows them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from cosim.base.arrays import Array, Rows
from cosim.model.integrate import Moment, Stepper
from cosim.model.model import Model, Values
from cosim.model.namespaces import SCALAR

HOLE = 10.0  # rows: of a longer time between two rows only so much is integrated


class Record(Protocol):
    """A log, as far as a run along it needs: `cosim.logs.log.Log`."""

    @property
    def path(self) -> Path:
        """Its file."""

    @property
    def time(self) -> Array:
        """Times of its rows [s]."""

    @property
    def step(self) -> float:
        """Usual time between rows [s]."""

    @property
    def inputs(self) -> Mapping[str, Array]:
        """Commands by input."""

    @property
    def outputs(self) -> Mapping[str, Array]:
        """Readings by output, NaN where nothing was read."""


def shown_states(model: Model) -> set[str]:
    """Return the states that outputs of their name show unscaled and unturned, tried at one state."""
    state = tuple(value + 0.01 * (k + 1) for k, value in enumerate(model.start()))
    values = dict(zip((s.name for s in model.states), state, strict=True))
    outputs = model.acting(SCALAR).output(0.0, state, model.start_command())
    return {q.name for q, y in zip(model.outputs, outputs, strict=True) if values.get(q.name) == y}


def moments(
    stepper: Stepper, log: Record, ignored: Mapping[str, Rows] | None = None
) -> Iterator[tuple[int, Moment, Moment]]:
    """Yield row, moment predicted from the rows before, and moment with the readings of the row in its place.

    Ends where the model runs away. ignored: rows by output whose readings are not used
    """
    model, shown = stepper.model, shown_states(stepper.model)
    commands = command_rows(model, log)
    readings = {}
    for place, name in enumerate(s.name for s in model.states):
        if name in shown and name in log.outputs:
            column = log.outputs[name].copy()
            column[(ignored or {}).get(name, [])] = np.nan
            readings[place] = column.tolist()
    time, longest = log.time.tolist(), HOLE * log.step
    ahead = stepper.start(time[0])
    for k, t in enumerate(time):
        ahead = replace(ahead, t=t)
        moment = replace(ahead, state=_as_read(ahead.state, readings, k))
        yield k, ahead, moment
        if k + 1 < len(time):
            try:
                ahead = stepper.step(moment, commands[k], min(time[k + 1] - t, longest))
            except (ArithmeticError, ValueError):
                return
            if not all(map(math.isfinite, ahead.state)):
                return


def command_rows(model: Model, log: Record) -> list[Values]:
    """Return the commands of each row, in the order of the model's inputs."""
    columns = [log.inputs[q.name].tolist() for q in model.inputs]
    return list(zip(*columns, strict=True)) if columns else [()] * len(log.time)


def predicted_outputs(model: Model, log: Record, ignored: Mapping[str, Rows]) -> dict[str, Array]:
    """Return what the model says of each output one row ahead; NaN from where it runs away.

    ignored: rows by output whose readings are not used
    """
    stepper, commands = Stepper(model), command_rows(model, log)
    table = np.full((len(log.time), len(model.outputs)), np.nan)
    for k, ahead, _ in moments(stepper, log, ignored):
        try:
            table[k] = stepper.output(ahead.t, ahead.state, commands[max(0, k - 1)])
        except (ArithmeticError, ValueError):
            break
    return dict(zip((q.name for q in model.outputs), table.T, strict=True))


def _as_read(state: Values, readings: Mapping[int, list[float]], k: int) -> Values:
    """Return the state with what was read in row k in its place."""
    if not readings:
        return state
    values = list(state)
    for place, column in readings.items():
        if math.isfinite(column[k]):
            values[place] = column[k]
    return tuple(values)
