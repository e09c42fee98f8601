"""Plan of a scenario whose order depends on undeclared dependencies: these are measured before the run."""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, InputError, Interrupted, Signalled
from cosim.base.messages import Template
from cosim.coupling.messages import ASSUMED_WITHOUT_FEEDTHROUGH
from cosim.isolation.process import Worker
from cosim.master.feedthrough import Pair, measure_feedthrough
from cosim.master.remote import simulate_apart, simulate_here
from cosim.scenario.scenario import Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.simulation import messages
from cosim.system.components import Designed
from cosim.system.schedule import Loop
from cosim.system.system import System, build_system

NAMED = 6  # signals of a message
UNDECLARED_CODES = frozenset(
    template.code for template in (messages.LOOP_MEASURED, messages.LOOP_LEFT_OPEN, messages.FOLLOWS_AT_START)
)


def with_feedthrough(file: ScenarioFile, designed: Designed, system: System, worker: Worker | None) -> System:
    """Return the system, planned by measured feedthrough where its order had to assume that there is none.

    The scenario of the file gets the measured inputs as `feedthrough`. A loop is solved if its first step succeeds.

    Args:
        worker: Process for the FMUs; None for this one.
    """
    scenario = file.scenario
    if not system.suspected:
        return system
    try:
        measured = measure_feedthrough(system, scenario.step, worker, scenario.limits)
    except (Interrupted, Signalled):
        raise
    except CosimError:  # The run names the failure, if it meets it too.
        return system
    members = [name for loop in system.suspected for name in loop.members]
    inputs = {name: _undeclared(system, name) for name in members}
    known = [name for name in members if inputs[name] <= measured.inputs]
    known = [name for name in known if not any(_owner(pair[1]) == name for pair in measured.at_start)]
    plain = _without_assumption(system, known)
    plain = _with_warnings(plain, _of_loops(messages.FOLLOWS_AT_START, system.suspected, measured.at_start))
    followed = {n: sorted({i.partition(".")[2] for _, i in measured.pairs if _owner(i) == n}) for n in members}
    declared = {name: followed[name] for name in members if inputs[name] and (name in known or followed[name])}
    file.scenario = _with_declared(scenario, declared)
    if not measured.pairs:
        return plain
    planned_loops: Sequence[Loop] = ()
    try:
        planned = build_system(file, designed)
        planned_loops = planned.loops
        failure = _first_step(file.scenario, planned, worker) if planned.loops else None
    except InputError as error:
        failure = error.faults[0].message
    if failure is None:
        planned = _with_warnings(_without_assumption(planned, known), plain.warnings[len(system.warnings) :])
        return _with_warnings(planned, _of_loops(messages.LOOP_MEASURED, planned.loops, measured.pairs))
    file.scenario = scenario
    return _with_warnings(
        plain, _of_loops(messages.LOOP_LEFT_OPEN, planned_loops or system.suspected, measured.pairs, reason=failure)
    )


def _first_step(scenario: Scenario, system: System, worker: Worker | None) -> str | None:
    """Return why the first step of a system with loops fails, None if it succeeds."""
    if worker is None:
        failure = simulate_here(system, 1, scenario.step).failure
    else:
        place = Path(tempfile.gettempdir())
        failure = simulate_apart(worker, system, 1, scenario.step, place, scenario.limits).failure
    if isinstance(failure, (Interrupted, Signalled)):
        raise failure
    return None if failure is None else str(failure)


def _undeclared(system: System, name: str) -> set[str]:
    """Return the inputs of a component in suspected loops that have no declared dependencies."""
    component = next(stage.component for stage in system.stages if stage.component.name == name)
    inputs = {t.name for loop in system.suspected for t in loop.transfers if _owner(t.name) == name}
    return {i for i in inputs if component.depends_on(i.partition(".")[2]) is None}


def _owner(signal: str) -> str:
    return signal.partition(".")[0]


def _with_declared(scenario: Scenario, declared: Mapping[str, Sequence[str]]) -> Scenario:
    """Return a scenario with the measured inputs of its components."""
    components: dict[str, Any] = dict(scenario.components)
    for name, inputs in declared.items():
        components[name] = components[name].model_copy(update={"feedthrough": list(inputs)})
    return scenario.model_copy(update={"components": components})


def _without_assumption(system: System, names: Sequence[str]) -> System:
    """Return a system without the warning that components were assumed to have no direct feedthrough."""
    known = {ASSUMED_WITHOUT_FEEDTHROUGH(component=name) for name in names}
    return replace(system, suspected=(), warnings=tuple(w for w in system.warnings if w not in known))


def _with_warnings(system: System, warnings: Sequence[str]) -> System:
    return replace(system, warnings=(*system.warnings, *warnings))


def _of_loops(template: Template, loops: Sequence[Loop], pairs: Sequence[Pair], **fields: str) -> list[str]:
    """Return a message for each loop with its outputs that follow inputs."""
    own = {loop.name: [pair for pair in pairs if _owner(pair[1]) in loop.members] for loop in loops}
    return [template(loop=name, facts=_facts(some), **fields) for name, some in own.items() if some]


def _facts(pairs: Sequence[Pair]) -> str:
    """Return pairs in words, such as `b.y follows b.u`, at most six of them."""
    more = f" and {len(pairs) - NAMED} more" if len(pairs) > NAMED else ""
    return ", ".join(f"{output} follows {entry}" for output, entry in pairs[:NAMED]) + more
