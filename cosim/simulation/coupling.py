"""What the length of the communication step does to a run: the same one again in steps of half the length.

Where a method of order p is used the halved run is 2^p times nearer the limit, so the difference is about the error
of the run itself for p = 1, the order of Gauss-Seidel and Jacobi with inputs that are held.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cosim.files import FilePath
from cosim.results import Results
from cosim.simulation.design import designed_values
from cosim.simulation.master import StoppedRun, simulate
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.system import build_system


@dataclass(frozen=True)
class CouplingError:
    """Of each connected signal the largest difference between the run and its halved one, in the signal's unit.

    stopped: why there is none
    """

    of: Mapping[str, float]
    stopped: str = ""

    @property
    def sentence(self) -> str:
        """What is said of it in a line."""
        if self.stopped:
            return f"coupling error not known: with half the step {self.stopped}"
        shown = ", ".join(f"{name} {value:.2g}" for name, value in self.of.items())
        return f"coupling error, by halving the step, at most: {shown or 'nothing is connected'}"


def coupling_error_of(scenario: FilePath, overrides: Sequence[str] = ()) -> CouplingError:
    """The coupling error of a scenario file. Raises InputError, FmuError."""
    file = ScenarioFile(Path(scenario), overrides)
    return coupling_error(file, designed_values(file))


def coupling_error(file: ScenarioFile, designed: Mapping[str, Mapping[str, float]] | None = None) -> CouplingError:
    """Compare the scenario, without noise and faults by chance, at its step and at half of it."""
    whole = _results(file, designed, 1)
    halved = _results(file, designed, 2)
    for results in (whole, halved):
        if isinstance(results, str):
            return CouplingError({}, results)
    assert isinstance(whole, Results)
    assert isinstance(halved, Results)
    names = dict.fromkeys(c.source for c in file.scenario.connections)
    return CouplingError(differences(whole, halved, list(names)))


def differences(whole: Results, halved: Results, names: Sequence[str]) -> dict[str, float]:
    """The largest difference of each signal at the communication points that both have."""
    rows = min(len(whole.time), (len(halved.time) + 1) // 2)
    found = {}
    for name in names:
        for column in whole.columns:
            if column == name or column.startswith(f"{name}["):
                found[column] = float(np.max(np.abs(whole[column][:rows] - halved[column][: 2 * rows : 2][:rows])))
    return found


def _results(file: ScenarioFile, designed: Mapping[str, Mapping[str, float]] | None, parts: int) -> Results | str:
    """Rows with steps of one of `parts` of the scenario's, or why there are none."""
    scenario = file.scenario
    step = scenario.step / parts
    file.scenario = scenario.model_copy(update={"step": step, "noise": False})
    try:
        return simulate(build_system(file, designed), scenario.steps * parts, step)
    except StoppedRun as stopped:
        return str(stopped.error)
    finally:
        file.scenario = scenario
