"""Layout of signals in a row, and connections as transfers between places."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any

from cosim.base.errors import SimulationError
from cosim.base.units import UnitAssumption, assume_si
from cosim.blocks.component import Component, Signal
from cosim.blocks.faults import Added, Linked, Scaled, disturbed, points, whole
from cosim.blocks.fmi_types import goes
from cosim.blocks.noise import gaussian, stream
from cosim.blocks.stepping import Does, Link, link
from cosim.scenario.diagnosis import Diagnosis, Place
from cosim.scenario.scenario import (
    Connection,
    Disturbance,
    FixComponent,
    FmuComponent,
    Noise,
    PlaybackComponent,
    ReferenceComponent,
)
from cosim.scenario.scenario_file import ScenarioFile
from cosim.scenario.start_values import Misfit
from cosim.storage.yaml_file import did_you_mean

Components = Mapping[str, Component]
MOST_NAMED = 20  # signals in a message
PASSING = {"freeze", "dropout", "delay"}  # faults that pass values of any type unchanged


@dataclass(frozen=True)
class RowLayout:
    """Places of signals: component after component, inputs before outputs, in the row of doubles or beside the row.

    Attributes:
        columns: Names `component.variable` by place in the row.
        units: Column → unit, "" without unit.
        beside: Names, like `columns`, of values beyond the exact range of doubles.
        place: Column → whether beside the row, and place there.
        signals: Column → signal.
    """

    columns: tuple[str, ...]
    units: Mapping[str, str]
    beside: tuple[str, ...]
    place: Mapping[str, tuple[bool, int]]
    signals: Mapping[str, Signal]


@dataclass(frozen=True)
class Transfer:
    """A connection between two places, with unit conversion, noise and injected faults.

    Attributes:
        name: Target as `component.variable`, also the name of its random stream.
        items: Items of an enumeration as target; `origin` is the name of the source.
        beside: Whether source and target are beside the row.
    """

    source: int
    target: int
    name: str
    noise: Noise | None = None
    factor: float = 1.0
    offset: float = 0.0
    faults: tuple[Disturbance, ...] = ()
    beside: tuple[bool, bool] = (False, False)
    items: Mapping[str, int] | None = None
    origin: str = ""

    @property
    def plain(self) -> bool:
        """Return whether values are copied within the row, apart from noise."""
        changed = self.factor != 1.0 or self.offset != 0.0 or self.faults or self.items is not None
        return not changed and self.beside == (False, False)

    def check_item(self, value: Any, t: float) -> None:
        """Raise SimulationError if a value is no item of the target."""
        if self.items is not None and value not in self.items.values():
            said = f"{value:g}, which comes from {self.origin}, is none of its items: {_numbers(self.items)}"
            raise SimulationError(self.name, t, said)

    def samples(self, seed: int, count: int) -> array[float] | None:
        """Return noise samples per communication point, None without noise."""
        if self.noise is None:
            return None
        return gaussian(stream(seed, self.name), self.noise.variance, self.noise.bias, count)

    def through(self, seed: int, start: float, step: float, count: int) -> tuple[Linked, ...]:
        """Return the value's conversions in order: unit, noise, faults."""
        chain: list[Linked] = []
        if self.factor != 1.0 or self.offset != 0.0:
            chain.append(Scaled(self.factor, self.offset))
        if (samples := self.samples(seed, count)) is not None:
            chain.append(Added(samples))
        for number, fault in enumerate(self.faults):
            window = points(fault.begin, fault.end, start, step, count)
            rng = stream(seed, f"{self.name} {fault.kind} {number}")
            delay = 0 if fault.delay is None else whole(fault.delay, step)
            given = {"value": fault.value, "probability": fault.probability, "delay": delay}
            chain.append(disturbed(fault.kind, window, count, rng, **given))  # type: ignore[arg-type]
        if self.items is not None:
            chain.append(_Checked(self, start, step))
        return tuple(chain)


class _Checked:
    """A check that a value is an item of the target enumeration."""

    def __init__(self, transfer: Transfer, start: float, step: float) -> None:
        self.transfer, self.start, self.step = transfer, start, step

    def __call__(self, k: int, v: Any) -> Any:
        if k:  # Values may be undefined until initialization ends.
            self.transfer.check_item(v, self.start + k * self.step)
        return v

    def link(self) -> Link:
        items = array("d", (self.transfer.items or {}).values())
        return link(Does.ITEMS, values=items, count=len(items))


def through(chain: Sequence[Linked]) -> Callable[[int, Any], Any]:
    """Return the composition of a chain as a single function."""

    def value(k: int, v: Any) -> Any:
        for one in chain:
            v = one(k, v)
        return v

    return chain[0] if len(chain) == 1 else value


def lay_out(components: Components) -> RowLayout:
    """Return the layout of the components' signals."""
    row: dict[str, Signal] = {}
    beside: dict[str, Signal] = {}
    for name, component in components.items():
        row |= {f"{name}.{s.name}": s for s in (*component.inputs, *component.outputs)}
        beside |= {f"{name}.{s.name}": s for s in (*component.exact_inputs, *component.exact_outputs)}
    units = {column: signal.unit for column, signal in row.items()}
    place = {c: (aside, k) for aside, part in ((False, row), (True, beside)) for k, c in enumerate(part)}
    return RowLayout(tuple(row), units, tuple(beside), place, row | beside)


def connect(
    file: ScenarioFile, components: Components, layout: RowLayout, diagnosis: Diagnosis
) -> list[tuple[Transfer, ...]]:
    """Return the transfers of each connection, one per element.

    A faulty connection has none.
    """
    _check_sources(file, diagnosis)
    _check_faults(file, diagnosis)
    wiring = _Wiring(file, components, layout, diagnosis)
    lines = zip(file.places["connections"], file.scenario.connections, strict=True)
    return [wiring.transfers(k, connection) for k, connection in lines]


def taken_for(file: ScenarioFile, connection: Connection, source: Signal, target: Signal) -> UnitAssumption | None:
    """Return the conversion for an input without unit, if needed.

    Only numbers with a unit written by people are converted.
    """
    component = file.scenario.components.get(connection.source.partition(".")[0])
    written = isinstance(component, ReferenceComponent | PlaybackComponent) and source.unit
    if not written or target.unit or target.whole or connection.conversion is not None:
        return None
    return assume_si(source.unit, "its FMU", f"give {connection.source} no unit")


def _misfit(connection: Connection, source: Signal, target: Signal) -> str:
    """Return the objection to a connection, or ""."""
    if not goes(source.kind, target.kind):
        what = f"{connection.source} is {source.kind or 'a number'}, {connection.target} is {target.kind}"
        return f"types do not agree: {what}"
    if source.declared and source.declared == target.declared and source.items != target.items:
        ends = ((connection.source, source), (connection.target, target))
        what = ", ".join(f"{name} has {_numbers(signal.items)}" for name, signal in ends)
        return f"enumerations of one name, {source.declared}, with other items: {what}"
    if connection.conversion is None and source.conversion(target) is None:
        units = f"{connection.source} [{source.unit}] to {connection.target} [{target.unit}]"
        return f"unit mismatch: {units}; where they are the same all the same, say so by factor: 1"
    return ""


class _Wiring:
    """Connections under construction: their ends, each a signal or the elements of an array, and the transfers."""

    def __init__(self, file: ScenarioFile, components: Components, layout: RowLayout, diagnosis: Diagnosis) -> None:
        self.file, self.components, self.layout, self.diagnosis = file, components, layout, diagnosis
        self._known: dict[tuple[str, str], dict[str, list[Signal]]] = {}
        self._faults: dict[str, list[Disturbance]] = {}
        for fault in file.scenario.faults:
            self._faults.setdefault(fault.on, []).append(fault)

    def transfers(self, k: int, connection: Connection) -> tuple[Transfer, ...]:
        """Return the transfers of a connection; none after noting a fault."""
        sources = self._ends(("connections", k, "from"), connection.source, "outputs")
        targets = self._ends(("connections", k, "to"), connection.target, "inputs")
        if not sources or not targets:
            return ()
        if len(sources) != len(targets):
            ends = f"{connection.source} to {connection.target}"
            self.diagnosis.note(("connections", k), f"{ends}: {len(sources)} values do not go to {len(targets)}")
            return ()
        made = []
        for source, target in zip(sources, targets, strict=True):
            transfer = self._transfer(connection, source, target)
            if isinstance(transfer, Misfit):
                self.diagnosis.note(("connections", k), transfer.reason)
                return ()
            made.append(transfer)
        return tuple(made)

    def _transfer(self, connection: Connection, source: Signal, target: Signal) -> Transfer | Misfit:
        """Return the transfer between two signals, or the objection."""
        if misfit := _misfit(connection, source, target):
            return Misfit(misfit)
        noise = connection.noise if self.file.scenario.noise else None
        factor, offset = self._conversion(connection, source, target)
        origin = f"{connection.source.partition('.')[0]}.{source.name}"
        name = f"{connection.target.partition('.')[0]}.{target.name}"
        (from_beside, at), (to_beside, to) = self.layout.place[origin], self.layout.place[name]
        faults = tuple(f for key in dict.fromkeys((connection.target, name)) for f in self._faults.get(key, ()))
        changes = [f"{fault.kind} fault" for fault in faults if fault.kind not in PASSING]
        changes += ["noise or factor"] if noise or (factor, offset) != (1.0, 0.0) else []
        if changes and (from_beside or to_beside):
            ends = f"{connection.source} to {connection.target}"
            return Misfit(f"{ends}: no {' or '.join(changes)} on {source.kind or target.kind}")
        sides = from_beside, to_beside
        return Transfer(at, to, name, noise, factor, offset, faults, sides, target.items, origin)

    def _conversion(self, connection: Connection, source: Signal, target: Signal) -> tuple[float, float]:
        """Return factor and offset; note a warning for an assumed unit."""
        assumed = taken_for(self.file, connection, source, target)
        if assumed is None:
            return connection.conversion or source.conversion(target) or (1.0, 0.0)
        warning = f"{connection.target} {assumed.sentence}"
        if assumed.sentence and warning not in self.diagnosis.warnings:  # once for all elements of an array
            self.diagnosis.warnings.append(warning)
        return assumed.factor, assumed.offset

    def _ends(self, where: Place, text: str, side: str) -> list[Signal]:
        """Return the signals of a connection's end; note a fault if none."""
        name, _, variable = text.partition(".")
        if name not in self.file.scenario.components and name not in self.file.broken:
            hint = did_you_mean(name, self.file.scenario.components)
            self.diagnosis.note(where, f'no component "{name}"{hint}')
            return []
        component = self.components.get(name)
        if component is None or name in self.file.broken:  # Another check reports this component.
            return []
        known = self._signals(component, side)
        if variable in known:
            return known[variable]
        other = "inputs" if side == "outputs" else "outputs"
        if variable in self._signals(component, other):
            message = f"{text} is one of the {other} of {name}; an output goes to an input"
        elif any(s.local and s.name == variable for s in _signals(component, side)):
            message = f"{text} is recorded, but no output of {name}; an output goes to an input"
        else:
            message = f'{name} has no {side[:-1]} "{variable}"{did_you_mean(variable, known)}'
            message += f" (its {side}: {_some(known)})"
        self.diagnosis.note(where, message)
        return []

    def _signals(self, component: Component, side: str) -> dict[str, list[Signal]]:
        """Return signals by name, and elements by name of their array."""
        key = component.name, side
        if key not in self._known:
            found = self._known[key] = {}
            for signal in _signals(component, side):
                if not signal.local:
                    found.setdefault(signal.name, []).append(signal)
                    if signal.array:
                        found.setdefault(signal.array, []).append(signal)
        return self._known[key]


def _numbers(items: Mapping[str, int] | None) -> str:
    return _some([f"{name} {number}" for name, number in (items or {}).items()])


def _some(names: Collection[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(islice(names, MOST_NAMED)) or 'none'}{more}"


def _signals(component: Component, side: str) -> tuple[Signal, ...]:
    both: tuple[Signal, ...] = (*getattr(component, side), *getattr(component, f"exact_{side}"))
    return both


def _check_faults(file: ScenarioFile, diagnosis: Diagnosis) -> None:
    """Note faults of injected faults.

    Each must act on a connection, within the run, and have its required keys.
    """
    scenario = file.scenario
    targets = dict.fromkeys(c.target for c in scenario.connections)
    needs = {"bias": "value", "scale": "value", "stuck": "value", "spike": "value", "delay": "delay"}
    needs["dropout"] = "probability"
    for k, fault in zip(file.places["faults"], scenario.faults, strict=True):
        if fault.on not in targets and fault.on.partition("[")[0] not in targets:
            hint = did_you_mean(fault.on, targets) or f" (connected: {_some(targets)})"
            diagnosis.note(("faults", k, "on"), f"no connection to {fault.on}{hint}")
        if getattr(scenario.components.get(fault.on.partition(".")[0]), "step", None) is not None:
            cure = "faults act on components that step with the scenario"
            diagnosis.note(("faults", k, "on"), f"{fault.on} is of a component with a step of its own; {cure}")
        needed = needs.get(fault.kind)
        if needed is not None and getattr(fault, needed) is None:
            diagnosis.note(("faults", k), f"{fault.kind} needs {needed}")
        made = 0.0 if fault.delay is None else whole(fault.delay, scenario.step) * scenario.step
        if fault.delay is not None and abs(made - fault.delay) > 1e-9 * made:
            rounded = f"no whole number of steps: it is {made:g} s"
            diagnosis.warnings.append(f"a delay of {fault.delay:g} s on {fault.on} is {rounded}")
        first, last = points(fault.begin, fault.end, scenario.start_time, scenario.step, scenario.steps + 1)
        if not max(0, first) <= min(last, scenario.steps):
            end = scenario.start_time + scenario.duration
            diagnosis.note(("faults", k), f"acts at no communication point of {scenario.start_time:g} … {end:g} s")


def _check_sources(file: ScenarioFile, diagnosis: Diagnosis) -> None:
    """Note a fault for each input with two sources."""
    seen: dict[str, str] = {}
    for k, connection in zip(file.places["connections"], file.scenario.connections, strict=True):
        if connection.target in seen:
            both = f"{seen[connection.target]} and {connection.source}"
            diagnosis.note(("connections", k, "to"), f"two sources for {connection.target}: {both}; keep one")
        seen.setdefault(connection.target, connection.source)


def unconnected(file: ScenarioFile, components: Components) -> Iterator[str]:
    """Yield a warning for each component with unconnected inputs.

    Inputs with a value in the scenario do not count.
    """
    fed = {c.target for c in file.scenario.connections}
    fed |= {target for event in file.scenario.events for target in event.set}
    for name, component in components.items():
        declared = file.scenario.components[name]
        given = declared.start if isinstance(declared, FmuComponent) else {}
        free = [
            s.name
            for s in _signals(component, "inputs")
            if fed.isdisjoint({f"{name}.{s.name}", f"{name}.{s.array}"}) and given.keys().isdisjoint({s.name, s.array})
        ]
        if free and isinstance(declared, FixComponent):
            yield f"not connected, so its fixes are of 0: {_some([f'{name}.{s}' for s in free])}"
        elif free:
            yield f"not connected, at the start value of the FMU: {_some([f'{name}.{s}' for s in free])}"
