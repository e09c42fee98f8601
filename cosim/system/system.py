"""Construction of a system from a scenario: components in stepping order, and one row for all signals.

All checks that need model descriptions are made here, and all faults are reported at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from itertools import chain
from pathlib import Path
from typing import Any

from cosim.blocks.component import Signal
from cosim.blocks.coupling import sort_groups
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fixes import Fixes
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import separate
from cosim.blocks.sources import Recorded, SourceBlock
from cosim.core.errors import refuse
from cosim.core.messages import Note
from cosim.core.text import DisplayUnits, did_you_mean
from cosim.core.units import alternatives, conversion
from cosim.credibility.found import Found, read_credibility
from cosim.fmi.annotations import sampled_by
from cosim.fmi.description import display_units
from cosim.scenario.scenario import LoopSettings
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.components import build_components
from cosim.system.control import Control, control_of
from cosim.system.events import Events, changes_of, check_events
from cosim.system.recording import RecordedPart, recorded_part
from cosim.system.schedule import Schedule, Stage, schedule
from cosim.system.wiring import Building, Transfer, alias_transfers, connect, connection_warnings

SAMPLE_STEP_TOLERANCE = 1e-6  # tolerance of the step of sampled FMUs, as a fraction of a step
MOST_RESULTS = 8e9  # size of results [bytes]
BYTES_PER_NUMBER = 8  # size of a number [bytes]


@dataclass(frozen=True)
class System(Schedule):
    """A system ready for the master: its schedule and the layout of its rows.

    Attributes:
        beside: Columns stored outside the row of doubles, for values that doubles cannot represent exactly.
        events: Communication point → component → values to set.
        apart: Names of components with a process of their own.
        control: Settings of error-controlled steps; None for equal steps.
        courses: Polynomial degrees of extrapolated and of interpolated inputs during a step.
        solving: Settings for the solution of algebraic loops; None for the default.
        pace: Simulated seconds per second of a paced run; None for as fast as possible.
        recording: Recorded part of the rows, None for all of them.
        display: Unit → name of its display unit, factor and offset to its values.
    """

    columns: tuple[str, ...] = ()
    units: Mapping[str, str] = field(default_factory=dict)
    seed: int = 0
    start: float = 0.0
    warnings: tuple[str, ...] = ()
    fmus: Mapping[str, tuple[Path, Any]] = field(default_factory=dict)
    beside: tuple[str, ...] = ()
    signals: Mapping[str, Signal] = field(default_factory=dict)
    events: Events = field(default_factory=dict)
    apart: frozenset[str] = frozenset()
    control: Control | None = None
    courses: tuple[int, int] = (0, 0)
    solving: LoopSettings | None = None
    pace: float | None = None
    recording: RecordedPart | None = None
    display: DisplayUnits = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Return the names of the components in stepping order."""
        return [stage.component.name for stage in self.stages]

    def is_real(self, transfer: Transfer) -> bool:
        """Return True if a transfer has continuous values, unlike integers and text."""
        return not (any(transfer.beside) or self.signals[transfer.name].is_whole)

    @cached_property
    def held_of(self) -> dict[str, list[Transfer]]:
        """Return component → transfers to the component at the end of a step."""
        by_name: dict[str, list[Transfer]] = {name: [] for name in self.names}
        for transfer in self.held:
            by_name[transfer.name.partition(".")[0]].append(transfer)
        return by_name

    def extrapolated(self, component: str) -> list[Transfer]:
        """Return the transfers to inputs of a component that are extrapolated during a step."""
        held = self.held_of[component] if self.courses[0] else ()
        return [t for t in held if self.is_real(t) and t.origin.partition(".")[0] not in self.known]

    @cached_property
    def closing(self) -> tuple[Stage, ...]:
        """Return stages whose outputs are read again, without a step, at the end of a step.

        Their components have direct feedthrough from extrapolated inputs. Sources are before their targets.
        """
        solved = {name for loop in self.loops for name in loop.members}
        stages, ends = dict[str, Stage](), list[tuple[str, str]]()
        for stage in self.stages:
            name, component = stage.component.name, stage.component
            direct = [t for t in self.extrapolated(name) if component.depends_on(t.name.partition(".")[2]) is not False]
            if direct and name not in solved:
                stages[name] = replace(stage, pulls=tuple(self.held_of[name]), late=())
                ends += [(t.origin.partition(".")[0], name) for t in direct]
        ordered = sort_groups([*stages], [end for end in ends if end[0] in stages]) if stages else []
        return tuple(stages[name] for group in ordered for name in group)

    @property
    def reruns(self) -> bool:
        """Return True if a resumed run must repeat all steps, because the step policy has a memory."""
        has_events = any(isinstance(stage.component, EventFmu) for stage in self.stages)
        return has_events or bool(self.loops) or self.control is not None or any(self.courses)

    @property
    def texts(self) -> frozenset[str]:
        """Return the names of text and binary columns."""
        return frozenset(column for column in self.beside if self.signals[column].kind in {"String", "Binary"})

    @property
    def discrete(self) -> frozenset[str]:
        """Return the columns whose values are constant until they change, so they are not interpolated."""
        names = set[str]()
        for stage in self.stages:
            component, signals = stage.component, [s for s in stage.component.outputs if s.discrete or s.is_whole]
            if isinstance(component, SourceBlock):
                pairs = zip(component.outputs, component.functions, strict=True)
                signals = [s for s, f in pairs if isinstance(f, Recorded) and not f.is_linear]
            elif stage.every > 1 or isinstance(component, Fixes):
                signals = [*component.inputs, *component.outputs]
            elif isinstance(component, FmuBlock) and component.is_sampled:
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
    building, scenario = Building(file), file.scenario
    build_components(building)
    building.lay_out()
    components, blocks = building.components, building.blocks
    is_whole = len(components) == len(scenario.components) and not file.broken
    transfers = connect(building)
    of_aliases = alias_transfers(building, transfers)
    signals = sum(len(c.inputs) + len(c.outputs) for c in components.values())
    rows = scenario.duration / scenario.step + 1.0
    if (size := rows * signals * BYTES_PER_NUMBER) > MOST_RESULTS:
        message = (
            f"would write {rows:.3g} rows of {signals} signals, {size / 1e9:.3g} GB, more than {MOST_RESULTS / 1e9:g} "
            "GB; use a shorter duration or longer steps"
        )
        building.note(("duration",), message)
    _check_sampling(building)
    recording = recorded_part(building)
    if is_whole:
        recorded = building.columns if recording is None else {building.columns[k] for k in recording.columns}
        for _, where, criterion in scenario.goals:
            for key, signal in (("of", criterion.of), ("to", criterion.to)):
                if not isinstance(signal, str) or signal in recorded:
                    continue
                message = f"{signal} is not recorded, but a criterion needs it; add it to record: signals"
                if signal not in building.columns:
                    message = f'no signal "{signal}"{did_you_mean(signal, building.columns)}'
                building.note((*where, key), message)
    for _, where, goal in scenario.valid_goals:
        found = read_credibility(blocks[goal.of].path) if goal.of in blocks else Found(None)
        if found.record is None and (goal.of in components or goal.of not in scenario.components):
            reason = found.problem or "no FMU with a record of credibility"
            hint = "" if goal.of in scenario.components else did_you_mean(goal.of, blocks)
            cure = f"name an FMU of `cosim refine` or `cosim fit`{hint}"
            building.note((*where, "of"), f"{goal.of}: {reason}; {cure}")
    is_connected = is_whole and all(transfers)
    has_events = any(isinstance(component, EventFmu) for component in components.values())
    courses = (0, 0) if has_events else scenario.courses  # with event mode, inputs are constant during a step
    plan = schedule(building, transfers, courses[1] > 0) if is_connected else Schedule()
    separated, notes = separate([(name, block.path) for name, block in blocks.items()], scenario.isolated)
    check_events(building, plan, scenario.isolated | separated)
    control = control_of(building, list(chain.from_iterable(transfers)))
    events = changes_of(building)
    display = dict[str, Any](display_units(block.description for block in blocks.values()))
    definitions = {signal.unit: signal.definition for signal in building.signals.values() if signal.definition}
    for unit, name in scenario.display.items():
        if not name or (shown := conversion(unit, name, definitions=definitions)) is None:
            message = f"the display unit {name} of {unit} is unknown or has another dimension"
            building.note(("display", unit), f"{message}; give one of {', '.join(alternatives(unit))}")
        else:
            display[unit] = (name, *shown)
    for name, component in components.items():
        if not (component.inputs or component.outputs or component.exact_inputs or component.exact_outputs):
            cure = f"add record: [{name}.*]"
            building.warnings.append(f"{name} has no inputs and outputs, so nothing of it is recorded; {cure}")
    refuse(building.faults)
    of_blocks = chain.from_iterable(block.warnings for block in blocks.values())
    assumed = chain.from_iterable(map(Note, c.assumed) for c in components.values() if isinstance(c, SourceBlock))
    warnings = *building.warnings, *connection_warnings(building), *of_blocks, *notes, *assumed
    scheduled = {**vars(plan), "held": (*plan.held, *of_aliases)}
    return System(
        **scheduled,
        columns=building.columns,
        units={column: building.signals[column].unit for column in building.columns},
        seed=scenario.seed,
        start=scenario.start_time,
        warnings=warnings,
        fmus={name: (block.path, block.description) for name, block in blocks.items()},
        beside=building.beside,
        signals=building.signals,
        events=events,
        apart=scenario.isolated | separated,
        solving=scenario.loops,
        control=control,
        courses=courses,
        recording=recording,
        display=display,
    )


def _check_sampling(building: Building) -> None:
    file, scenario = building.file, building.scenario
    place = file.fault(("step",), "")
    if file.stands_in or any((f.line, f.column) == (place.line, place.column) for f in file.faults):
        return  # the step itself is faulty
    parameter_of = cache(sampled_by)  # several components may use the same FMU
    for name, block in building.blocks.items():
        if (parameter := parameter_of(block.path)) is None:
            continue
        declared = next((v.start for v in block.description.modelVariables if v.name == parameter), None)
        try:
            sample = float(block.start_values.get(parameter, declared))
        except (TypeError, ValueError):
            continue
        own_step = getattr(scenario.components[name], "step", None)
        step = scenario.step if own_step is None else float(own_step)
        if abs(step - sample) > SAMPLE_STEP_TOLERANCE * sample:
            where = ("step",) if own_step is None else ("components", name, "step")
            building.note(
                where,
                f"step is {step:g} s, but {name} is sampled at {sample:g} s (parameter {parameter}); these must be "
                f"equal: set components.{name}.start.{parameter} to {step:g}, or step to {sample:g}",
            )
