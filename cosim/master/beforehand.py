"""Examinations of components before a run, in instances of their own: direct feedthrough, and saved states.

**Direct feedthrough** where FMUs declare no dependencies. An order of components may assume that an undeclared input
has none. Each such input is displaced, by small and large amounts about two points, in initialization and after it, and
the outputs that follow are noted: integers by one, Booleans to their other value, enumerations to other items. FMUs in
event mode stay in the event mode after initialization. The order is then planned again.

**States beyond the end of the run that saved them.** An FMU may save the end of the run, which it was told, with its
state, and then refuses to step beyond it. Such a state is of no use to a longer run. Each state is restored, and the
FMU steps over that end with the inputs of the last row.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from threading import Timer
from typing import Any

import numpy as np

from cosim.blocks.compiling import FMU_COMPILE_LIMIT_S, permission
from cosim.blocks.coupling import Assumption
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import far_beyond
from cosim.core.errors import CosimError, InputError, Interrupted, Signalled, SimulationError, TimedOut
from cosim.core.messages import CheckWarning, Note
from cosim.core.text import join_names
from cosim.files.state_file import pack, unpack
from cosim.isolation import worker as here
from cosim.isolation.limits import LOADING, Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import Rows
from cosim.isolation.watch import Watch, fmi_calls
from cosim.master.checkpoint import Continuation
from cosim.master.initialization import Initialization
from cosim.master.loops import Member, members_of
from cosim.master.master import Master
from cosim.master.own_process import in_own_processes
from cosim.master.remote import simulate_in
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.schedule import Loop
from cosim.system.system import System, build_system

SWEEPS = 3  # exchanges of values before the measurement
MIN_OUTPUT_CHANGE = 1e-7  # change of an output that counts, relative to its value
NOISE = 10.0  # the same relative to differences between equal calls
IRREGULAR = 0.37  # displacement of the second point, in sizes of an input
OTHERS = -0.37, -0.9, 0.9  # displacements of further points, for a component that refuses the first two
STEPS_BEYOND_END = 2  # steps beyond the end of the run that saved a state
MAX_NAMED_PAIRS = 6  # signals of a message
LONGEST_MEASUREMENT = 20.0  # [s] with the first step, without loading; less with a shorter `limits: total`
LEAST_FIRST_STEP = 0.1  # [s] that is left for the first step
SILENT = 2.0  # [s] before a note tells of the measurement

Pair = tuple[str, str]  # output, input


@dataclass(frozen=True)
class Feedthrough:
    """Measured feedthrough of inputs without declared dependencies.

    Attributes:
        pairs: Outputs that follow an input after initialization.
        at_start: Outputs that follow an input in initialization only.
        inputs: Inputs that were measured.
        failure: Why something could not be measured.
    """

    pairs: tuple[Pair, ...] = ()
    at_start: tuple[Pair, ...] = ()
    inputs: frozenset[str] = frozenset()
    failure: str = ""


def undeclared_inputs(system: System) -> dict[str, frozenset[str]]:
    """Return component → inputs within open loops that have no declared dependencies.

    Inputs of FMUs in event mode whose values settle at each instant need none.
    """
    undeclared = {}
    transfers = [transfer.name.partition(".") for loop in system.opened for transfer in loop.transfers]
    for component in (stage.component for stage in system.stages):
        inputs = [name for owner, _, name in transfers if owner == component.name]
        if isinstance(component, EventFmu):
            inputs = [name for name in inputs if not component.settles(name)]
        if names := frozenset(f"{component.name}.{n}" for n in inputs if component.depends_on(n) is None):
            undeclared[component.name] = names
    return undeclared


def examine(
    examination: Callable[..., Any],
    system: System,
    grid: tuple[int, float],
    worker: Worker | None,
    limits: Limits,
    *arguments: Any,
    spent: list[float] | None = None,
) -> Any:
    """Return what an examination of opened components finds.

    Args:
        examination: Function of a master in initialization mode, and of arguments.
        grid: Number of the steps and their length [s].
        worker: Process for the FMUs; None for this one, without limits.
        spent: Time [s] without loading, increased by the examination.

    Raises:
        FmuError: An FMU does not load.
        SimulationError: A component failed.
    """
    if worker is None:
        return _examined(examination, system, grid, None, *arguments)
    calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
    watch = Watch(system.names, calls, limits=limits, spent=[0.0] if spent is None else spent)
    return worker.call(_examined, examination, system, grid, limits, *arguments, watch=watch)


@far_beyond
def _examined(
    examination: Callable[..., Any], system: System, grid: tuple[int, float], limits: Limits | None, *arguments: Any
) -> Any:
    rows = Rows.in_memory(2, len(system.columns))
    if limits is not None:
        system, rows = in_own_processes(system, limits), replace(rows, doing=here.progress.doing)
    master = Master(system, *grid, None, rows)
    try:
        master.open()
        return examination(master, *arguments)
    finally:
        for component in master.components:
            master.announce(component).close()


# -- states ------------------------------------------------------------------------------------------


def without_ended_states(
    system: System,
    grid: tuple[int, float],
    start: Continuation,
    end: int,
    worker: Worker | None,
    limits: Limits,
) -> tuple[Continuation, list[str]]:
    """Return a continuation without the states of FMUs that refuse to step beyond an end, and these FMUs.

    Args:
        grid: Number of steps of the longer run, and their length [s].
        end: Communication point of the end of the run that saved the states.
        worker: Process for the FMUs; None for this one, without limits.

    Raises:
        FmuError: An FMU does not load.
    """
    state = {} if start.state is None else unpack(start.state)
    states = state.get("components", {})
    saved = {
        c.name: states[c.name] for s in system.stages if isinstance(c := s.component, FmuBlock) and states.get(c.name)
    }
    if not saved:
        return start, []
    try:
        ended = examine(ended_states, system, grid, worker, limits, start.values[-1], saved, start.count - 1, end)
    except (Interrupted, Signalled):
        raise
    except SimulationError:  # a crash or a limit: none of the states has proved its use
        ended = [*saved]
    if not ended:
        return start, []
    state = {**state, "components": {**states, **dict.fromkeys(ended)}}
    return replace(start, state=pack(state)), ended


def ended_states(master: Master, row: Sequence[float], states: Mapping[str, Any], last: int, end: int) -> list[str]:
    """Return the FMUs whose restored states refuse to step beyond an end.

    Args:
        row: Last row.
        last: Communication point of the states, `end` that of the end.
    """
    Initialization(master, master.solvers).run()
    ended = []
    for stage in master.system.stages:
        component: Any = stage.component
        if component.name not in states:
            continue
        master.row[:] = [*row]
        try:
            master.announce(component).restore(states[component.name])
            _, step, every, length, _ = master.actives[component.name]
            for k in range((last // every + 1) * every, min(end + STEPS_BEYOND_END * every, master.steps) + 1, every):
                since = master.system.start + (k - every) * master.h
                step(since, length or float(master.time[k]) - since)
        except SimulationError:
            ended.append(component.name)
    return ended


# -- direct feedthrough -------------------------------------------------------------------------------


def measure_feedthrough(master: Master) -> Feedthrough:
    """Return the feedthrough of undeclared inputs in the open loops of a system."""
    system, failure, exchange = master.system, "", Initialization(master)
    # A component of a loop may refuse the start values of the others. It is then measured at its own.
    for sweep in range(SWEEPS):
        before = list(master.row)
        try:
            exchange.sweep()
        except SimulationError as error:
            if exchange.ends_run(error):
                raise
            master.row[:] = before
            failure = "" if sweep else f": {error}"
            break
    undeclared = frozenset[str]().union(*undeclared_inputs(system).values())
    asked = []
    for member in (m for loop in system.opened for m in members_of(loop, master)):
        if places := [k for k in member.inputs if system.columns[k] in undeclared]:
            asked.append((member, places))
    first_pairs, first_inputs = _measure(master, asked)
    for component in master.components:
        master.announce(component).start()
    for component in master.components:
        with suppress(SimulationError):  # It may refuse the start values.
            component.get()
    pairs, inputs = _measure(master, asked)
    inputs &= first_inputs
    at_start = tuple(pair for pair in first_pairs if pair not in pairs and pair[1] in inputs)
    return Feedthrough(tuple(pairs), at_start, frozenset(inputs), failure)


def _measure(master: Master, asked: Sequence[tuple[Member, list[int]]]) -> tuple[list[Pair], set[str]]:
    """Return the pairs of outputs and inputs of which the output follows the input now, and the measured inputs."""
    names, row = master.system.columns, master.row
    pairs: list[Pair] = []
    measured: set[str] = set()
    for member, places in asked:
        before = list(row)
        follows = np.zeros((len(member.outputs), len(places)), bool)
        accepts = np.zeros(len(places), bool)
        for k, share in enumerate((0.0, IRREGULAR, *OTHERS)):
            if k > 1 and accepts.any():
                break
            for j, place in enumerate(places):
                if not member.declarations[place].is_whole:
                    row[place] = before[place] + share * (1.0 + 0.1 * j) * member.size(place)
            with suppress(SimulationError):
                member.evaluate()
                base = master.values[member.outputs]
                member.evaluate()
                noise = NOISE * np.abs(master.values[member.outputs] - base)
                reactions = member.reactions(places, MIN_OUTPUT_CHANGE, noise)
                follows, accepts = follows | reactions[0], accepts | reactions[1]
        measured |= {names[places[j]] for j in np.flatnonzero(accepts)}
        row[:] = before
        with suppress(SimulationError):
            member.evaluate()
        pairs += [(names[member.outputs[i]], names[places[j]]) for i, j in zip(*np.nonzero(follows), strict=True)]
    return pairs, measured


# -- plan by measured feedthrough ----------------------------------------------------------------------


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
        total = min(given.total or LONGEST_MEASUREMENT, LONGEST_MEASUREMENT)
        load = given.load or LOADING + (FMU_COMPILE_LIMIT_S if permission.get() else 0.0)
        limits, spent = given.model_copy(update={"total": max(total, LEAST_FIRST_STEP), "load": load}), [0.0]
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
                if isinstance(error, TimedOut) and spent[0] > (limits.total or LONGEST_MEASUREMENT):
                    reason = Note(f"it takes longer than {limits.total:g} s in all, at last in {error.component}")
                measured = Feedthrough(failure=f": {reason}")
            followed = {n: sorted({i for _, i in measured.pairs if i in inputs}) for n, inputs in undeclared.items()}
            known = measured.inputs - {entry for _, entry in measured.at_start}
            declared = {  # where all inputs are known or some of them followed
                n: [i.partition(".")[2] for i in followed[n]]
                for n, inputs in undeclared.items()
                if followed[n] or inputs <= known
            }
            failure, scenario = "", file.scenario
            if declared:
                components: dict[str, Any] = dict(scenario.components)
                for name, followed_inputs in declared.items():
                    components[name] = components[name].model_copy(update={"feedthrough": followed_inputs})
                file.scenario = scenario.model_copy(update={"components": components})
                first_step = limits.model_copy(update={"total": max(total - spent[0], LEAST_FIRST_STEP)})
                try:
                    planned = build_system(file)
                    if planned.loops != system.loops:
                        stepped = simulate_in(worker, planned, 1, scenario.step, first_step)
                        if isinstance(stepped.failure, (Interrupted, Signalled)):
                            raise stepped.failure
                        failure = "" if stepped.failure is None else str(stepped.failure)
                except InputError as fault:
                    failure = fault.faults[0].message
                if failure:
                    planned, file.scenario = system, scenario
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
        more = f" and {len(pairs) - MAX_NAMED_PAIRS} more" if len(pairs) > MAX_NAMED_PAIRS else ""
        return ", ".join(f"{output} follows {entry}" for output, entry in pairs[:MAX_NAMED_PAIRS]) + more

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
