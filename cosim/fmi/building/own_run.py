"""Simulation of a model with a log's inputs. A state that an output measures is reset to each reading."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from cosim.core.arrays import Array, Rows
from cosim.model.integrate import Moment, Stepper
from cosim.model.model import Model, Values
from cosim.model.namespaces import SCALAR

MAX_GAP = 10.0  # rows; of a longer gap between rows, only this length is integrated


RunLog = Any  # stands for `cosim.logs.log.Log` of a higher room, with path, time, step, inputs, outputs


def shown_states(model: Model) -> set[str]:
    """Return the states that equal an output of the same name, as tested at one state."""
    state = tuple(value + 0.01 * (k + 1) for k, value in enumerate(model.start()))
    values = dict(zip((s.name for s in model.states), state, strict=True))
    outputs = model.acting(SCALAR).output(0.0, state, model.start_command())
    return {q.name for q, y in zip(model.outputs, outputs, strict=True) if values.get(q.name) == y}


def moments(
    stepper: Stepper, log: RunLog, ignored: Mapping[str, Rows] | None = None
) -> Iterator[tuple[int, Moment, Moment]]:
    """Yield each row's index, moment predicted from the previous row, and moment with states set to readings.

    The iteration ends if the model diverges.

    Args:
        ignored: Output → rows whose readings are not used.
    """
    model, shown, readings = stepper.model, shown_states(stepper.model), {}
    for place, name in enumerate(s.name for s in model.states):
        if name in shown and name in log.outputs:
            column = log.outputs[name].copy()
            column[(ignored or {}).get(name, [])] = np.nan
            readings[place] = column.tolist()
    commands, time, longest = command_rows(model, log), log.time.tolist(), MAX_GAP * log.step
    ahead = stepper.start(time[0])
    for k, t in enumerate(time):
        ahead, state = replace(ahead, t=t), list(ahead.state)
        for place, column in readings.items():
            if math.isfinite(column[k]):
                state[place] = column[k]
        moment = replace(ahead, state=tuple(state))
        yield k, ahead, moment
        if k + 1 < len(time):
            try:
                ahead = stepper.step(moment, commands[k], min(time[k + 1] - t, longest))
            except (ArithmeticError, ValueError):
                return
            if not all(map(math.isfinite, ahead.state)):
                return


def command_rows(model: Model, log: RunLog) -> list[Values]:
    """Return a tuple of commands for each row, in the order of the inputs."""
    columns = [log.inputs[q.name].tolist() for q in model.inputs]
    return list(zip(*columns, strict=True)) if columns else [()] * len(log.time)


def predicted_outputs(model: Model, log: RunLog, ignored: Mapping[str, Rows]) -> dict[str, Array]:
    """Return output → prediction from the previous row, for each row; NaN after the model diverges.

    Args:
        ignored: Output → rows whose readings are not used.
    """
    stepper, commands = Stepper(model), command_rows(model, log)
    table = np.full((len(log.time), len(model.outputs)), np.nan)
    for k, ahead, _ in moments(stepper, log, ignored):
        try:
            table[k] = stepper.output(ahead.t, ahead.state, commands[k])
        except (ArithmeticError, ValueError):
            break
    return dict(zip((q.name for q in model.outputs), table.T, strict=True))
