"""Replays of logs through a model's FMU, from filtered states and effect memories."""

from __future__ import annotations

import functools
import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.estimation.kernel.kernel import CONSTANT, Data
from cosim.estimation.subject.interface import Replayer, Start, Workplace
from cosim.fmi.state import MEMORY, Memory
from cosim.logs.log import Log
from cosim.model.model import Effect, Model, overrides
from cosim.residuals.drive import Drive
from cosim.residuals.remote_drive import DriveApart
from cosim.residuals.windows import Replay, windows


@dataclass
class FmuReplayer(Replayer):
    """A model's FMU in a worker process.

    Attributes:
        parameters: Values to set on the FMU if different from its defaults.
    """

    model: Model
    fmu: Path
    place: Workplace
    through: str
    parameters: Mapping[str, Any] = field(default_factory=dict)

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield one replay for each horizon, with one load of the FMU."""
        worker, limits = self.place.worker, self.place.limits
        remote = worker and DriveApart(worker, log, self.fmu, interpolated=data.interpolated, limits=limits)
        with remote or Drive(log, self.fmu, interpolated=data.interpolated) as drive:
            for horizon, begins in starts.items():
                numbers = {k: {**self.parameters, **start_values(self.model, start)} for k, start in begins.items()}
                memories = {k: delayed_commands(self.model, values, log, data, k) for k in begins}
                yield windows(drive, numbers, horizon, memories)


def start_values(model: Model, start: Start) -> dict[str, float]:
    """Return the FMU's start parameters for a replay.

    Delays and sensor errors are excluded.
    """
    awake, plant = {e.name for e in model.awake}, model.declared
    values = {name: value for name, value in start.per_log.items() if name in plant}
    for name, value in start.states.items():
        if not name.startswith(CONSTANT) and ("." not in name or name.split(".")[0] in awake):
            values[f"{name}_start"] = value
    # for the memory of a delay see `delayed_commands`
    places = [(e.name, q.name) for e in shaping_effects(model.catalogue) if not e.delay for q in e.memory]
    for (effect, memory), value in zip(places, start.memory, strict=False):
        if effect in awake:
            values[f"{effect}.{memory}_start"] = float(value)
    return values


@functools.cache
def shaping_effects(catalogue: tuple[type[Effect], ...]) -> tuple[Any, ...]:
    """Return the command-shaping effects of a catalogue, in order."""
    return tuple(overrides(tuple(kind() for kind in catalogue), "shape", Effect))


def delayed_commands(model: Model, values: Mapping[str, float], log: Log, data: Data, k: int) -> Memory:
    """Return commands still in a delay at row k, (start time, command), oldest first."""
    shaping = overrides(model.awake, "shape", Effect)
    waiting: dict[tuple[int, int], Any] = {}
    for place, effect in enumerate(shaping):
        if effect.delay:
            row = int(log.grid[k])
            late = values[f"{effect.name}.{effect.delay}"] / data.step
            rows = range(max(0, math.floor(row - late)), row) or [row]
            waiting[MEMORY, place] = [[float(log.time[k]) - (row - j) * data.step, data.u[j].tolist()] for j in rows]
    return waiting
