"""Reading a sweep with its scenario and factors; all faults have places and precede the runs."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.version import __version__
from cosim.blocks.fmu import FmuBlock
from cosim.scenario.controller_design import designed_values
from cosim.scenario.scenario import Scenario, resolved
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import resolve_scenario
from cosim.storage.artefact import Checking
from cosim.storage.kinds import SWEEP, check_given
from cosim.storage.yaml_file import YamlFile, short
from cosim.sweeps.factors import Factors, Location, beside
from cosim.sweeps.overlaps import overlap_faults
from cosim.sweeps.run_chunks import Asked, Job, Watched
from cosim.sweeps.sampling import Factor, columns_of
from cosim.sweeps.sweep_file import SweepFile
from cosim.system.system import System, build_system

WORTH_COMPILING = 300_000  # total steps that justify a second or two of compilation; a step on arrays takes about 5 µs
MOST_SIGNALS = 8  # recorded by default


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
        """Return the name of the sweep, by default the scenario's."""
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

    def request_run(self, run: int) -> Asked:
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
        return Asked(run, tuple(overrides), starts, seed)


def check_sweep(path: Path, checking: Checking) -> list[str]:
    """Return the warnings of a sweep; InputError lists its faults."""
    return [f"warning: {text}" for text in read_sweep(path).warnings]


def read_sweep(path: Path) -> Sweep:
    """Read a sweep with its scenario; raise InputError with all faults."""
    check_given(path, SWEEP)
    yaml = YamlFile(path)
    file, faults = yaml.partly(SweepFile, "vary")
    if file is None:
        raise InputError(faults)
    scenario_path = path.parent / file.scenario
    if not scenario_path.is_file():
        raise InputError([*faults, yaml.fault(("scenario",), f"no such scenario: {short(file.scenario)}")])
    overrides = tuple(f"{name}={json.dumps(beside(path, name, value))}" for name, value in file.set.items())
    try:
        scenario = ScenarioFile(scenario_path, overrides, option="")
    except InputError as error:
        raise InputError([*faults, *_moved(yaml, ("set",), error, scenario_path)]) from None
    try:
        designed = designed_values(scenario)
        system = build_system(scenario, designed)
    except InputError as error:
        raise InputError([*faults, *_moved(yaml, ("set",), error, scenario_path)]) from None
    reading = Factors(yaml, file, scenario, system, overrides)
    factors = [factor for name, varied in file.vary.items() if (factor := reading.factor(name, varied)) is not None]
    design = scenario.scenario.design
    designed_for = None if design is None else design.component
    faults += [*reading.faults, *reading.signal_faults()]
    faults += overlap_faults(yaml, file, scenario.scenario.components, designed_for)
    refuse(faults)
    columns = columns_of(factors, file.runs, file.sampling, file.seed)
    refuse(list(reading.drawn_faults(factors, columns)))
    signals = tuple(file.signals) or _signals(scenario.scenario, system)
    compiled = len(next(iter(columns.values()))) * scenario.scenario.steps >= WORTH_COMPILING
    watched = Watched.of(system, scenario.scenario.step)
    job = Job(scenario_path.resolve(), overrides, signals, file.samples, compiled=compiled, watched=watched)
    made_of = resolved(resolve_scenario(scenario, designed, system))
    warnings = (*scenario.warnings, *system.warnings, *reading.warnings)
    return Sweep(yaml, file, scenario.scenario, system, tuple(factors), columns, job, made_of, warnings)


def _moved(yaml: YamlFile, where: Location, error: InputError, scenario: Path) -> list[Fault]:
    """Return faults with places of `set` and `vary` in the sweep. Faults with places in the scenario file keep them."""
    return [
        f if f.line and f.file != yaml.path else yaml.fault(where, f.message, exit_code=f.exit_code)
        for f in error.faults
    ]


def _signals(scenario: Scenario, system: System) -> tuple[str, ...]:
    of_criteria = dict.fromkeys(criterion.of for _, _, criterion in scenario.goals)
    outputs = [
        f"{s.component.name}.{o.name}"
        for s in system.stages
        for o in s.component.outputs
        if isinstance(s.component, FmuBlock)
    ]
    return tuple(of_criteria) or tuple(outputs[:MOST_SIGNALS]) or tuple(system.columns[:MOST_SIGNALS])
