"""Examinations of components before a run, in separate instances: direct feedthrough, and saved states.

**Direct feedthrough.** If an FMU declares no dependencies, the order of components may assume that an input has no
direct feedthrough. Each such input is changed by small and large amounts from two points, during initialization and
afterwards: integers by one, Booleans to the other value, enumerations to other items. The outputs that react are
recorded, and the order is planned again. FMUs with event mode stay in the event mode that follows initialization.

**Saved states.** An FMU may save the stop time with its state, and then refuse to step beyond this time. Such a state
cannot be used in a longer run. Each state is therefore restored, and the FMU steps beyond the old stop time with the
inputs of the last row.
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
    """Measured direct feedthrough of inputs without declared dependencies.

    Attributes:
        pairs: Pairs (output, input) with direct feedthrough after initialization.
        at_start: Pairs (output, input) with direct feedthrough only during initialization.
        inputs: Inputs that were measured.
        failure: Reason why the measurement is incomplete; "" if it is complete.
    """

    pairs: tuple[Pair, ...] = ()
    at_start: tuple[Pair, ...] = ()
    inputs: frozenset[str] = frozenset()
    failure: str = ""


def undeclared_inputs(system: System) -> dict[str, frozenset[str]]:
    """Return component → inputs without declared dependencies whose connections may close an algebraic loop.

    Inputs of FMUs with event mode whose values are exchanged until they settle are left out.
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
    """Open the components of a system, and return the result of an examination.

    Args:
        examination: Function of a master in initialization mode and of `arguments`.
        grid: Number of communication steps, and their length [s].
        worker: Process for the FMUs; None for this one, without limits.
        spent: [time without loading [s]], to which the examination adds.

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
    """Return a continuation without states that cannot be stepped beyond the old stop time, and their FMUs.

    Args:
        grid: Number of steps of the longer run, and their length [s].
        end: Communication point at the stop time of the run that saved the states.
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
    except SimulationError:  # after a crash or an exceeded limit, no state is used
        ended = [*saved]
    if not ended:
        return start, []
    state = {**state, "components": {**states, **dict.fromkeys(ended)}}
    return replace(start, state=pack(state)), ended


def ended_states(master: Master, row: Sequence[float], states: Mapping[str, Any], last: int, end: int) -> list[str]:
    """Return the FMUs whose restored states cannot be stepped beyond the old stop time.

    Args:
        row: Values of the last row.
        last: Communication point of the states. end: Communication point at the old stop time.
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
    """Return the measured direct feedthrough of undeclared inputs in the open loops of a system."""
    system, failure, exchange = master.system, "", Initialization(master)
    # A component may refuse the start values of other components in its loop. It is then measured at its own.
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
        with suppress(SimulationError):  # the component may refuse the start values
            component.get()
    pairs, inputs = _measure(master, asked)
    inputs &= first_inputs
    at_start = tuple(pair for pair in first_pairs if pair not in pairs and pair[1] in inputs)
    return Feedthrough(tuple(pairs), at_start, frozenset(inputs), failure)


def _measure(master: Master, asked: Sequence[tuple[Member, list[int]]]) -> tuple[list[Pair], set[str]]:
    """Return the pairs (output, input) with direct feedthrough in the current mode, and the measured inputs."""
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
    """Return the system, planned again with measured direct feedthrough if its order assumes that there is none.

    The measured inputs are stored as `feedthrough` in the scenario. A loop is solved if its first step succeeds;
    otherwise it stays open, with a warning that says what was measured.

    Args:
        worker: Process for the FMUs; None for this one.
        tell: Function that shows a note if the measurement takes long.
    """
    undeclared = undeclared_inputs(system) if system.assumed else {}
    planned, opened = system, list[Loop]()
    if undeclared:
        given = file.scenario.limits or Limits()
        total = min(given.total or LONGEST_MEASUREMENT, LONGEST_MEASUREMENT)
        load = given.load or LOADING + (FMU_COMPILE_LIMIT_S if permission.get() else 0.0)
        limits, spent = given.model_copy(update={"total": max(total, LEAST_FIRST_STEP), "load": load}), [0.0]
        note = Note(
            f"measuring the direct feedthrough of {join_names([*undeclared])}, which these FMUs do not declare "
            f"(at most {limits.total:g} s)"
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
                    reason = Note(f"it was stopped after {limits.total:g} s, in {error.component}")
                measured = Feedthrough(failure=f": {reason}")
            followed = {n: sorted({i for _, i in measured.pairs if i in inputs}) for n, inputs in undeclared.items()}
            known = measured.inputs - {entry for _, entry in measured.at_start}
            declared = {  # components whose inputs are all known, or some of whose outputs react
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
    """Return the warning about a loop that stays open; "" if the measurement shows that there is no loop.

    Args:
        unknown: Inputs with values of the previous step that were not measured.
        failure: Why the measured loops cannot be solved.
        held: Inputs with values of the previous step.
    """

    def is_part(name: str) -> bool:
        return name.partition(".")[0] in loop.members

    def facts(pairs: Sequence[Pair]) -> str:
        more = f" and {len(pairs) - MAX_NAMED_PAIRS} more" if len(pairs) > MAX_NAMED_PAIRS else ""
        return ", ".join(f"{output} follows {entry}" for output, entry in pairs[:MAX_NAMED_PAIRS]) + more

    if failure and (pairs := [pair for pair in measured.pairs if is_part(pair[1])]):
        return (
            f"{loop.name} is an algebraic loop that no FMU declares: measured before the run, {facts(pairs)}. The loop "
            f"is not solved, and some inputs have the values of the previous step, because solving it fails: {failure}"
        )
    if pairs := [pair for pair in measured.at_start if is_part(pair[1]) and pair[1] in held]:
        members = [stage.component for stage in system.stages if stage.component.name in loop.members]
        is_real = all(not any(t.beside) and not system.signals[t.name].is_whole for t in loop.transfers)
        can_repeat = is_real and all(
            isinstance(m, FmuBlock) and not isinstance(m, EventFmu) and m.rolls_back for m in members
        )
        cure = (
            Note("to solve it by repeated steps, add loops: {}")
            if can_repeat
            else Note(
                "to solve it, use FMUs that save and restore their state; to accept these values without this "
                "warning, set order: [...]"
            )
        )
        return (
            f"{loop.name} may be an algebraic loop that no FMU declares: {facts(pairs)} in initialization, "
            "but later only after a step. The loop is not solved, so some inputs may have the values of the "
            f"previous step; {cure}"
        )
    if names := sorted(filter(is_part, unknown)):
        return (
            f"{loop.name} may be an algebraic loop: direct feedthrough of {join_names(names)} is neither declared "
            f"nor measured{measured.failure}. cosim assumes none. List the inputs with direct feedthrough under "
            "feedthrough: of the component ([] for none), add loops: {} to solve the loop, or set order: [...]"
        )
    return ""
