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
from cosim.system.wiring import Components, Transfer


@dataclass(frozen=True)
class Stage:
    """A component with the transfers before its step; it steps at every `every`-th communication point."""

    component: Component
    pulls: tuple[Transfer, ...] = ()
    every: int = 1


@dataclass(frozen=True)
class Schedule:
    """Stages in stepping order, and transfers at the end of a step."""

    stages: tuple[Stage, ...] = ()
    held: tuple[Transfer, ...] = ()


def schedule(
    scenario: Scenario, components: Components, transfers: Sequence[Sequence[Transfer]], diagnosis: Diagnosis
) -> Schedule:
    """Return the schedule of a scenario; note a fault and return an empty one if none exists.

    Args:
        transfers: Transfers of each connection.
    """
    every = {name: _every(scenario, name, diagnosis) for name in components}
    algorithm = algorithms()[scenario.algorithm]
    stated = scenario.order if algorithm.sequential else None
    if stated is not None and not _names_all(stated, components, diagnosis):
        return Schedule()
    try:
        order, immediate, notes = algorithm.plan(components, list(map(_edge, scenario.connections)), stated)
    except AlgebraicLoop as loop:
        names = ", ".join(sorted(set(loop.cycle)))
        message = (
            f"algebraic loop under {algorithm.name}: {' → '.join(loop.cycle)}; each needs the other's value of the "
            f"same time. State their order (order: [{names}]) or algorithm: {WITHOUT_ORDER.name}"
        )
        diagnosis.note(("connections",), message)
        return Schedule()
    if sorted(order) != sorted(components):
        message = f"{algorithm.name} steps {', '.join(order)}; it must step each component once"
        diagnosis.note(("algorithm",), message)
        return Schedule()
    diagnosis.warnings += notes
    held: list[Transfer] = []
    pulls: dict[str, list[Transfer]] = {name: [] for name in order}
    for connection, is_immediate in zip(transfers, immediate, strict=True):
        for transfer in connection:
            (pulls[transfer.name.partition(".")[0]] if is_immediate else held).append(transfer)
    return Schedule(tuple(Stage(components[n], tuple(pulls[n]), every[n]) for n in order), tuple(held))


def _every(scenario: Scenario, name: str, diagnosis: Diagnosis) -> int:
    """Return the component's step in steps of the scenario.

    A fault is noted if the ratio is not a whole number.
    """
    step: float | None = getattr(scenario.components[name], "step", None)
    if step is None:
        return 1
    count = steps_in(step, scenario.step)
    if round(count) < 1 or abs(count - round(count)) > 1e-9 * count:
        cure = f"use a whole multiple, {max(1, round(count)) * scenario.step:g} s for one"
        message = f"step is {step:g} s, that of the scenario {scenario.step:g} s; {cure}"
        diagnosis.note(("components", name, "step"), message)
        return max(1, round(count))
    every = round(count)
    if every > scenario.steps:
        message = f"step is {step:g} s, the run {scenario.duration:g} s: it would never step"
        diagnosis.note(("components", name, "step"), message)
    elif left := scenario.steps % every:
        still = f"its last {left * scenario.step:g} s of the run make no whole step: it stands still there"
        diagnosis.warnings.append(f"{name}: step is {step:g} s; {still}")
    return every


def _edge(connection: Connection) -> Edge:
    target, _, variable = connection.target.partition(".")
    source, _, output = connection.source.partition(".")
    return source, target, variable, output


def _names_all(order: Sequence[str], components: Components, diagnosis: Diagnosis) -> bool:
    """Return whether an order names each component with inputs once. Faults are noted."""
    missing = sorted(name for name in components.keys() - set(order) if components[name].inputs)
    unknown = [name for name in order if name not in components]
    twice = len(set(order)) != len(order)
    for name in unknown:
        diagnosis.note(("order",), f'no component "{name}"{did_you_mean(name, components)}')
    if missing or twice:
        message = f"order names every component with inputs once; missing: {', '.join(missing) or 'none'}"
        diagnosis.note(("order",), message)
    return not (unknown or missing or twice)
