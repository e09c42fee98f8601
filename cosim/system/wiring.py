"""Layout of signals in a row, and connections as transfers between places."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Any

from cosim.blocks.component import Component, Signal
from cosim.blocks.faults import LinkFunction, fault_function, gaussian, points, stream
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.stepping import LinkKind
from cosim.core.errors import SimulationError
from cosim.core.messages import with_prefix
from cosim.core.text import did_you_mean
from cosim.core.times import whole_steps
from cosim.core.units import UnitAssumption, assume_si
from cosim.fmi.fmi_types import input_aliases, is_compatible, negative
from cosim.scenario.scenario import (
    Connection,
    Disturbance,
    FixComponent,
    FmuComponent,
    Noise,
    PlaybackComponent,
    ReferenceComponent,
)
from cosim.scenario.scenario_file import Diagnosis, Place, ScenarioFile

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
        is_clock: Whether clocks are connected, whose ticks are no values to copy.
        of: For an input that shares the value reference of a connected one, the name of that one.
        sign: Factor and offset of this input's value from that one's.
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
    is_clock: bool = False
    of: str = ""
    sign: tuple[float, float] = (1.0, 0.0)

    def check_item(self, value: Any, t: float) -> None:
        """Raise SimulationError if a value is no item of the target enumeration."""
        if self.items is not None and value not in self.items.values():
            message = f"{value:g}, which comes from {self.origin}, is none of its items: {_numbers(self.items)}"
            raise SimulationError(self.name, t, message)

    def through(self, seed: int, start: float, step: float, count: int) -> tuple[LinkFunction, ...]:
        """Return the value's conversions in order: unit, noise, faults, sign of an alias."""
        chain: list[LinkFunction] = []
        if self.factor != 1.0 or self.offset != 0.0:
            chain.append(LinkFunction(LinkKind.AFFINE, a=self.factor, b=self.offset))
        if self.noise is not None:
            rng = stream(seed, self.of or self.name)
            samples = gaussian(rng, self.noise.variance, self.noise.bias, count)
            chain.append(LinkFunction(LinkKind.ADDED, values=samples))
        for number, fault in enumerate(self.faults):
            window = points(fault.begin, fault.end, start, step, count)
            rng = stream(seed, f"{self.of or self.name} {fault.kind} {number}")
            delay = 0 if fault.delay is None else whole_steps(fault.delay, step)
            settings = {"value": fault.value, "probability": fault.probability, "delay": delay}
            chain.append(fault_function(fault.kind, window, count, rng, **settings))  # type: ignore[arg-type]
        if self.sign != (1.0, 0.0):
            chain.append(LinkFunction(LinkKind.AFFINE, a=self.sign[0], b=self.sign[1]))
        if self.items is not None:
            chain.append(_Checked(self, start, step))
        return tuple(chain)


class _Checked(LinkFunction):
    """A check that a value is an item of the target enumeration."""

    def __init__(self, transfer: Transfer, start: float, step: float) -> None:
        super().__init__(LinkKind.ITEMS, values=array("d", (transfer.items or {}).values()))
        self.transfer, self.start, self.step = transfer, start, step

    def __call__(self, k: int, v: Any) -> Any:
        if k:  # Values may be undefined until initialization ends.
            self.transfer.check_item(v, self.start + k * self.step)
        return v


def through(chain: Sequence[LinkFunction]) -> Callable[[int, Any], Any]:
    """Return one function that applies all functions of a chain in turn."""

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
    """Return the transfers of each connection, for arrays one per element; none for a faulty connection."""
    sources: dict[str, str] = {}
    connections = [*zip(file.places["connections"], file.scenario.connections, strict=True)]
    for k, connection in connections:
        if (target := connection.target) in sources:
            message = f"two sources for {target}: {sources[target]} and {connection.source}; keep one"
            diagnosis.note(("connections", k, "to"), message)
        sources.setdefault(target, connection.source)
    _check_faults(file, diagnosis)
    wiring = _Wiring(file, components, layout, diagnosis)
    return [wiring.transfers(k, connection) for k, connection in connections]


def alias_transfers(
    components: Components, layout: RowLayout, connections: Sequence[Sequence[Transfer]], diagnosis: Diagnosis
) -> tuple[Transfer, ...]:
    """Return the transfers that show the values of connected inputs in unconnected inputs of their value references.

    Two sources of one value reference are a fault.
    """
    fed = {t.name: (t, k) for k, transfers in enumerate(connections) for t in transfers}
    found: dict[str, Transfer] = {}
    for owner, component in components.items():
        for name, others in input_aliases(component.description).items() if isinstance(component, FmuBlock) else ():
            transfer, k = fed.get(f"{owner}.{name}", (None, 0))
            if transfer is None:
                continue
            for other, is_negative in others.items():
                full = f"{owner}.{other}"
                if full not in fed and full in layout.place:
                    aside, place = layout.place[full]
                    sign = (-1.0, negative(layout.signals[full].kind, 0.0)) if is_negative else (1.0, 0.0)
                    sides = transfer.beside[0], aside
                    found[full] = replace(transfer, target=place, name=full, beside=sides, of=transfer.name, sign=sign)
                elif full in fed and fed[full][1] < k and (is_negative or fed[full][0].origin != transfer.origin):
                    message = (
                        f"{transfer.name} and {full} are one variable of the FMU with two sources: {transfer.origin} "
                        f"and {fed[full][0].origin}; keep one"
                    )
                    diagnosis.note(("connections", k, "to"), message)
    return tuple(found.values())


def assumed_conversion(
    file: ScenarioFile, connection: Connection, source: Signal, target: Signal
) -> UnitAssumption | None:
    """Return the conversion to SI for an input without unit; None without conversion.

    Only references and recordings are converted, because people write their units.
    """
    component = file.scenario.components.get(connection.source.partition(".")[0])
    written = isinstance(component, ReferenceComponent | PlaybackComponent) and source.unit
    if not written or target.unit or target.is_whole or connection.conversion is not None:
        return None
    return assume_si(source.unit, "its FMU", f"give {connection.source} no unit")


def _objection(connection: Connection, source: Signal, target: Signal) -> str:
    """Return the objection to a connection, or ""."""
    ends = f"{connection.source} is {source.kind or 'a number'}, {connection.target} is {target.kind}"
    if not is_compatible(source.kind, target.kind):
        return f"types do not agree: {ends}"
    if source.declared and source.declared == target.declared and source.items != target.items:
        return (
            f"enumerations of one name, {source.declared}, with other items: {connection.source} has "
            f"{_numbers(source.items)}, {connection.target} has {_numbers(target.items)}"
        )
    if connection.conversion is None and source.conversion(target) is None:
        reason = f"unit mismatch: {connection.source} [{source.unit}] to {connection.target} [{target.unit}]"
        if source.unit == target.unit:
            reason += ", which their FMUs define with different dimensions"
        return f"{reason}. To pass the number unchanged, add factor: 1"
    return ""


class _Wiring:
    """Connections under construction: their ends, each a signal or the elements of an array, and the transfers."""

    def __init__(self, file: ScenarioFile, components: Components, layout: RowLayout, diagnosis: Diagnosis) -> None:
        self.file, self.components, self.layout, self.diagnosis = file, components, layout, diagnosis
        self._by_side: dict[tuple[str, str], dict[str, list[Signal]]] = {}
        self._faults: dict[str, list[Disturbance]] = {}
        for fault in file.scenario.faults:
            self._faults.setdefault(fault.on, []).append(fault)

    def transfers(self, k: int, connection: Connection) -> tuple[Transfer, ...]:
        """Return the transfers of a connection, none for a faulty connection; note faults."""
        sources = self._ends(("connections", k, "from"), connection.source, "outputs")
        targets = self._ends(("connections", k, "to"), connection.target, "inputs")
        if not sources or not targets:
            return ()
        ends = f"{connection.source} to {connection.target}"
        if len(sources) != len(targets):
            message = f"{ends}: {len(sources)} values do not go to {len(targets)}"
            self.diagnosis.note(("connections", k), message)
            return ()
        try:
            return tuple(self._transfer(connection, *pair) for pair in zip(sources, targets, strict=True))
        except ValueError as error:
            self.diagnosis.note(("connections", k), str(error))
            return ()

    def _transfer(self, connection: Connection, source: Signal, target: Signal) -> Transfer:
        """Return the transfer between two signals; raise ValueError if they do not fit."""
        if objection := _objection(connection, source, target):
            raise ValueError(objection)
        ends = f"{connection.source} to {connection.target}"
        origin = f"{connection.source.partition('.')[0]}.{source.name}"
        name = f"{connection.target.partition('.')[0]}.{target.name}"
        (from_beside, at), (to_beside, to) = self.layout.place[origin], self.layout.place[name]
        faults = tuple(f for key in dict.fromkeys((connection.target, name)) for f in self._faults.get(key, ()))
        if target.kind == "Clock":
            if connection.noise or connection.conversion is not None or name in self._faults:
                raise ValueError(f"{ends}: no factor, offset, noise or fault acts on a clock")
            return Transfer(at, to, name, origin=origin, is_clock=True)
        noise = connection.noise if self.file.scenario.noise else None
        factor, offset = connection.conversion or source.conversion(target) or (1.0, 0.0)
        if (assumed := assumed_conversion(self.file, connection, source, target)) is not None:
            factor, offset = assumed.factor, assumed.offset
            warning = with_prefix(f"{connection.target} ", assumed.sentence)
            if assumed.sentence and warning not in self.diagnosis.warnings:  # once for all elements of an array
                self.diagnosis.warnings.append(warning)
        changes = [f"{fault.kind} fault" for fault in faults if fault.kind not in PASSING]
        changes += ["noise or factor"] if noise or (factor, offset) != (1.0, 0.0) else []
        if changes and (from_beside or to_beside):
            raise ValueError(f"{ends}: no {' or '.join(changes)} on {source.kind or target.kind}")
        sides = from_beside, to_beside
        return Transfer(at, to, name, noise, factor, offset, faults, sides, target.items, origin)

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
        signals = self._signals(component, side)
        if variable in signals:
            return signals[variable]
        other = "inputs" if side == "outputs" else "outputs"
        if variable in self._signals(component, other):
            message = f"{text} is one of the {other} of {name}; an output goes to an input"
        elif any(s.local and s.name == variable for s in _signals(component, side)):
            message = f"{text} is recorded, but no output of {name}; an output goes to an input"
        else:
            hint = did_you_mean(variable, signals)
            message = f'{name} has no {side[:-1]} "{variable}"{hint} (its {side}: {_some(signals)})'
        self.diagnosis.note(where, message)
        return []

    def _signals(self, component: Component, side: str) -> dict[str, list[Signal]]:
        """Return name → signals of the inputs or outputs of a component, for an array all its elements."""
        key = component.name, side
        if key not in self._by_side:
            by_name = self._by_side[key] = {}
            for signal in _signals(component, side):
                for name in filter(None, (signal.name, signal.array)) if not signal.local else ():
                    by_name.setdefault(name, []).append(signal)
        return self._by_side[key]


def _numbers(items: Mapping[str, int] | None) -> str:
    return _some([f"{name} {number}" for name, number in (items or {}).items()])


def _some(names: Collection[str]) -> str:
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return f"{', '.join(islice(names, MOST_NAMED)) or 'none'}{more}"


def _signals(component: Component, side: str) -> tuple[Signal, ...]:
    both: tuple[Signal, ...] = (*getattr(component, side), *getattr(component, f"exact_{side}"))
    return both


def _check_faults(file: ScenarioFile, diagnosis: Diagnosis) -> None:
    """Check the faults injected by a scenario: each acts on a connection, within the run, with its required keys."""
    scenario = file.scenario
    targets = dict.fromkeys(c.target for c in scenario.connections)
    needs = {"delay": "delay", "dropout": "probability"} | dict.fromkeys(("bias", "scale", "stuck", "spike"), "value")
    for k, fault in zip(file.places["faults"], scenario.faults, strict=True):
        if fault.on not in targets and fault.on.partition("[")[0] not in targets:
            hint = did_you_mean(fault.on, targets) or f" (connected: {_some(targets)})"
            diagnosis.note(("faults", k, "on"), f"no connection to {fault.on}{hint}")
        if getattr(scenario.components.get(fault.on.partition(".")[0]), "step", None) is not None:
            message = (
                f"{fault.on} is of a component with a step of its own; faults act on components that step with the "
                "scenario"
            )
            diagnosis.note(("faults", k, "on"), message)
        key = needs.get(fault.kind)
        if key is not None and getattr(fault, key) is None:
            diagnosis.note(("faults", k), f"{fault.kind} needs {key}; add it")
        rounded = 0.0 if fault.delay is None else whole_steps(fault.delay, scenario.step) * scenario.step
        if fault.delay is not None and abs(rounded - fault.delay) > 1e-9 * rounded:
            message = f"a delay of {fault.delay:g} s on {fault.on} is no whole number of steps: it is {rounded:g} s"
            diagnosis.warnings.append(message)
        first, last = points(fault.begin, fault.end, scenario.start_time, scenario.step, scenario.steps + 1)
        if not max(0, first) <= min(last, scenario.steps):
            end = scenario.start_time + scenario.duration
            diagnosis.note(("faults", k), f"acts at no communication point of {scenario.start_time:g} … {end:g} s")


def connection_warnings(file: ScenarioFile, components: Components) -> Iterator[str]:
    """Yield a warning for each component with unconnected inputs that have no value in the scenario."""
    driven = file.scenario.targets
    driven |= {target for event in file.scenario.events for target in event.set}
    for name, component in components.items():
        declared = file.scenario.components[name]
        start = {*declared.start} if isinstance(declared, FmuComponent) else set[str]()
        aliases = input_aliases(component.description) if isinstance(component, FmuBlock) else {}
        start |= {other for v, others in aliases.items() if v in start or f"{name}.{v}" in driven for other in others}
        free = [
            f"{name}.{s.name}"
            for s in _signals(component, "inputs")
            if s.kind != "Clock"
            and driven.isdisjoint({f"{name}.{s.name}", f"{name}.{s.array}"})
            and start.isdisjoint({s.name, s.array})
        ]
        if free:
            where = "not connected, at the start value of the FMU"
            if isinstance(declared, FixComponent):
                where = "inputs not connected, so their fixes are 0"
            yield f"{where}: {_some(free)}"
