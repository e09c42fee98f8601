"""Reading of a sweep with its scenario and factors, reporting all faults before the first run; results of a sweep."""

from __future__ import annotations

import hashlib
import json
import os
import shlex
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cosim.blocks.fmu import FmuBlock
from cosim.core.errors import InputError, refuse
from cosim.core.messages import with_severity
from cosim.core.text import counted, percent, plain
from cosim.core.version import __version__
from cosim.files.artefact import SWEEP, Checking
from cosim.files.kinds import check_given
from cosim.files.yaml_file import YamlFile, short
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.beforehand import with_feedthrough
from cosim.master.remote import RUN_MODULES
from cosim.scenario.scenario import Scenario, resolve_defaults
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation.manifest import resolve_scenario
from cosim.sweeps.factors import FACTOR_FILE_KEYS, Factors, resolve_file_name
from cosim.sweeps.runs import Job, RunRequest, time_reached
from cosim.sweeps.sampling import Factor, columns_of
from cosim.sweeps.store import Runs
from cosim.sweeps.sweep_file import SweepFile
from cosim.system.system import System, build_system

MAX_DEFAULT_SIGNALS = 8  # signals recorded by default


@dataclass(frozen=True)
class Sweep:
    """A valid sweep: file, scenario, system, and factor values by run.

    Attributes:
        name: Name of the sweep, by default that of the scenario.
        count: Number of runs.
        key: Hash of everything that determines the rows. A sweep is resumed only with the same key.
        component_files: Path in the scenario, such as `components.plant.fmu` → file of the component.
        files: Files of all runs, including files that vary.
    """

    yaml: YamlFile
    file: SweepFile
    scenario: Scenario
    system: System
    factors: tuple[Factor, ...]
    columns: Mapping[str, list[Any]]
    job: Job
    resolved: Mapping[str, Any]
    warnings: tuple[str, ...]
    name: str
    count: int
    key: str
    component_files: Mapping[str, str]
    files: Sequence[Path]

    def request_run(self, run: int) -> RunRequest:
        """Return the request for a run by its number."""
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
    """Return the warnings of a sweep; raise InputError with all faults."""
    return [*map(with_severity, read_sweep(path, loads=checking.worker is not None).warnings)]


def read_sweep(path: Path, *, loads: bool = False) -> Sweep:
    """Read a sweep with its scenario; raise InputError with all faults.

    Args:
        loads: Allow loading FMUs, to measure undeclared dependencies with the values of the scenario.
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
        for f in error.faults:  # faults with places in the scenario file keep these places
            is_placed = f.line and f.file != path
            faults.append(f if is_placed else yaml.fault(("set",), f.message, exit_code=f.exit_code))
        raise InputError(faults) from None
    scenario = scenario_file.scenario
    if loads and system.assumed:
        with Worker(*RUN_MODULES) as worker:
            system = with_feedthrough(scenario_file, system, worker)
        scenario = scenario_file.scenario  # includes the measured inputs
        measured = {name: getattr(component, "feedthrough", None) for name, component in scenario.components.items()}
        overrides += tuple(
            f"components.{name}.feedthrough={json.dumps(inputs)}"
            for name, inputs in measured.items()
            if inputs is not None
        )
    reading = Factors(yaml, file, scenario_file, system, overrides)
    columns = columns_of(reading.factors, file.runs, file.sampling, file.seed)
    reading.check_values(columns)
    refuse([*faults, *reading.faults])
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
        len(scenario.every_goal),
        Watch(
            [block.name for block in blocks],
            [fmi_calls(getattr(block, "description", None)) for block in blocks],
            partial(time_reached, system.start, scenario.step),
            scenario.limits or Limits(),
            8 * len(system.columns),
        ),
    )
    resolved = resolve_defaults(resolve_scenario(scenario_file, system))
    content = [__version__, resolved, job.signals, job.samples, columns]
    component_files = {
        f"components.{name}.{key}": component[key]
        for name, component in resolved["components"].items()
        for key in FACTOR_FILE_KEYS
        if component.get(key)
    }
    varied = [v for name, values in columns.items() if name.rpartition(".")[2] in FACTOR_FILE_KEYS for v in values]
    return Sweep(
        yaml,
        file,
        scenario,
        system,
        tuple(reading.factors),
        columns,
        job,
        resolved,
        (*scenario_file.warnings, *system.warnings, *reading.warnings),
        name=file.name or scenario.name,
        count=len(next(iter(columns.values()))),
        key=hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest(),
        component_files=component_files,
        files=[*map(Path, dict.fromkeys([*component_files.values(), *varied]))],
    )


@dataclass(frozen=True, repr=False)
class Swept(Runs):
    """Result of a sweep. For a part of a sweep, `record` describes the runs of the part, and has the key `part`.

    Attributes:
        made: Number of runs that this call executed.
    """

    sweep: Sweep
    made: int

    @property
    def sentences(self) -> list[str]:
        """Return the results as sentences, one per line."""
        r = self.record
        rate = f", {r['runs_a_second']:.3g} runs a second" if r["runs_a_second"] else ""
        lines = [self.headline, f"{r['runs'] - r['failed']} of {counted(r['runs'], 'run')} completed{rate}"]
        for c in r["criteria"]:
            low, high = (plain(100.0 * end, 3) for end in c["ci95"])
            share = f"{plain(100.0 * c['met'] / c['of'], 3)} %, 95 % interval {low} … {high} %" if c["of"] else "no run"
            lines.append(f"{c['name']}: met by {c['met']} of {c['of']} ({share})")
        for name, shares in r.get("valid", {}).items():
            least, most = (percent(share) for share in shares)
            lines.append(f"{name}: within the region of the logs of its FMU for {least} … {most} of the time of a run")
        return lines

    def __repr__(self) -> str:
        return "\n  ".join(self.sentences)


def repeat_command(study: Sweep, run: int) -> str:
    """Return the command that repeats a single run of a sweep."""
    return shlex.join(["cosim", "run", str(study.yaml.path), "--case", str(run)])


def case_of(path: Path, number: int) -> tuple[Path, list[str], int | None]:
    """Return scenario, settings `path=value` and seed of a run of a sweep; raise InputError if there is no such run."""
    study = read_sweep(path)
    if not 0 <= number < study.count:
        raise InputError.at(Path("--case"), f"is {number}; {path.name} has the cases 0 … {study.count - 1}")
    request = study.request_run(number)
    starts = [
        f"components.{component}.start.{name}={json.dumps(value)}"
        for component, values in request.starts.items()
        for name, value in values.items()
    ]
    scenario = Path(os.path.normpath(path.parent / study.file.scenario))
    return scenario, [*study.job.overrides, *request.overrides, *starts], request.seed
