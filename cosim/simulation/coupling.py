"""Effect of the communication step length on a run, estimated with halved steps.

For a method of order p, the error of the run is 1/(1 − 2^−p) times the difference: about twice the difference for
p = 1, the order of Gauss-Seidel and Jacobi with held inputs. If the FMUs can save and restore their state, each step is
also repeated in halves, to show when the coupling error is largest.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cosim.core.errors import InputError, Interrupted
from cosim.core.messages import Note
from cosim.files.files import FilePath
from cosim.files.results import Results
from cosim.isolation.process import Worker
from cosim.master.beforehand import with_feedthrough
from cosim.master.remote import MODULES, simulate_in
from cosim.scenario.scenario_file import ScenarioFile, take_nearest
from cosim.system.control import rollback_obstacle
from cosim.system.system import System, build_system


@dataclass(frozen=True)
class CouplingError:
    """Largest difference between a run and its halved run per connected signal, in the signal's unit.

    Attributes:
        of: Signal → largest difference.
        stopped: Reason for missing differences.
        steps: Signal → largest difference caused by a single step, and its time [s].
        without: Reason for missing `steps`.
    """

    of: Mapping[str, float]
    stopped: str = ""
    steps: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    without: str = ""

    @property
    def sentence(self) -> str:
        """Return the result as one sentence."""
        if self.stopped:
            return f"coupling error not known: with half the step {self.stopped}"
        sizes = ", ".join(f"{name} {value:.2g}" for name, value in self.of.items())
        changes = f"{sizes}; the coupling error is about twice that" if sizes else "nothing, for nothing is connected"
        steps = ", ".join(f"{name} {value:.2g} at t = {t:g} s" for name, (value, t) in self.steps.items())
        if self.without:
            steps = f"; of single steps not known: {self.without}"
        elif steps:
            steps = f"; of a single step, taken back and made again in halves: {steps}"
        return Note(f"half the step changes at most {changes}{steps}")


def coupling_error(
    scenario: FilePath, overrides: Sequence[str] = (), *, nearest: bool = False, in_process: bool = False
) -> CouplingError:
    """Compare a scenario without noise at full and half step.

    FMUs run in a worker process within the limits of the scenario.

    Raises:
        InputError: The scenario is faulty.
        FmuError: An FMU does not load.
        Interrupted: The user stopped a run.
    """
    original = ScenarioFile(Path(scenario), overrides)
    if original.scenario.control is not None:
        raise InputError(
            [
                original.fault(
                    ("step",),
                    "controls the error of each step; --coupling-error measures equal steps: set one, --set step=0.01",
                )
            ]
        )
    step, steps = original.scenario.step, original.scenario.steps
    with ExitStack() as stack:
        worker = None if in_process else stack.enter_context(Worker(*MODULES))

        def system_of(length: float) -> System:
            file = ScenarioFile(Path(scenario), (*overrides, "noise=off", f"step={length!r}"))
            if nearest:
                take_nearest(file)
            return with_feedthrough(file, build_system(file), worker)

        def run(system: System, parts: int) -> Results | str:
            """Return the rows, or the reason for missing rows."""
            stepped = simulate_in(worker, system, steps * parts, step / parts, original.scenario.limits)
            if isinstance(stepped.failure, Interrupted):
                raise stepped.failure
            if stepped.failure is None and len(stepped.results.time) <= steps * parts:
                return f"the run ends early, at t = {stepped.results.time[-1]:g} s"
            return stepped.results if stepped.failure is None else str(stepped.failure)

        system = system_of(step)
        whole = run(system, 1)
        try:
            halved = run(system_of(step / 2), 2)
        except InputError as error:
            reason = "; ".join(fault.message.partition(": set ")[0] for fault in error.faults)  # a remedy for runs only
            halved = f"(halved by --coupling-error: {step / 2:g} s for {step:g} s) it cannot be run: {reason}"
        obstacle = rollback_obstacle({stage.component.name: stage.component for stage in system.stages})
        if system.beside or system.events or any(stage.every > 1 for stage in system.stages):
            obstacle = "values beside numbers, events or several rates are not taken back"
        single = obstacle or run(replace(system, halved=True), 1)
    if isinstance(whole, str):
        return CouplingError({}, whole)
    if isinstance(halved, str):
        return CouplingError({}, halved)
    rows = min(len(whole.time), (len(halved.time) + 1) // 2)  # at common communication points
    sources = dict.fromkeys(c.source for c in original.scenario.connections)
    columns = [c for name in sources for c in whole.columns if c == name or c.startswith(f"{name}[")]
    of = {c: float(np.max(np.abs(whole[c][:rows] - halved[c][: 2 * rows : 2][:rows]))) for c in columns}
    if isinstance(single, str):
        return CouplingError(of, without=single)
    largest = {name: int(np.argmax(single[name])) for name in of}
    return CouplingError(of, steps={n: (float(single[n][row]), float(single.time[row])) for n, row in largest.items()})
