"""Signals laid out in one row, and the connections between them as transfers from place to place."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from cosim.blocks.interface import Component, Signal
from cosim.blocks.noise import gaussian, stream
from cosim.simulation.diagnosis import Diagnosis, Place
from cosim.simulation.scenario import Connection, FmuComponent, Noise
from cosim.simulation.scenario_file import ScenarioFile
from cosim.yaml_file import did_you_mean

Components = Mapping[str, Component]


@dataclass(frozen=True)
class RowLayout:
    """Where signals stand in the row: component after component, inputs before outputs.

    first:   component → place of its first signal
    columns: `component.variable`, one a place
    units:   column → unit, "" where it has none
    """

    first: Mapping[str, int]
    columns: tuple[str, ...]
    units: Mapping[str, str]


@dataclass(frozen=True)
class Transfer:
    """A connection in the row: from one place to another, through noise."""

    source: int
    target: int
    name: str  # of the target, `component.variable`; it also names the random stream
    noise: Noise | None = None

    def samples(self, seed: int, count: int) -> list[float] | None:
        """What noise adds at each of `count` communication points; None adds nothing."""
        if self.noise is None:
            return None
        return gaussian(stream(seed, self.name), self.noise.variance, self.noise.bias, count)


def lay_out(components: Components) -> RowLayout:
    """The row of these components' signals."""
    first: dict[str, int] = {}
    units: dict[str, str] = {}
    for name, component in components.items():
        first[name] = len(units)
        for signal in (*component.inputs, *component.outputs):
            units[f"{name}.{signal.name}"] = signal.unit
    return RowLayout(first, tuple(units), units)


def connect(file: ScenarioFile, components: Components, layout: RowLayout, diagnosis: Diagnosis) -> list[Transfer]:
    """Transfers of the connections, in their order; one with a faulty end is left out."""
    _check_sources(file, diagnosis)
    lines = zip(file.connection_lines, file.scenario.connections, strict=True)
    found = (_transfer(file, components, layout, k, connection, diagnosis) for k, connection in lines)
    return [transfer for transfer in found if transfer is not None]


def _transfer(
    file: ScenarioFile, components: Components, layout: RowLayout, k: int, connection: Connection, diagnosis: Diagnosis
) -> Transfer | None:
    source = _end(file, components, ("connections", k, "from"), connection.source, "outputs", diagnosis)
    target = _end(file, components, ("connections", k, "to"), connection.target, "inputs", diagnosis)
    if source is None or target is None:
        return None
    (source_component, i, source_signal), (target_component, j, target_signal) = source, target
    if not source_signal.agrees(target_signal):
        ends = f"{connection.source} [{source_signal.unit}] to {connection.target} [{target_signal.unit}]"
        diagnosis.note(("connections", k), f"unit mismatch: {ends}")
    at = layout.first[source_component.name] + len(source_component.inputs) + i
    noise = connection.noise if file.scenario.noise else None
    return Transfer(at, layout.first[target_component.name] + j, connection.target, noise)


def _end(
    file: ScenarioFile, components: Components, where: Place, text: str, side: str, diagnosis: Diagnosis
) -> tuple[Component, int, Signal] | None:
    """One end of a connection among a component's `side`, its inputs or outputs: component, number and signal."""
    name, _, variable = text.partition(".")
    if name not in file.scenario.components and name not in file.broken:
        diagnosis.note(where, f'no component "{name}"{did_you_mean(name, file.scenario.components)}')
        return None
    component = components.get(name)
    if component is None or name in file.broken:  # its own fault is told already
        return None
    signals: tuple[Signal, ...] = getattr(component, side)
    for k, signal in enumerate(signals):
        if signal.name == variable:
            return component, k, signal
    other = "inputs" if side == "outputs" else "outputs"
    if any(s.name == variable for s in getattr(component, other)):
        message = f"{text} is one of the {other} of {name}; an output goes to an input"
    else:
        known = [s.name for s in signals]
        message = f'{name} has no {side[:-1]} "{variable}" of type Real{did_you_mean(variable, known)}'
        message += f" (its {side}: {', '.join(known) or 'none'})"
    diagnosis.note(where, message)
    return None


def _check_sources(file: ScenarioFile, diagnosis: Diagnosis) -> None:
    """An input has one source."""
    seen: dict[str, str] = {}
    for k, connection in zip(file.connection_lines, file.scenario.connections, strict=True):
        if connection.target in seen:
            both = f"{seen[connection.target]} and {connection.source}"
            diagnosis.note(("connections", k, "to"), f"two sources for {connection.target}: {both}; keep one")
        seen.setdefault(connection.target, connection.source)


def unconnected(file: ScenarioFile, components: Components) -> Iterator[str]:
    """A warning for each component with inputs that nothing feeds and the scenario gives no value."""
    fed = {c.target for c in file.scenario.connections}
    for name, component in components.items():
        declared = file.scenario.components[name]
        given = declared.start if isinstance(declared, FmuComponent) else {}
        free = [s.name for s in component.inputs if f"{name}.{s.name}" not in fed and s.name not in given]
        if free:
            yield f"not connected, at the start value of the FMU: {', '.join(f'{name}.{s}' for s in free)}"
