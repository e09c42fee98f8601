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

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cosim.blocks.compiling import FMU_COMPILE_LIMIT_S, permission
from cosim.blocks.coupling import Assumption
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import far_beyond
from cosim.core.errors import CosimError, InputError, Interrupted, Signalled, SimulationError
from cosim.core.messages import CheckWarning
from cosim.core.text import join_names, some
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
LONGEST_MEASUREMENT = 20.0  # [s] without loading; less with a shorter `limits: total`

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
) -> Any:
    """Open the components of a system, and return the result of an examination.

    Args:
        examination: Function of a master in initialization mode and of `arguments`.
        grid: Number of communication steps, and their length [s].
        worker: Process for the FMUs; None for this one, without limits.

    Raises:
        FmuError: An FMU does not load.
        SimulationError: A component failed.
    """
    if worker is None:
        return _examined(examination, system, grid, None, *arguments)
    calls = [fmi_calls(getattr(stage.component, "description", None)) for stage in system.stages]
    watch = Watch(system.names, calls, limits=limits)
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


def with_feedthrough(file: ScenarioFile, system: System, worker: Worker | None) -> System:
    """Return the system, planned again with measured direct feedthrough if its order assumes that there is none.

    The measured inputs are stored as `feedthrough` in the scenario. A loop is solved if its first step succeeds;
    otherwise it stays open, with a warning that says what was measured.

    Args:
        worker: Process for the FMUs; None for this one.
    """
    undeclared = undeclared_inputs(system) if system.assumed else {}
    planned, scenario, measured, failure = system, file.scenario, Feedthrough(), ""
    if undeclared:
        given = scenario.limits or Limits()
        total = min(given.total or LONGEST_MEASUREMENT, LONGEST_MEASUREMENT)
        load = given.load or LOADING + (FMU_COMPILE_LIMIT_S if permission.get() else 0.0)
        limits = given.model_copy(update={"total": total, "load": load})
        try:
            measured = examine(measure_feedthrough, system, (1, scenario.step), worker, limits)
        except (Interrupted, Signalled):
            raise
        except CosimError as error:
            measured = Feedthrough(failure=f": {error}")
        known = measured.inputs - {entry for _, entry in measured.at_start}
        declared = dict[str, Any]()
        for name, inputs in undeclared.items():
            followed = sorted({entry for _, entry in measured.pairs if entry in inputs})
            if followed or inputs <= known:  # some output reacts, or all inputs are known
                feedthrough = [entry.partition(".")[2] for entry in followed]
                declared[name] = scenario.components[name].model_copy(update={"feedthrough": feedthrough})
        file.scenario = scenario.model_copy(update={"components": {**scenario.components, **declared}})
        try:
            planned = build_system(file) if declared else system
            if planned.loops != system.loops:
                stepped = simulate_in(worker, planned, 1, scenario.step, limits)
                if isinstance(stepped.failure, (Interrupted, Signalled)):
                    raise stepped.failure
                failure = "" if stepped.failure is None else str(stepped.failure)
        except InputError as fault:
            failure = fault.faults[0].message
        if failure:
            planned, file.scenario = system, scenario
    held = {transfer.name for transfer in planned.held}
    unknown = (frozenset[str]().union(*undeclared.values()) - measured.inputs) & held
    notes = {loop.name: _note(loop, measured, unknown, failure, held) for loop in system.opened if undeclared}
    opened = [replace(loop, left_open=notes[loop.name]) for loop in system.opened if notes.get(loop.name)]
    others = [loop for loop in planned.opened if not notes.get(loop.name)]
    warnings = [warning for warning in planned.warnings if not isinstance(warning, Assumption)]
    warnings += [CheckWarning(loop.left_open) for loop in opened]
    return replace(planned, opened=(*opened, *others), assumed=False, warnings=tuple(warnings))


def _note(loop: Loop, measured: Feedthrough, unknown: Collection[str], failure: str, held: Collection[str]) -> str:
    """Return the warning about a loop that stays open; "" if the measurement shows that there is no loop.

    Args:
        unknown: Inputs with values of the previous step that were not measured.
        failure: Why the measured loops cannot be solved.
        held: Inputs with values of the previous step.
    """

    def facts(pairs: Iterable[Pair]) -> str:
        parts = [f"{output} follows {entry}" for output, entry in pairs if entry.partition(".")[0] in loop.members]
        return some(parts, MAX_NAMED_PAIRS)

    if failure and (directly := facts(measured.pairs)):
        return (
            f"{loop.name} is an algebraic loop that no FMU declares: measured before the run, {directly}. The loop is "
            f"not solved, and some inputs have the values of the previous step, because solving it fails: {failure}"
        )
    if at_start := facts(pair for pair in measured.at_start if pair[1] in held):
        return (
            f"{loop.name} may be an algebraic loop that no FMU declares: {at_start} in initialization, but later only "
            "after a step. The loop is not solved, so some inputs may have the values of the previous step; to solve "
            "it by repeated steps, if its FMUs save and restore their state, add loops: {}; to accept these values "
            "without this warning, set order: [...]"
        )
    if names := sorted(name for name in unknown if name.partition(".")[0] in loop.members):
        return (
            f"{loop.name} may be an algebraic loop: direct feedthrough of {join_names(names)} is neither declared "
            f"nor measured{measured.failure}. cosim assumes none. List the inputs with direct feedthrough under "
            "feedthrough: of the component ([] for none), add loops: {} to solve the loop, or set order: [...]"
        )
    return ""
