"""Replays of logs through the SSP of a refined FMU, by the runs of `cosim run`."""

from __future__ import annotations

import json
import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.base.arrays import Array
from cosim.base.scratch import temporary_folder
from cosim.kernel.kernel import START, Data
from cosim.logs.log import Log
from cosim.probing.fmu_structure import Structure
from cosim.residuals.windows import Replay
from cosim.simulation.packaged import open_scenario
from cosim.simulation.workflow import run
from cosim.subject.effect_ssp import INPUTS, ORIGINAL
from cosim.subject.interface import Replayer, Start, Workplace
from cosim.terms.language import with_place

COMMANDS = "commands"  # component that plays the inputs of a log


@dataclass
class SspReplayer(Replayer):
    """Free runs of an SSP from the start of each log, and no shorter replays: an SSP begins at its start only."""

    structure: Structure
    ssp: Path
    place: Workplace
    through: str = "ssp"

    def replays(
        self, log: Log, data: Data, values: Mapping[str, float], starts: Mapping[float, Mapping[int, Start]]
    ) -> Generator[Replay, None, None]:
        """Yield one replay for each horizon."""
        units = {with_place(q.name): q.unit for q in self.structure.outputs}
        grid = np.asarray(log.grid, np.intp)
        for horizon, begins in starts.items():
            table = np.full((log.rows, len(units)), np.nan)
            if math.isinf(horizon):
                first = min(begins)
                table[first + 1 :] = self.free_run(data, begins[first].states)[grid[first + 1 :]]
            begun = {k: {n: v for n, v in start.states.items() if "." not in n} for k, start in begins.items()}
            yield Replay(log.time, horizon, begun, dict(zip(units, table.T, strict=True)), units)

    def free_run(self, data: Data, states: Mapping[str, float]) -> Array:
        """Return the outputs of the original at the rows of a log in equal steps.

        Raises:
            SimulationError: An FMU fails.
        """
        structure = self.structure
        with temporary_folder("replay") as folder, open_scenario(self.ssp) as packaged:
            content = dict(packaged.scenario)
            substeps = max(1, round(data.step / content["step"]))
            components = {
                name: {**c, "fmu": str(packaged.files[c["fmu"]])} for name, c in content["components"].items()
            }
            started = {s.name: states.get(START + with_place(s.name)) for s in structure.starts}
            own = components[ORIGINAL].get("start", {})
            components[ORIGINAL]["start"] = own | {n: v for n, v in started.items() if v is not None}
            self._write_commands(folder / "commands.csv", data, substeps)
            components[COMMANDS] = {"block": "playback", "file": "commands.csv"}
            target = INPUTS if INPUTS in components else ORIGINAL
            played = [{"from": f"{COMMANDS}.{q.name}", "to": f"{target}.{q.name}"} for q in structure.inputs]
            content |= {
                "start_time": data.start,
                "step": data.step / substeps,
                "duration": (len(data.u) - 1) * data.step,
                "components": components,
                "connections": [*content["connections"], *played],
            }
            path = folder / "scenario.json"
            path.write_text(json.dumps(content), encoding="utf-8")
            rows = run(path, folder / "run", report=False, in_process=self.place.in_process).results
        names = [f"{ORIGINAL}.{q.name}" for q in structure.outputs]
        return np.column_stack([rows[name][::substeps] for name in names])

    def _write_commands(self, path: Path, data: Data, substeps: int) -> None:
        """Write the commands of each step; an interpolated input has its value at the middle of the step."""
        inputs = self.structure.inputs
        heads = [f"{q.name} [{q.unit}]" if q.unit else q.name for q in inputs]
        number = np.arange((len(data.u) - 1) * substeps + 1)
        row, share = number // substeps, (number % substeps + 0.5) / substeps
        following = np.minimum(row + 1, len(data.u) - 1)
        commands = np.asarray(data.u, float)[row]
        for k, q in enumerate(inputs):
            if with_place(q.name) in data.interpolated:
                commands[:, k] += share * (data.u[following, k] - data.u[row, k])
        times = data.start + number * (data.step / substeps)
        lines = (",".join(map(repr, [t, *u])) for t, u in zip(times.tolist(), commands.tolist(), strict=True))
        path.write_text("\n".join([",".join(["time", *heads]), *lines]) + "\n", encoding="utf-8")
