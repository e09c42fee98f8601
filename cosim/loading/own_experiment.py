"""An experiment that the FMU of a model carries, computed from the equations and not by the FMU."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from cosim.fmi.related_files import EXPERIMENTS, Experiment, RelatedFile, add_related, experiments_text
from cosim.model.integrate import Stepper
from cosim.model.model import Model
from cosim.model.quantities import Quantity
from cosim.storage.csv_source import table_bytes

ROWS = 400  # communication steps
SHARE = 0.1  # amplitude of an input, relative to its range or start value
FILE, STIMULI, REFERENCES = "smoke-test.exp", "smoke-test-in.csv", "smoke-test-out.csv"


def carry_experiment(fmu: Path, model: Model) -> Path:
    """Add a run with small sines at the inputs, and the outputs of the model, to its FMU.

    A model that leaves the finite numbers within the run carries none.
    """
    h = model.rate
    times = [k * h for k in range(ROWS + 1)]
    commands = [_command(model, k) for k in range(ROWS + 1)]
    try:
        outputs = _outputs(model, times, commands)
    except (ArithmeticError, ValueError):
        return fmu
    if not all(math.isfinite(value) for row in outputs for value in row):
        return fmu
    stimuli = {STIMULI: _table(model.inputs, times, commands)} if model.inputs else {}
    more = stimuli | {REFERENCES: _table(model.outputs, times, outputs)}
    about = "small sines at the inputs" if stimuli else "a run from the start values"
    run = Experiment("smoke test", about, 0.0, times[-1], h, stimuli=STIMULI if stimuli else "", references=REFERENCES)
    text = experiments_text("smoke test", [run], "Expected outputs are those of the equations, computed apart.")
    add_related(fmu, [(RelatedFile(FILE, "experiment/smoke-test", EXPERIMENTS, about), text)], more)
    return fmu


def _command(model: Model, row: int) -> tuple[float, ...]:
    """Return the inputs that act from a row on; sines of one, two, three … periods."""
    values = []
    for number, (quantity, start) in enumerate(zip(model.inputs, model.start_command(), strict=True), 1):
        low, high = quantity.bounds
        room = high - low if math.isfinite(high - low) else abs(start)
        value = start + SHARE * room * math.sin(2.0 * math.pi * number * row / ROWS)
        values.append(min(max(value, low), high))
    return tuple(values)


def _outputs(model: Model, times: Sequence[float], commands: Sequence[tuple[float, ...]]) -> list[tuple[float, ...]]:
    stepper = Stepper(model)
    moment, rows = stepper.start(), []
    for k, t in enumerate(times):
        shaped, _ = stepper.shape(t, 0.0, commands[k], moment.memory) if moment.memory else (commands[k], ())
        rows.append(tuple(map(float, stepper.output(t, moment.state, shaped))))
        if k < ROWS:
            moment = stepper.step(moment, commands[k], times[k + 1] - t)
    return rows


def _table(quantities: Sequence[Quantity], times: Sequence[float], rows: Sequence[Sequence[float]]) -> bytes:
    columns = zip(*rows, strict=True)
    return table_bytes({"time": times, **dict(zip((q.name for q in quantities), columns, strict=True))})
