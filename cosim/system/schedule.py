"""Stepping order of components, and the transfers of values around each step."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

from cosim.blocks.component import Component
from cosim.blocks.coupling import DEFAULT, WITHOUT_ORDER, AlgebraicLoop, Assumption, Edge, Plan, algorithms
from cosim.blocks.event_mode import EventFmu
from cosim.blocks.fixes import Fixes
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.shared_code import code_of
from cosim.blocks.sources import SourceBlock
from cosim.core.messages import CheckNote, Note
from cosim.core.text import join_names
from cosim.core.times import steps_in
from cosim.scenario.scenario import Place
from cosim.system.wiring import Building, Components, Transfer

FEEDTHROUGH = "feedthrough"  # key of a component in the scenario


@dataclass(frozen=True)
class Stage:
    """A component with the transfers before and after its step, which ends at every `every`-th communication point.

    Attributes:
        pulls: Transfers before the step.
        late: Transfers after the step: values of known signals at the end of the step. Inputs are then set and outputs
            read again, so that the outputs in a row belong to the inputs in the same row.
    """

    component: Component
    pulls: tuple[Transfer, ...] = ()
    every: int = 1
    late: tuple[Transfer, ...] = ()

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """Return the transfers before and after the step."""
        return *self.pulls, *self.late


@dataclass(frozen=True)
class Loop:
    """An algebraic loop: components, consecutive in stepping order, and the transfers between them.

    Attributes:
        left_open: Reason why the loop is not solved, and the cure; "" for a solved loop.
    """

    members: tuple[str, ...]
    transfers: tuple[Transfer, ...]
    left_open: str = ""

    @property
    def name(self) -> str:
        """Return the components as a closed path, such as `a → b → a`."""
        return " → ".join((*self.members, self.members[0]))


@dataclass(frozen=True)
class Schedule:
    """Stages in stepping order, transfers at the end of a step, connected clocks (output, input), algebraic loops.

    Attributes:
        opened: Possible loops that are not solved because of the order, the algorithm or an assumption.
        assumed: True if the order assumes that inputs without declared dependencies have no direct feedthrough.
        known: Names of components whose outputs are known functions of time.
    """

    stages: tuple[Stage, ...] = ()
    held: tuple[Transfer, ...] = ()
    clock_wires: tuple[tuple[str, str], ...] = ()
    loops: tuple[Loop, ...] = ()
    opened: tuple[Loop, ...] = ()
    assumed: bool = False
    known: frozenset[str] = frozenset()

    @property
    def transfers(self) -> tuple[Transfer, ...]:
        """Return all transfers, including those within solved loops."""
        parts = self.held, *(stage.transfers for stage in self.stages), *(loop.transfers for loop in self.loops)
        return tuple(transfer for part in parts for transfer in part)


@dataclass(frozen=True)
class _Graph:
    """Components and the connections between them, except connections of clocks.

    Attributes:
        every: Component → length of its step, as a multiple of the scenario's step.
        wired: Graph edge and transfers of each connection.
        interpolates: True if inputs follow polynomials between values at the start and the end of a step.
    """

    components: Components
    every: Mapping[str, int]
    wired: Sequence[tuple[Edge, Sequence[Transfer]]]
    interpolates: bool = False

    @property
    def edges(self) -> list[Edge]:
        """Return the graph edge of each connection."""
        return [edge for edge, _ in self.wired]

    @cached_property
    def functions_of_time(self) -> frozenset[str]:
        """Return the components whose outputs are known functions of time.

        These are references, recordings, FMUs without inputs, and fixes whose inputs are such functions.
        """
        sources = FmuBlock | SourceBlock
        known = {n for n, c in self.components.items() if isinstance(c, sources) and not (c.inputs or c.exact_inputs)}
        fixes = {name for name, component in self.components.items() if isinstance(component, Fixes)}
        while more := {n for n in fixes - known if known.issuperset(s for s, target, *_ in self.edges if target == n)}:
            known |= more
        return frozenset(known)

    def sort_transfers(self, plan: Plan) -> tuple[tuple[Transfer, ...], tuple[Stage, ...], tuple[Loop, ...]]:
        """Return held transfers, stages with their transfers, and loops with their transfers.

        A known signal is transferred before the step (pull), after the step (late), or held. An FMU with sample times
        computes the outputs at the end of its step from the inputs at the start.
        """
        loop_of = {name: k for k, members in enumerate(plan.loops) for name in members}
        held: list[Transfer] = []
        solved: list[list[Transfer]] = [[] for _ in plan.loops]
        pulls: dict[str, list[Transfer]] = {name: [] for name in plan.order}
        late: dict[str, list[Transfer]] = {name: [] for name in plan.order}
        for ((source, target, name, output), connection), is_immediate in zip(self.wired, plan.immediate, strict=True):
            component, origin = self.components[target], self.components[source]
            is_pulled = is_immediate
            if source in self.functions_of_time and not getattr(component, "is_sampled", False):
                is_course = not isinstance(origin, SourceBlock) or output in origin.interpolated
                is_pulled = isinstance(component, Fixes) or (self.interpolates and is_course)
                is_seen = component.depends_on(name) is not False or any(signal.local for signal in component.outputs)
                # In model exchange, a change of inputs and another event at the same time are one event.
                if not is_pulled and (is_seen or getattr(component, "changes_by_events", False)):
                    late[target] += connection
                    continue
            if not is_pulled:
                held += connection
            elif target in loop_of and loop_of.get(source) == loop_of[target]:
                solved[loop_of[target]] += connection
            else:
                pulls[target] += connection
        loops = (Loop(members, tuple(own)) for members, own in zip(plan.loops, solved, strict=True))
        order = sorted(plan.order, key=lambda name: name not in self.functions_of_time)  # known signals are first
        stages = (Stage(self.components[n], tuple(pulls[n]), self.every[n], tuple(late[n])) for n in order)
        return tuple(held), tuple(stages), tuple(loops)

    def left_open(self, solved: Collection[tuple[str, ...]], key: str, assumptions: Sequence[str]) -> Iterator[Loop]:
        """Yield loops that exist, unsolved, if inputs without declared dependencies have direct feedthrough.

        Args:
            key: Key of the scenario because of which the loops are not solved.
        """
        plan = DEFAULT.plan_with_loops(self.components, self.edges, None, undeclared=True)
        for loop in self.sort_transfers(plan)[-1]:
            if loop.members in solved:
                continue
            cure = "; ".join(assumptions) or f"to solve it, add loops: {{}} and remove {key}"
            if not assumptions and (faults := [fault for _, fault in self.faults(loop)]):
                cure = f"loops: {{}} without {key} is not possible: {faults[0]}"
            sentence = (
                f"{loop.name} may be an algebraic loop. It is not solved because of {key}, so some inputs have the "
                f"values of the previous step; {cure}"
            )
            if key == FEEDTHROUGH and not assumptions:
                sentence = Note(
                    f"{loop.name} is not an algebraic loop at the start, as measured or declared by feedthrough: "
                    f"[...]; if direct feedthrough occurs later, {cure}"
                )
            yield replace(loop, left_open=sentence)

    def faults(self, loop: Loop) -> Iterator[tuple[Place, str]]:
        """Yield the faults of a loop that cannot be solved, with their places in the scenario."""
        has_events = any(isinstance(component, EventFmu) for component in self.components.values())
        part = f"part of the algebraic loop {loop.name}"
        order = "set order: [...], so that the loop is not solved"
        for name in loop.members:
            component = self.components[name]
            if isinstance(component, EventFmu) or (has_events and getattr(component, "changes_by_events", False)):
                cure = f"set event_mode: false or interface: co-simulation, or {order}"
                yield ("components", name), f"{name} is {part}, which cannot be solved at events; {cure}"
            if self.every[name] > 1:
                yield ("components", name, "step"), f"{name} has its own step and is {part}; remove its step"
        for transfer in loop.transfers:
            name, _, variable = transfer.name.partition(".")
            wholes = {signal.name for signal in self.components[name].inputs if signal.is_whole}
            if any(transfer.beside) or variable in wholes:
                yield ("connections",), f"{transfer.name} is {part}, in which only reals can be solved; {order}"


def schedule(building: Building, transfers: Sequence[Sequence[Transfer]], interpolates: bool) -> Schedule:
    """Return the schedule of a scenario; if there is none, record a fault and return an empty schedule.

    Args:
        transfers: Transfers of each connection.
        interpolates: True if inputs follow polynomials between values at the start and the end of a step.
    """
    scenario, components = building.scenario, building.components
    every = {name: _every(building, name) for name in components}
    wired: list[tuple[Edge, Sequence[Transfer]]] = []
    for connection, ends in zip(scenario.connections, transfers, strict=True):
        if not ends[0].is_clock:
            source, output, target, variable = connection.ends
            wired.append(((source, target, variable, output), ends))
    graph = _Graph(components, every, wired, interpolates)
    algorithm = algorithms()[scenario.algorithm]
    order = scenario.order if algorithm.sequential else None
    if order is not None:  # the order names each component with inputs exactly once
        missing = sorted(name for name in components.keys() - set(order) if components[name].inputs)
        unknown = sorted(set(order) - components.keys())
        if missing or unknown or len(set(order)) != len(order):
            parts = f"missing: {', '.join(missing) or 'none'}; unknown: {', '.join(unknown) or 'none'}"
            building.note(("order",), f"order must name every component with inputs once; {parts}")
            return Schedule()
    if scenario.loops is not None and (order is not None or not algorithm.solves_loops):
        what = f"algorithm: {algorithm.name}" if order is None else "order"
        building.note(("loops",), f"{what} does not solve algebraic loops; remove it, or remove loops")
        return Schedule()
    try:
        plan = algorithm.plan_with_loops(components, graph.edges, order, undeclared=scenario.loops is not None)
    except AlgebraicLoop as error:
        message = (
            f"algebraic loop under {algorithm.name}: {' → '.join(error.cycle)}; each needs the other's value at the "
            f"same time. State their order (order: [{', '.join(sorted(set(error.cycle)))}]) or algorithm: "
            f"{WITHOUT_ORDER.name}"
        )
        building.note(("connections",), message)
        return Schedule()
    if sorted(plan.order) != sorted(components):
        message = f"{algorithm.name} steps {', '.join(plan.order)}; but each component must be stepped exactly once"
        building.note(("algorithm",), message)
        return Schedule()
    building.warnings += plan.notes
    held, stages, loops = graph.sort_transfers(plan)
    for loop in loops:
        for place, fault in graph.faults(loop):
            building.note(place, fault)
    assumptions = [note for note in plan.notes if isinstance(note, Assumption)]
    opened: tuple[Loop, ...] = ()
    if scenario.loops is None:
        key = FEEDTHROUGH if algorithm.solves_loops else f"algorithm: {algorithm.name}"
        opened = tuple(graph.left_open(plan.loops, key if order is None else "order", assumptions))
        stated = {f"{n}.{i}" for n, c in components.items() for i in getattr(c, "feedthrough", None) or ()}
        for loop in loops:
            if names := [t.name for t in loop.transfers if stated & {t.name, t.name.rpartition("[")[0]}]:
                building.warnings.append(
                    CheckNote(
                        f"{loop.name} is an algebraic loop that the FMUs do not declare: outputs depend directly on "
                        f"{join_names(names)}, as measured before the run or declared by feedthrough: "
                        "[...]. It is solved at each communication point; to prevent this, state order: [...]"
                    )
                )
    clock_wires = tuple((t.origin, t.name) for ends in transfers for t in ends if t.is_clock)
    return Schedule(stages, held, clock_wires, loops, opened, bool(assumptions), graph.functions_of_time)


def _every(building: Building, name: str) -> int:
    """Return a component's step as a multiple of the scenario's step; record a fault if it is not a whole multiple."""
    scenario = building.scenario
    step: float | None = getattr(scenario.components[name], "step", None)
    if step is None:
        return 1
    count = steps_in(step, scenario.step)
    every = max(1, round(count))
    if round(count) < 1 or abs(count - every) > 1e-9 * count or every > scenario.steps:
        message = (
            f"step is {step:g} s; use a whole multiple of the step of the scenario, {scenario.step:g} s, not longer "
            f"than the run of {scenario.duration:g} s"
        )
        building.note(("components", name, "step"), message)
    elif rest := scenario.steps % every:
        message = (
            f"{name}: step is {step:g} s; the last {rest * scenario.step:g} s of the run are not a "
            "whole step, so the component is not stepped there"
        )
        building.warnings.append(message)
    return every


def batches(stages: Sequence[Stage]) -> Iterator[list[Stage]]:
    """Yield groups of consecutive stages that can step in parallel.

    In a group, no stage needs an output of another stage in the same step, and FMUs in one process share no data.
    """
    batch, names, data, has_fmu, is_exclusive = list[Stage](), set[str](), set[str](), False, False
    for stage in stages:
        component, own, steps_alone = stage.component, frozenset[str](), False
        fmu = component if isinstance(component, FmuBlock) and not component.is_apart else None
        if fmu is not None:
            own, about = code_of(fmu.path).common, fmu.instance.about
            # it may share data or a tool with other instances
            steps_alone = about.canBeInstantiatedOnlyOncePerProcess or about.needsExecutionTool
        waits = not (names.isdisjoint(t.origin.partition(".")[0] for t in stage.pulls) and data.isdisjoint(own))
        if waits or (fmu is not None and (is_exclusive or (steps_alone and has_fmu))):
            yield batch
            batch, names, data, has_fmu, is_exclusive = [], set(), set(), False, False
        batch.append(stage)
        names.add(component.name)
        data |= own
        has_fmu, is_exclusive = has_fmu or fmu is not None, is_exclusive or steps_alone
    if batch:
        yield batch
