"""From a scenario to components in a common row of signals, in stepping order.

All checks that need model descriptions are made here, and all faults are reported at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from itertools import chain
from pathlib import Path
from typing import Any

from cosim.blocks.component import Component, Signal
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fixes import Fixes
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import separate
from cosim.blocks.sources import Recorded, SourceBlock
from cosim.core.errors import refuse
from cosim.files.yaml_file import did_you_mean
from cosim.fmi.sampled import sampled_by
from cosim.scenario.scenario import LoopSettings
from cosim.scenario.scenario_file import Diagnosis, Place, ScenarioFile
from cosim.system.components import build_components
from cosim.system.control import Control, control_of
from cosim.system.event_blocks import check_events
from cosim.system.events import Events, changes_of
from cosim.system.recording import RecordedPart, recorded_part
from cosim.system.schedule import Loop, Schedule, Stage, schedule
from cosim.system.wiring import Transfer, alias_transfers, connect, connection_warnings, lay_out

ROUNDING = 1e-6  # fraction of a step, the tolerance of sampled FMUs
MOST_RESULTS = 8e9  # size of results [bytes]
BYTES = 8  # size of a number [bytes]


@dataclass(frozen=True)
class System:
    """A system ready for the master.

    Attributes:
        stages: Stages in stepping order.
        held: Transfers at the end of a step; their targets use values from the start of the step.
        beside: Columns stored outside the row of doubles, for values without exact double.
        events: Communication point → component → values to set.
        apart: Names of components with their own process.
        halved: Whether rows hold the differences made by halving each step, instead of signals.
        control: Control of the communication steps, None for equal ones.
        courses: Degrees of the courses of extrapolated and of interpolated inputs during a step.
        clock_wires: Connected clocks, output and input, as `component.clock`.
        loops: Algebraic loops to solve at each communication point.
        solving: Settings of their solution, None for the default.
        pace: Simulated seconds per second, set by runs that keep to the clock; None for as fast as possible.
        recording: Recorded part of the rows, None for all of them.
        opened: As in `Schedule`; `assumed` too.
    """

    stages: tuple[Stage, ...]
    held: tuple[Transfer, ...]
    columns: tuple[str, ...]
    units: Mapping[str, str]
    seed: int = 0
    start: float = 0.0
    warnings: tuple[str, ...] = ()
    fmus: Mapping[str, tuple[Path, Any]] = field(default_factory=dict)
    beside: tuple[str, ...] = ()
    signals: Mapping[str, Signal] = field(default_factory=dict)
    events: Events = field(default_factory=dict)
    apart: frozenset[str] = frozenset()
    halved: bool = False
    clock_wires: tuple[tuple[str, str], ...] = ()
    control: Control | None = None
    courses: tuple[int, int] = (0, 0)
    loops: tuple[Loop, ...] = ()
    solving: LoopSettings | None = None
    pace: float | None = None
    recording: RecordedPart | None = None
    opened: tuple[Loop, ...] = ()
    assumed: bool = False
    known: frozenset[str] = frozenset()

    @property
    def names(self) -> list[str]:
        """Return the names of the components in stepping order."""
        return [stage.component.name for stage in self.stages]

    @property
    def reruns(self) -> bool:
        """Return whether a resumed run repeats all steps."""
        has_events = any(isinstance(stage.component, EventFmu) for stage in self.stages)
        return has_events or bool(self.loops) or self.control is not None or any(self.courses)

    @property
    def texts(self) -> frozenset[str]:
        """Return the names of text and binary columns."""
        return frozenset(column for column in self.beside if self.signals[column].kind in {"String", "Binary"})

    @property
    def discrete(self) -> frozenset[str]:
        """Return the columns whose values hold until they change, in place of going on between two rows."""
        names = set[str]()
        for stage in self.stages:
            component, signals = stage.component, [s for s in stage.component.outputs if s.discrete or s.is_whole]
            if isinstance(component, SourceBlock):
                pairs = zip(component.outputs, component.functions, strict=True)
                signals = [s for s, f in pairs if isinstance(f, Recorded) and not f.is_linear]
            elif stage.every > 1 or isinstance(component, Fixes):
                signals = [*component.inputs, *component.outputs]
            elif isinstance(component, FmuBlock) and sampled_by(component.path) is not None:
                signals = [*component.outputs]
            names |= {f"{component.name}.{s.name}" for s in signals}
        transfers = (*self.held, *chain.from_iterable((*stage.pulls, *stage.late) for stage in self.stages))
        return frozenset(names | {transfer.name for transfer in transfers if transfer.origin in names})

    @property
    def recorded(self) -> frozenset[str]:
        """Return the names of all recorded signals."""
        if (part := self.recording) is None:
            return frozenset((*self.columns, *self.beside))
        return frozenset((*(self.columns[k] for k in part.columns), *(self.beside[k] for k in part.beside)))


def build_system(file: ScenarioFile) -> System:
    """Return the system of a scenario; raise InputError with every fault."""
    scenario, diagnosis = file.scenario, Diagnosis(file)
    components = build_components(file, diagnosis)
    is_whole = len(components) == len(scenario.components) and not file.broken
    layout = lay_out(components)
    transfers = connect(file, components, layout, diagnosis)
    of_aliases = alias_transfers(components, layout, transfers, diagnosis)
    signals = sum(len(c.inputs) + len(c.outputs) for c in components.values())
    rows = scenario.duration / scenario.step + 1.0
    if (size := rows * signals * BYTES) > MOST_RESULTS:
        message = (
            f"leaves {rows:.3g} rows of {signals} signals, {size / 1e9:.3g} GB, more than {MOST_RESULTS / 1e9:g} GB; "
            "run shorter or in longer steps"
        )
        diagnosis.note(("duration",), message)
    _check_sampling(components.values(), diagnosis)
    recording = recorded_part(scenario, components, layout, diagnosis)
    if is_whole:
        recorded = layout.columns if recording is None else {layout.columns[k] for k in recording.columns}
        for kind, k, criterion in scenario.goals:
            where: Place = ("criteria", kind, *(() if k is None else (k,)))
            for key, signal in (("of", criterion.of), ("to", criterion.to)):
                if not isinstance(signal, str) or signal in recorded:
                    continue
                message = f"{signal} is not recorded, and the criterion needs it; add it to record: signals"
                if signal not in layout.columns:
                    message = f'no signal "{signal}"{did_you_mean(signal, layout.columns)}'
                diagnosis.note((*where, key), message)
    is_connected = is_whole and all(transfers)
    has_events = any(isinstance(component, EventFmu) for component in components.values())
    courses = (0, 0) if has_events else scenario.courses  # With event mode, inputs are held.
    plan = schedule(scenario, components, transfers, diagnosis, courses[1] > 0) if is_connected else Schedule()
    blocks = {name: c for name, c in components.items() if isinstance(c, FmuBlock)}
    separated, notes = separate([(name, block.path) for name, block in blocks.items()], scenario.isolated)
    check_events(plan, scenario.isolated | separated, diagnosis, scenario.targets)
    control = control_of(scenario, components, layout, list(chain.from_iterable(transfers)), diagnosis)
    events = changes_of(file, blocks, diagnosis)
    _check_record(file, components, diagnosis)
    refuse(diagnosis.faults)
    of_blocks = chain.from_iterable(block.warnings for block in blocks.values())
    warnings = *diagnosis.warnings, *connection_warnings(file, components), *of_blocks, *notes
    return System(
        plan.stages,
        (*plan.held, *of_aliases),
        layout.columns,
        layout.units,
        scenario.seed,
        scenario.start_time,
        warnings,
        {name: (block.path, block.description) for name, block in blocks.items()},
        layout.beside,
        layout.signals,
        events,
        scenario.isolated | separated,
        clock_wires=plan.clock_wires,
        loops=plan.loops,
        solving=scenario.loops,
        control=control,
        courses=courses,
        recording=recording,
        opened=plan.opened,
        assumed=plan.assumed,
        known=plan.known,
    )


def _check_record(file: ScenarioFile, components: Mapping[str, Component], diagnosis: Diagnosis) -> None:
    """Note a fault for each pattern of `record` without component, and a warning for patterns without variable."""
    record = file.scenario.record
    for k, pattern in enumerate(record if isinstance(record, list) else ()):
        name = pattern.partition(".")[0]
        component = components.get(name)
        if "*" not in name and name not in file.scenario.components:
            hint = did_you_mean(name, file.scenario.components)
            diagnosis.note(("record", k), f'no component "{name}"{hint}; write component.* or component.variable')
        elif isinstance(component, FmuBlock) and not component.names_any(pattern):
            hint = did_you_mean(pattern, [f"{name}.{v.name}" for v in component.description.modelVariables])
            diagnosis.note(("record", k), f'no variable "{pattern}"{hint}')
    for name, component in components.items():
        if not (component.inputs or component.outputs or component.exact_inputs or component.exact_outputs):
            diagnosis.warnings.append(
                f"{name} has no inputs and outputs, so nothing of it is recorded; record: [{name}.*] does so"
            )


def _check_sampling(components: Iterable[Any], diagnosis: Diagnosis) -> None:
    file, scenario = diagnosis.file, diagnosis.file.scenario
    place = file.fault(("step",), "")
    if file.stands_in or any((f.line, f.column) == (place.line, place.column) for f in file.faults):
        return  # The step is faulty itself.
    parameter_of = cache(sampled_by)  # Several components may use the same FMU.
    for block in components:
        parameter = parameter_of(block.path) if isinstance(block, FmuBlock) else None
        if parameter is None:
            continue
        declared = next((v.start for v in block.description.modelVariables if v.name == parameter), None)
        try:
            sample = float(block.start_values.get(parameter, declared))
        except (TypeError, ValueError):
            continue
        own_step = getattr(scenario.components[block.name], "step", None)
        step = scenario.step if own_step is None else float(own_step)
        if abs(step - sample) > ROUNDING * sample:
            where = ("step",) if own_step is None else ("components", block.name, "step")
            message = (
                f"step is {step:g} s; {block.name} is sampled at {sample:g} s ({parameter}): set "
                f"components.{block.name}.start.{parameter}, or step: {sample:g}"
            )
            diagnosis.note(where, message)
