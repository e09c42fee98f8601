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
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import fmi_calls
from cosim.master.remote import MODULES
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import resolve_scenario
from cosim.simulation.undeclared import with_feedthrough
from cosim.storage.artefact import Checking
from cosim.storage.kinds import SWEEP, check_given
from cosim.storage.yaml_file import YamlFile, short
from cosim.sweeps.factors import FILES, Factors, overlap_faults, resolve_file_name
from cosim.sweeps.runs import Job, RunRequest
from cosim.sweeps.sampling import Factor, columns_of
from cosim.sweeps.sweep_file import SweepFile
from cosim.system.system import System, build_system

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

    @property
    def component_files(self) -> dict[str, str]:
        """Return the file of each component by its path in the scenario, such as `components.plant.fmu`."""
        components = self.resolved["components"].items()
        return {f"components.{name}.{key}": c[key] for name, c in components for key in FILES if c.get(key)}

    @property
    def files(self) -> list[Path]:
        """Return the files of all runs, also those that vary."""
        varied = [v for name, values in self.columns.items() if name.rpartition(".")[2] in FILES for v in values]
        return [*map(Path, dict.fromkeys([*self.component_files.values(), *varied]))]

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
    scenario = scenario_file.scenario
    if loads and system.assumed:
        with Worker(*MODULES) as worker:
            system = with_feedthrough(scenario_file, system, worker)
        scenario = scenario_file.scenario  # with the measured inputs
        measured = {name: getattr(component, "feedthrough", None) for name, component in scenario.components.items()}
        overrides += tuple(
            f"components.{name}.feedthrough={json.dumps(inputs)}"
            for name, inputs in measured.items()
            if inputs is not None
        )
    reading = Factors(yaml, file, scenario_file, system, overrides)
    factors = [factor for name, varied in file.vary.items() if (factor := reading.factor(name, varied)) is not None]
    refuse([*faults, *reading.faults, *reading.signal_faults(), *overlap_faults(yaml, file, scenario.components)])
    columns = columns_of(factors, file.runs, file.sampling, file.seed)
    refuse(reading.drawn_faults(factors, columns))
    blocks = [stage.component for stage in system.stages]
    signals = file.signals or list(dict.fromkeys(criterion.of for _, _, criterion in scenario.goals))
    if not signals:
        outputs = [f"{b.name}.{o.name}" for b in blocks if isinstance(b, FmuBlock) for o in b.outputs]
        signals = (outputs or [*system.columns])[:MAX_DEFAULT_SIGNALS]
    job = Job(
        scenario_path.resolve(),
        overrides,
        tuple(signals),
        file.samples,
        len(scenario.goals),
        scenario.limits or Limits(),
        tuple(block.name for block in blocks),
        tuple(tuple(fmi_calls(getattr(block, "description", None))) for block in blocks),
        system.start,
        scenario.step,
        8 * len(system.columns),
    )
    content = resolve_defaults(resolve_scenario(scenario_file, system))
    warnings = (*scenario_file.warnings, *system.warnings, *reading.warnings)
    return Sweep(yaml, file, scenario, system, tuple(factors), columns, job, content, warnings)
