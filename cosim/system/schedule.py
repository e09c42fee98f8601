"""Stepping order of components, and the transfers right before each of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cosim.blocks.component import Component
from cosim.blocks.faults import steps_in
from cosim.coupling.algorithms import WITHOUT_ORDER, algorithms
from cosim.coupling.order import AlgebraicLoop, Edge
from cosim.scenario.diagnosis import Diagnosis
from cosim.scenario.scenario import Connection, Scenario
from cosim.storage.yaml_file import did_you_mean
from cosim.system import messages
from cosim.system.wiring import Components, Transfer


@dataclass(frozen=True)
class Stage:
    """A component with the transfers before its step, every `every`-th communication point."""

    component: Component
    pulls: tuple[Transfer, ...] = ()
    every: int = 1


@dataclass(frozen=True)
class Schedule:
    """Stages in stepping order, transfers at the end of a step, and connected clocks: output, input."""

    stages: tuple[Stage, ...] = ()
    held: tuple[Transfer, ...] = ()
    clock_wires: tuple[tuple[str, str], ...] = ()


def schedule(
    scenario: Scenario, components: Components, transfers: Sequence[Sequence[Transfer]], diagnosis: Diagnosis
) -> Schedule:
    """Return the schedule of a scenario; note a fault and return an empty schedule if none exists.

    Args:
        transfers: Transfers of each connection.
    """
    every = {name: _every(scenario, name, diagnosis) for name in components}
    algorithm = algorithms()[scenario.algorithm]
    user_order = scenario.order if algorithm.sequential else None
    if user_order is not None and not _names_all(user_order, components, diagnosis):
        return Schedule()
    wired = [(c, ends) for c, ends in zip(scenario.connections, transfers, strict=True) if not ends[0].is_clock]
    try:
        order, immediate, notes = algorithm.plan(components, [_edge(c) for c, _ in wired], user_order)
    except AlgebraicLoop as loop:
        names = {"names": ", ".join(sorted(set(loop.cycle))), "cycle": " → ".join(loop.cycle)}
        message = messages.ALGEBRAIC_LOOP(algorithm=algorithm.name, other=WITHOUT_ORDER.name, **names)
        diagnosis.note(("connections",), message)
        return Schedule()
    if sorted(order) != sorted(components):
        message = messages.PLAN_INCOMPLETE(algorithm=algorithm.name, order=", ".join(order))
        diagnosis.note(("algorithm",), message)
        return Schedule()
    diagnosis.warnings += notes
    pulls, held = _divide([ends for _, ends in wired], immediate)
    stages = tuple(Stage(components[n], tuple(pulls.get(n, ())), every[n]) for n in order)
    return Schedule(stages, tuple(held), _clock_wires(transfers))


def _divide(
    transfers: Sequence[Sequence[Transfer]], immediate: Sequence[bool]
) -> tuple[dict[str, list[Transfer]], list[Transfer]]:
    """Return the transfers right before the step of each component, and those at the end of the step."""
    held: list[Transfer] = []
    pulls: dict[str, list[Transfer]] = {}
    for ends, is_immediate in zip(transfers, immediate, strict=True):
        for transfer in ends:
            (pulls.setdefault(transfer.name.partition(".")[0], []) if is_immediate else held).append(transfer)
    return pulls, held


def _clock_wires(transfers: Sequence[Sequence[Transfer]]) -> tuple[tuple[str, str], ...]:
    """Return the connected clocks: output, input."""
    return tuple((transfer.origin, transfer.name) for ends in transfers for transfer in ends if transfer.is_clock)


def _every(scenario: Scenario, name: str, diagnosis: Diagnosis) -> int:
    """Return the component's step in steps of the scenario.

    A fault is noted if the ratio is not a whole number.
    """
    step: float | None = getattr(scenario.components[name], "step", None)
    if step is None:
        return 1
    count = steps_in(step, scenario.step)
    every = max(1, round(count))
    if round(count) < 1 or abs(count - every) > 1e-9 * count:
        message = messages.STEP_NOT_A_MULTIPLE(step=step, base=scenario.step, cure=every * scenario.step)
        diagnosis.note(("components", name, "step"), message)
    elif every > scenario.steps:
        message = messages.STEP_LONGER_THAN_RUN(step=step, duration=scenario.duration)
        diagnosis.note(("components", name, "step"), message)
    elif rest := scenario.steps % every:
        message = messages.LAST_STEP_INCOMPLETE(component=name, step=step, rest=rest * scenario.step)
        diagnosis.warnings.append(message)
    return every


def _edge(connection: Connection) -> Edge:
    target, _, variable = connection.target.partition(".")
    source, _, output = connection.source.partition(".")
    return source, target, variable, output


def _names_all(order: Sequence[str], components: Components, diagnosis: Diagnosis) -> bool:
    """Return whether a stated order names each component with inputs exactly once; note faults."""
    missing = sorted(name for name in components.keys() - set(order) if components[name].inputs)
    unknown = [name for name in order if name not in components]
    twice = len(set(order)) != len(order)
    for name in unknown:
        diagnosis.note(("order",), messages.UNKNOWN_COMPONENT(name=name, hint=did_you_mean(name, components)))
    if missing or twice:
        diagnosis.note(("order",), messages.ORDER_INCOMPLETE(missing=", ".join(missing) or "none"))
    return not (unknown or missing or twice)
