"""Reading a sweep with its scenario and factors; all faults have places and precede the runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.errors import InputError, refuse
from cosim.base.messages import with_severity
from cosim.base.version import __version__
from cosim.blocks.fmu import FmuBlock
from cosim.isolation.process import Worker
from cosim.master.remote import MODULES
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import resolve_scenario
from cosim.simulation.undeclared import with_feedthrough
from cosim.storage.artefact import Checking
from cosim.storage.kinds import SWEEP, check_given
from cosim.storage.yaml_file import YamlFile, short
from cosim.sweeps.factors import Factors, resolve_file_name
from cosim.sweeps.overlaps import overlap_faults
from cosim.sweeps.run_chunks import Job, RunRequest, WatchSettings
from cosim.sweeps.sampling import Factor, columns_of
from cosim.sweeps.sweep_file import SweepFile
from cosim.system.system import System, build_system

MIN_STEPS_TO_COMPILE = 300_000  # total steps that justify a second or two; a step on arrays takes about 5 µs
MAX_DEFAULT_SIGNALS = 8  # recorded by default


@dataclass(frozen=True)
class Sweep:
    """A valid sweep: file, scenario, system, and factor values by run."""

    yaml: YamlFile
    file: SweepFile
    scenario: Scenario
    system: System
    factors: tuple[Factor, ...]
    columns: Mapping[str, list[Any]]
    job: Job
    resolved: Mapping[str, Any]
    warnings: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """Return the sweep's name, by default the scenario's."""
        return self.file.name or self.scenario.name

    @property
    def count(self) -> int:
        """Return the number of runs."""
        return len(next(iter(self.columns.values())))

    @property
    def key(self) -> str:
        """Return a hash of everything that determines the rows. Sweeps with equal keys can be continued."""
        content = [__version__, self.resolved, self.job.signals, self.job.samples, self.columns]
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()

    def request_run(self, run: int) -> RunRequest:
        """Return the request for a run."""
        overrides, starts, seed = [], dict[str, dict[str, Any]](), None
        for name, values in self.columns.items():
            value, (component, _, variable) = values[run], name.partition(".")
            if name == "seed":
                seed = int(value)
            elif component in self.scenario.components:
                starts.setdefault(component, {})[variable] = value
            else:
                overrides.append(f"{name}={json.dumps(value)}")
        return RunRequest(run, tuple(overrides), starts, seed)


def check_sweep(path: Path, checking: Checking) -> list[str]:
    """Return a sweep's warnings; InputError lists its faults."""
    return [*map(with_severity, read_sweep(path, loads=checking.worker is not None).warnings)]


def read_sweep(path: Path, *, loads: bool = False) -> Sweep:
    """Read a sweep with its scenario; raise InputError with all faults.

    Args:
        loads: Whether FMUs may be loaded, to measure undeclared dependencies with the values of the scenario.
    """
    check_given(path, SWEEP)
    yaml = YamlFile(path)
    file, faults = yaml.partly(SweepFile, "vary")
    if file is None:
        raise InputError(faults)
    scenario_path = path.parent / file.scenario
    if not scenario_path.is_file():
        raise InputError([*faults, yaml.fault(("scenario",), f"no such scenario: {short(file.scenario)}")])
    overrides = tuple(f"{name}={json.dumps(resolve_file_name(path, name, value))}" for name, value in file.set.items())
    try:
        scenario_file = ScenarioFile(scenario_path, overrides, option="")
        system = build_system(scenario_file)
    except InputError as error:
        for f in error.faults:  # Faults with places in the scenario file keep them.
            is_placed = f.line and f.file != path
            faults.append(f if is_placed else yaml.fault(("set",), f.message, exit_code=f.exit_code))
        raise InputError(faults) from None
    if loads and system.assumed:
        with Worker(*MODULES) as worker:
            system = with_feedthrough(scenario_file, system, worker)
        overrides += _measured(scenario_file.scenario)
    scenario = scenario_file.scenario
    reading = Factors(yaml, file, scenario_file, system, overrides)
    factors = [factor for name, varied in file.vary.items() if (factor := reading.factor(name, varied)) is not None]
    faults += [*reading.faults, *reading.signal_faults()]
    faults += overlap_faults(yaml, file, scenario.components)
    refuse(faults)
    columns = columns_of(factors, file.runs, file.sampling, file.seed)
    refuse(reading.drawn_faults(factors, columns))
    signals = tuple(file.signals) or _default_signals(scenario, system)
    compiled = len(next(iter(columns.values()))) * scenario.steps >= MIN_STEPS_TO_COMPILE
    watched = WatchSettings.of(system, scenario.step)
    job = Job(scenario_path.resolve(), overrides, signals, file.samples, compiled=compiled, watched=watched)
    content = resolve_defaults(resolve_scenario(scenario_file, system))
    warnings = (*scenario_file.warnings, *system.warnings, *reading.warnings)
    return Sweep(yaml, file, scenario, system, tuple(factors), columns, job, content, warnings)


def _measured(scenario: Scenario) -> tuple[str, ...]:
    """Return the measured inputs with direct feedthrough as overrides."""
    inputs = {name: getattr(component, "feedthrough", None) for name, component in scenario.components.items()}
    return tuple(f"components.{n}.feedthrough={json.dumps(each)}" for n, each in inputs.items() if each is not None)


def _default_signals(scenario: Scenario, system: System) -> tuple[str, ...]:
    """Return the signals of the criteria, else outputs of FMUs, else any signals."""
    if scenario.goals:
        return tuple(dict.fromkeys(criterion.of for _, _, criterion in scenario.goals))
    blocks = [s.component for s in system.stages if isinstance(s.component, FmuBlock)]
    outputs = tuple(f"{block.name}.{o.name}" for block in blocks for o in block.outputs)
    return (outputs or system.columns)[:MAX_DEFAULT_SIGNALS]
