"""Other people's FMUs of FMI 3.0 with event mode, clocks or partitions: `python -m tests.foreign_events FOLDER…`.

Each FMU for co-simulation with event mode runs alone in `cosim`, and in a loop written here with FMPy's classes only:
steps to communication points and ticks, early returns, event mode. Every number at every communication point is
compared. The Reference-FMU Clocks is compared with the values that the program `scs_synchronous` beside it prints.
"""

from __future__ import annotations

import json
import math
import sys
import tempfile
from pathlib import Path
from typing import Any

from cosim.blocks.clocks import Clock, read_clocks
from tests.foreign import fmus_in, plan

NUMBERS = ("Float64", "Float32", "Int8", "UInt8", "Int16", "UInt16", "Int32", "UInt32", "Boolean")
CLOCKS = {  # of scs_synchronous: time 0, 1, … 9 s
    "inClock1Ticks": [1, 2, 3, 4, 5, 6, 7, 8, 9, 10],
    "inClock2Ticks": [1, 2, 2, 2, 2, 2, 2, 2, 3, 4],
    "inClock3Ticks": [0, 0, 0, 0, 1, 1, 1, 1, 1, 1],
    "totalInClockTicks": [2, 4, 5, 6, 8, 9, 10, 11, 13, 15],
}


class Driver:
    """An FMU alone, stepped by FMPy's classes."""

    def __init__(self, path: Path, folder: str, description: Any, start: float, stop: float) -> None:
        import fmpy
        from fmpy.fmi3 import FMU3Slave

        unzipped = fmpy.extract(str(path), folder)
        about = description.coSimulation
        self.fmu = FMU3Slave(
            guid=description.guid, unzipDirectory=unzipped, modelIdentifier=about.modelIdentifier, instanceName="x"
        )
        self.clocks = {n: c for n, c in read_clocks(path, description).items() if c.causality == "input"}
        self.outputs = [v for v in description.modelVariables if v.causality == "output" and v.type in NUMBERS]
        self.values: dict[str, list[Any]] = {}
        self.time, self.start, self.next_event = start, start, float("inf")
        self.ticks = dict.fromkeys((n for n, c in self.clocks.items() if c.interval is not None), 0)
        self.fmu.instantiate(eventModeUsed=True, earlyReturnAllowed=True, logMessage=lambda *_: None)
        tolerance = getattr(description.defaultExperiment, "tolerance", None)
        tolerance = None if tolerance is None else float(tolerance)
        self.fmu.enterInitializationMode(tolerance=tolerance, startTime=start, stopTime=stop)
        self.read(self.clocks)
        self.fmu.exitInitializationMode()
        self.handle()

    def due(self, name: str) -> float:
        """Return the time of the next tick of a periodic clock."""
        clock: Clock = self.clocks[name]
        return self.start + clock.shift + self.ticks[name] * (clock.interval or 0.0)

    def read(self, active: Any = ()) -> None:
        """Read the outputs that may be read."""
        for variable in self.outputs:
            if not variable.clocks or any(clock.name in active for clock in variable.clocks):
                count = max(1, len(variable.shape or ()) and math.prod(variable.shape))
                get = getattr(self.fmu, f"get{variable.type}")
                self.values[variable.name] = get([variable.valueReference], nValues=count)

    def handle(self) -> None:
        """Tick the clocks that are due, and update discrete states."""
        due = [name for name in self.ticks if self.due(name) <= self.time + 1e-12]
        if due:
            self.fmu.setClock([self.clocks[name].reference for name in due], [True] * len(due))
        self.read(due)
        while True:
            more, _, _, _, known, at = self.fmu.updateDiscreteStates()
            self.next_event = at if known else float("inf")
            if not more:
                break
        for name in due:
            self.ticks[name] += 1
        self.read()
        self.fmu.enterStepMode()

    def step_to(self, end: float) -> None:
        """Step to a communication point across all events and ticks."""
        while self.time < end - 1e-12:
            target = min([end, self.next_event, *map(self.due, self.ticks)])
            target = end if target > end - 1e-12 else target
            event, _, early, last = self.fmu.doStep(self.time, target - self.time)
            self.time = min(last, target) if early else target
            self.read()
            if event or self.next_event <= self.time or any(self.due(n) <= self.time + 1e-12 for n in self.ticks):
                self.fmu.enterEventMode()
                self.handle()


def cosims(path: Path, start: float, step: float, steps: int, **component: Any) -> Any:
    """Return the results of `cosim`."""
    from cosim.master.master import simulate
    from cosim.scenario.scenario_file import ScenarioFile
    from cosim.system.system import build_system

    scenario = {
        "name": "alone",
        "start_time": start,
        "duration": step * steps,
        "step": step,
        "components": {"x": {"fmu": str(path.resolve()), **component}},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "alone.yaml"
        file.write_text(json.dumps(scenario))
        read = ScenarioFile(file)
        return simulate(build_system(read), read.scenario.steps, step)


def compare(path: Path, description: Any) -> str:
    """Return the comparison of an FMU with event mode as a sentence."""
    from cosim.fmi.fmi_types import element_names

    start, step, steps = plan(description)
    results = cosims(path, start, step, steps, interface="co-simulation", event_mode=True)
    equal, count, worst = 0, 0, 0.0
    with tempfile.TemporaryDirectory() as folder:
        driver = Driver(path, folder, description, start, start + step * steps)
        for k, t in enumerate(results.time):  # fewer than `steps` if the FMU ends the simulation
            driver.step_to(float(t))
            for variable in driver.outputs:
                for name, value in zip(element_names(variable), driver.values[variable.name], strict=True):
                    other = float(results[f"x.{name}"][k])
                    count, equal = count + 1, equal + (other == value)
                    worst = max(worst, abs(other - value) / max(1.0, abs(value)))
    events = dict(sorted(results.event_counts.get("x", {}).items()))
    return f"{equal} of {count} values equal bit for bit, largest difference {worst:.1e}; {events}"


def compare_clocks(path: Path) -> str:
    """Return the comparison of the Reference-FMU Clocks as a sentence."""
    results = cosims(path, 0.0, 1.0, 9, clocks={"inClock2": {"at": [0, 1, 8, 9]}})
    equal = sum(
        int(a == b) for name, values in CLOCKS.items() for a, b in zip(results[f"x.{name}"], values, strict=True)
    )
    return f"{equal} of {sum(map(len, CLOCKS.values()))} values equal; {results.event_counts['x']}"


def main() -> int:
    import fmpy

    for path in fmus_in([Path(folder) for folder in sys.argv[1:]]):
        try:
            description = fmpy.read_model_description(str(path), validate=False)
            if getattr(description.coSimulation, "hasEventMode", False) and description.fmiVersion == "3.0":
                print(f"{path.name}: {compare(path, description)}", flush=True)
            elif description.scheduledExecution is not None and description.modelName == "Clocks":
                print(f"{path.name}: {compare_clocks(path)}", flush=True)
        except Exception as error:
            print(f"{path.name}: {type(error).__name__}: {' '.join(str(error).split())[:150]}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
