"""Plan of a scenario whose order depends on undeclared dependencies: these are measured before the run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from threading import Timer
from typing import Any

from cosim.blocks.compiling import LIMIT, permission
from cosim.blocks.coupling import Assumption
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.core.errors import CosimError, InputError, Interrupted, Signalled, TimedOut
from cosim.core.messages import CheckWarning, Note
from cosim.core.text import join_names
from cosim.isolation.limits import LOADING, Limits
from cosim.isolation.process import Worker
from cosim.master.beforehand import Feedthrough, Pair, examine, measure_feedthrough, undeclared_inputs
from cosim.master.remote import simulate_in
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.schedule import Loop
from cosim.system.system import System, build_system

NAMED = 6  # signals of a message
LONGEST = 20.0  # [s] of measurement and first step together, without loading; less with a shorter `limits: total`
LEAST = 0.1  # [s] that is left for the first step
SILENT = 2.0  # [s] before a note tells of the measurement


def with_feedthrough(
    file: ScenarioFile,
    system: System,
    worker: Worker | None,
    tell: Callable[[str], None] = lambda text: None,
) -> System:
    """Return the system, planned by measured feedthrough where its order had to assume that there is none.

    The scenario of the file gets the measured inputs as `feedthrough`. A loop is solved if its first step succeeds;
    otherwise it is left open, with a warning of the measured facts.

    Args:
        worker: Process for the FMUs; None for this one.
        tell: Function that shows a note if it takes long.
    """
    undeclared = undeclared_inputs(system) if system.assumed else {}
    planned, opened = system, list[Loop]()
    if undeclared:
        given = file.scenario.limits or Limits()
        total = min(given.total or LONGEST, LONGEST)
        load = given.load or LOADING + (LIMIT if permission.get() else 0.0)
        limits, spent = given.model_copy(update={"total": max(total, LEAST), "load": load}), [0.0]
        note = Note(
            f"measuring which outputs of {join_names([*undeclared])} follow their inputs at once, which these FMUs "
            f"do not declare: at most {limits.total:g} s"
        )
        timer = Timer(SILENT, tell, (note,))
        timer.daemon = True
        timer.start()
        try:
            try:
                measured = examine(measure_feedthrough, system, (1, file.scenario.step), worker, limits, spent=spent)
            except (Interrupted, Signalled):
                raise
            except CosimError as error:
                reason = str(error)
                if isinstance(error, TimedOut) and spent[0] > (limits.total or LONGEST):
                    reason = Note(f"it takes longer than {limits.total:g} s in all, at last in {error.component}")
                measured = Feedthrough(failure=f": {reason}")
            followed = {n: sorted({i for _, i in measured.pairs if i in inputs}) for n, inputs in undeclared.items()}
            known = measured.inputs - {entry for _, entry in measured.at_start}
            declared = {  # where all inputs are known or some of them followed
                n: [i.partition(".")[2] for i in followed[n]]
                for n, inputs in undeclared.items()
                if followed[n] or inputs <= known
            }
            failure = ""
            if declared:
                first_step = limits.model_copy(update={"total": max(total - spent[0], LEAST)})
                planned, failure = _planned(file, system, worker, declared, first_step)
        finally:
            timer.cancel()
        held = {transfer.name for transfer in planned.held}
        unknown = (frozenset[str]().union(*undeclared.values()) - measured.inputs) & held
        facts = measured, unknown, failure, held
        loops = (replace(loop, left_open=_note(system, loop, *facts)) for loop in system.opened)
        opened = [loop for loop in loops if loop.left_open]
    names = [loop.name for loop in opened]
    others = [loop for loop in planned.opened if loop.name not in names]
    warnings = [warning for warning in planned.warnings if not isinstance(warning, Assumption)]
    notes = [CheckWarning(loop.left_open) for loop in opened]
    return replace(planned, opened=(*opened, *others), assumed=False, warnings=(*warnings, *notes))


def _planned(
    file: ScenarioFile, system: System, worker: Worker | None, declared: dict[str, list[str]], limits: Limits
) -> tuple[System, str]:
    """Return the system with declared inputs, or the old one and why its new loops cannot be solved."""
    scenario = file.scenario
    components: dict[str, Any] = dict(scenario.components)
    for name, inputs in declared.items():
        components[name] = components[name].model_copy(update={"feedthrough": inputs})
    file.scenario = scenario.model_copy(update={"components": components})
    try:
        planned = build_system(file)
        error = None
        if planned.loops != system.loops:
            error = simulate_in(worker, planned, 1, scenario.step, limits).failure
            if isinstance(error, (Interrupted, Signalled)):
                raise error
        if error is None:
            return planned, ""
        failure = str(error)
    except InputError as fault:
        failure = fault.faults[0].message
    file.scenario = scenario
    return system, failure


def _note(
    system: System,
    loop: Loop,
    measured: Feedthrough,
    unknown: Collection[str],
    failure: str,
    held: Collection[str],
) -> str:
    """Return the warning of a loop that is left open, "" if it is none.

    Args:
        unknown: Inputs with the value of the step before that were not measured.
        failure: Why the measured loops cannot be solved.
        held: Inputs with the value of the step before.
    """

    def is_part(name: str) -> bool:
        return name.partition(".")[0] in loop.members

    def facts(pairs: Sequence[Pair]) -> str:
        more = f" and {len(pairs) - NAMED} more" if len(pairs) > NAMED else ""
        return ", ".join(f"{output} follows {entry}" for output, entry in pairs[:NAMED]) + more

    if failure and (pairs := [pair for pair in measured.pairs if is_part(pair[1])]):
        return (
            f"{loop.name} is an algebraic loop that no FMU declares: measured before the run, {facts(pairs)}. "
            "It is left open, so that some inputs have the values of the step before, because solving it fails: "
            f"{failure}"
        )
    if pairs := [pair for pair in measured.at_start if is_part(pair[1]) and pair[1] in held]:
        members = [stage.component for stage in system.stages if stage.component.name in loop.members]
        is_real = all(not any(t.beside) and not system.signals[t.name].is_whole for t in loop.transfers)
        can_repeat = is_real and all(
            isinstance(m, FmuBlock) and not isinstance(m, EventFmu) and m.rolls_back for m in members
        )
        cure = (
            Note("loops: {} solves it by repeated steps")
            if can_repeat
            else Note(
                "an FMU that saves and restores its state, or one without direct feedthrough, would be a cure; "
                "order: [...] states that it is open, without this warning"
            )
        )
        return (
            f"{loop.name} may be an algebraic loop that no FMU declares: in initialization {facts(pairs)}, "
            "later only with a step. It is left open, so that some inputs may have the values of the step "
            f"before; {cure}"
        )
    if names := sorted(filter(is_part, unknown)):
        return (
            f"{loop.name} may be an algebraic loop: whether outputs follow {join_names(names)} at once is not "
            f"declared, nor measured{measured.failure}; cosim assumes that none does; feedthrough: [...] of the "
            f"component names the inputs that an output follows, [] for none; loops: {{}} solves it; order: "
            "[...] states the order instead"
        )
    return ""
