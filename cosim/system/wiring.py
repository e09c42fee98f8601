"""A system under construction: indices of signals in a row, and connections as transfers between indices."""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from cosim.blocks.component import Component, Signal
from cosim.blocks.faults import LinkFunction, fault_function, gaussian, points, stream
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.sources import SourceBlock
from cosim.blocks.stepping import LinkKind
from cosim.core.errors import Fault, InputError, SimulationError
from cosim.core.messages import with_prefix
from cosim.core.text import did_you_mean, some
from cosim.core.times import whole_steps
from cosim.core.units import assume_si
from cosim.files.yaml_file import MOST_FAULTS
from cosim.fmi.description import read_description
from cosim.fmi.fmi_types import input_aliases, is_compatible, negative
from cosim.scenario.scenario import (
    Connection,
    Disturbance,
    FixComponent,
    FmuComponent,
    Noise,
    Place,
)
from cosim.scenario.scenario_file import ScenarioFile

Components = Mapping[str, Component]
MAX_NAMED_SIGNALS = 20  # signals shown in a message
MAX_MESSAGE_CHARACTERS = 2000
PASSING = {"freeze", "dropout", "delay"}  # faults that pass values of any type unchanged


class Building:
    """A system under construction. Faults and warnings are collected and reported all at once, faults of form first.

    Attributes:
        components: Components without faults by name, in file order.
        columns: Names `component.variable` by index in the row: component after component, inputs before outputs.
        beside: Names, like `columns`, of values that doubles cannot represent exactly.
        place: Column → (True if beside the row, index in or beside the row).
        signals: Column → signal.
        describe: Function that returns the model description of an FMU, which several components may use.
    """

    columns: tuple[str, ...]
    beside: tuple[str, ...]
    place: Mapping[str, tuple[bool, int]]
    signals: Mapping[str, Signal]

    def __init__(self, file: ScenarioFile) -> None:
        self.file, self.scenario, self.components = file, file.scenario, dict[str, Component]()
        self.describe = cache(read_description)
        self.faults: list[Fault] = list(file.faults)
        self.warnings: list[str] = list(file.warnings)

    def note(self, where: Place, message: str, exit_code: int = 2) -> None:
        """Record a fault at a place of the scenario; raise InputError at the limit of faults."""
        if len(message) > MAX_MESSAGE_CHARACTERS:
            message = f"{message[: MAX_MESSAGE_CHARACTERS - 1]}…"
        self.faults.append(self.file.fault(where, message, exit_code=exit_code))
        if len(self.faults) >= MOST_FAULTS:
            raise InputError([*self.faults, Fault(self.file.path, 0, 0, f"the first {MOST_FAULTS} faults are shown")])

    def lay_out(self) -> None:
        """Assign an index to each signal of the components."""
        row: dict[str, Signal] = {}
        beside: dict[str, Signal] = {}
        for name, component in self.components.items():
            row |= {f"{name}.{s.name}": s for s in (*component.inputs, *component.outputs)}
            beside |= {f"{name}.{s.name}": s for s in (*component.exact_inputs, *component.exact_outputs)}
        self.columns, self.beside, self.signals = tuple(row), tuple(beside), row | beside
        self.place = {c: (aside, k) for aside, part in ((False, row), (True, beside)) for k, c in enumerate(part)}

    @cached_property
    def connected(self) -> dict[str, frozenset[str]]:
        """Return the connected inputs of each component."""
        inputs: dict[str, set[str]] = {}
        for connection in self.scenario.connections:
            _, _, name, variable = connection.ends
            inputs.setdefault(name, set()).add(variable)
        return {name: frozenset(variables) for name, variables in inputs.items()}

    @property
    def blocks(self) -> dict[str, FmuBlock]:
        """Return the FMUs among the components."""
        return {name: c for name, c in self.components.items() if isinstance(c, FmuBlock)}


@dataclass(frozen=True)
class Transfer:
    """A connection between two indices, with unit conversion, noise and injected faults.

    Attributes:
        name: Target as `component.variable`, also the name of the transfer's random stream.
        items: Items of the target if it is an enumeration. origin: Name of the source.
        beside: True if source and target are beside the row.
        is_clock: True if clocks are connected; their ticks are not values to copy.
        of: For an input with the value reference of a connected input, the name of the connected input.
        sign: Factor and offset from the value of input `of` to the value of this input.
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
        """Raise SimulationError if a value is not an item of the target enumeration."""
        if self.items is not None and value not in self.items.values():
            raise SimulationError(
                self.name, t, f"{value:g} from {self.origin} is not an item of the enumeration: {_numbers(self.items)}"
            )

    def through(self, seed: int, start: float, step: float, count: int) -> tuple[LinkFunction, ...]:
        """Return the functions that change the value, in order: unit, noise, faults, sign of an alias."""
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
        if k:  # values may be undefined during initialization
            self.transfer.check_item(v, self.start + k * self.step)
        return v


Copies = Callable[[int], None]  # function that makes the copies of a communication point


class Copying:
    """Transfers of a run with sensor noise and injected faults, prepared once.

    Attributes:
        links: Name of a transfer → noise and faults that change its value.
        functions: Name of a transfer → function of (point, value) that applies them.

    Args:
        row, beside: Signals of the run.
        grid: Seed, start [s], communication step [s], and number of communication points.
    """

    def __init__(self, row: Any, beside: list[Any], grid: tuple[int, float, float, int]) -> None:
        self._row, self._beside, self._grid = row, beside, grid
        self._values = np.ctypeslib.as_array(row)
        self.links: dict[str, Sequence[LinkFunction]] = {}
        self.functions: dict[str, Callable[[int, Any], Any]] = {}

    def of(self, transfers: Iterable[Transfer]) -> Copies:
        """Return a function that makes transfers: all plain copies within the row at once, then the others."""
        sources, targets = list[int](), list[int]()  # of plain copies
        others: list[tuple[Any, int, Any, int, Callable[[int, Any], Any]]] = []  # from a place to a place by a function
        for transfer in transfers:
            if transfer.name not in self.links:
                chain = self.links[transfer.name] = transfer.through(*self._grid)
                self.functions[transfer.name] = chain[0] if len(chain) == 1 else partial(_apply, chain)
            source, target = transfer.source, transfer.target
            if self.links[transfer.name] or any(transfer.beside):
                origin, goal = (self._beside if beside else self._row for beside in transfer.beside)
                others.append((origin, source, goal, target, self.functions[transfer.name]))
            else:
                sources.append(source)
                targets.append(target)
        values, from_, to = self._values, np.array(sources, np.intp), np.array(targets, np.intp)

        def copy(k: int) -> None:
            if sources:
                values[to] = values[from_]
            for origin, source, goal, target, function in others:
                goal[target] = function(k, origin[source])

        return copy


def _apply(chain: Sequence[LinkFunction], k: int, value: Any) -> Any:
    """Return the value at point k after all functions of a chain."""
    for function in chain:
        value = function(k, value)
    return value


def connect(building: Building) -> list[tuple[Transfer, ...]]:
    """Return the transfers of each connection (one per element of an array); none for a faulty connection."""
    sources: dict[str, str] = {}
    connections = [*zip(building.file.places["connections"], building.scenario.connections, strict=True)]
    for k, connection in connections:
        if (target := connection.target) in sources:
            building.note(
                ("connections", k, "to"),
                f"two sources for {target}: {sources[target]} and {connection.source}; keep one",
            )
        sources.setdefault(target, connection.source)
    _check_faults(building)
    ends: dict[str, dict[str, list[Signal]]] = {"inputs": {}, "outputs": {}}
    for side, by_name in ends.items():
        for name, component in building.components.items():
            for signal in (signal for signal in _signals(component, side) if not signal.local):
                for label in filter(None, (signal.name, signal.array)):
                    by_name.setdefault(f"{name}.{label}", []).append(signal)
    return [_transfers(building, ends, k, connection) for k, connection in connections]


def alias_transfers(building: Building, connections: Sequence[Sequence[Transfer]]) -> tuple[Transfer, ...]:
    """Return transfers from connected inputs to unconnected inputs that share their value references.

    Two different sources for one value reference are a fault.
    """
    fed = {t.name: (t, k) for k, transfers in enumerate(connections) for t in transfers}
    found: dict[str, Transfer] = {}
    for owner, block in building.blocks.items():
        for name, others in input_aliases(block.description).items():
            transfer, k = fed.get(f"{owner}.{name}", (None, 0))
            if transfer is None:
                continue
            for other, is_negative in others.items():
                full = f"{owner}.{other}"
                if full not in fed and full in building.place:
                    aside, place = building.place[full]
                    sign = (-1.0, negative(building.signals[full].kind, 0.0)) if is_negative else (1.0, 0.0)
                    sides = transfer.beside[0], aside
                    found[full] = replace(transfer, target=place, name=full, beside=sides, of=transfer.name, sign=sign)
                elif full in fed and fed[full][1] < k and (is_negative or fed[full][0].origin != transfer.origin):
                    building.note(
                        ("connections", k, "to"),
                        f"{transfer.name} and {full} share a value reference but have two sources: {transfer.origin} "
                        f"and {fed[full][0].origin}; keep one",
                    )
    return tuple(found.values())


def _transfers(
    building: Building, ends: Mapping[str, Mapping[str, Sequence[Signal]]], k: int, connection: Connection
) -> tuple[Transfer, ...]:
    """Return the transfers of connection number k; none for a faulty connection, whose faults are recorded.

    Args:
        ends: Side (output or input) → `component.variable` → its signal, or the elements of its array.
    """
    found: list[Sequence[Signal]] = []
    for text, side, other, key in (
        (connection.source, "outputs", "inputs", "from"),
        (connection.target, "inputs", "outputs", "to"),
    ):
        name, _, variable = text.partition(".")
        where, declared = ("connections", k, key), building.scenario.components
        if name in building.file.broken or (name in declared and name not in building.components):
            continue  # another check reports the fault of this component
        if text in ends[side]:
            found.append(ends[side][text])
        elif name not in declared:
            building.note(where, f'no component "{name}"{did_you_mean(name, declared)}')
        elif text in ends[other]:
            building.note(where, f"{text} is one of the {other} of {name}; connect an output to an input")
        else:
            names = [end.partition(".")[2] for end in ends[side] if end.startswith(f"{name}.")]
            hint, listed = did_you_mean(variable, names), some(names, MAX_NAMED_SIGNALS) or "none"
            building.note(where, f'{name} has no {side[:-1]} "{variable}"{hint} (its {side}: {listed})')
    if len(found) == 2:
        sources, targets = found
        try:
            if len(sources) != len(targets):
                raise ValueError(f"{len(sources)} values cannot be connected to {len(targets)}; connect equal sizes")
            return tuple(_transfer(building, connection, *pair) for pair in zip(sources, targets, strict=True))
        except ValueError as error:
            building.note(("connections", k), str(error))
    return ()


def _transfer(building: Building, connection: Connection, source: Signal, target: Signal) -> Transfer:
    """Return the transfer between two signals; raise ValueError if they cannot be connected."""
    scenario, ends = building.scenario, f"{connection.source} to {connection.target}"
    if not is_compatible(source.kind, target.kind):
        kinds = f"{source.kind or 'a number'} and {target.kind}"
        raise ValueError(f"{ends}: types do not agree, {kinds}; connect compatible types")
    if source.declared and source.declared == target.declared and source.items != target.items:
        items = f"{_numbers(source.items)}; {_numbers(target.items)}"
        raise ValueError(f"{ends}: enumerations {source.declared} with different items: {items}; connect equal ones")
    if connection.conversion is None and source.conversion(target) is None:
        units = f"{connection.source} [{source.unit}] to {connection.target} [{target.unit}], as defined by their FMUs"
        raise ValueError(f"unit mismatch: {units}. To pass the number unchanged, add factor: 1")
    owner, _, receiver, _ = connection.ends
    origin, name = f"{owner}.{source.name}", f"{receiver}.{target.name}"
    (from_beside, at), (to_beside, to) = (building.place[end] for end in (origin, name))
    faults = tuple(f for on in dict.fromkeys((connection.target, name)) for f in scenario.faults if f.on == on)
    if target.kind == "Clock":
        if connection.noise or connection.conversion is not None or any(fault.on == name for fault in faults):
            raise ValueError(f"{ends}: clocks accept no factor, offset, noise or fault; remove it")
        return Transfer(at, to, name, origin=origin, is_clock=True)
    noise = connection.noise if scenario.noise else None
    factor, offset = connection.conversion or source.conversion(target) or (1.0, 0.0)
    block = building.components[owner]
    # recorded signals that feed integers are held between rows
    if isinstance(block, SourceBlock) and target.is_whole:
        block.hold(source.name)
    is_written = isinstance(block, SourceBlock) and source.unit  # units of sources are written by people
    if is_written and not (target.unit or target.is_whole or connection.conversion):  # converted to SI
        assumed = assume_si(source.unit, "its FMU", f"remove the unit of {connection.source}")
        factor, offset = assumed.factor, assumed.offset
        warning = with_prefix(f"{connection.target} ", assumed.sentence)
        if assumed.sentence and warning not in building.warnings:  # warn once for all elements of an array
            building.warnings.append(warning)
    changes = [f"{fault.kind} fault" for fault in faults if fault.kind not in PASSING]
    changes += ["noise or factor"] if noise or (factor, offset) != (1.0, 0.0) else []
    if changes and (from_beside or to_beside):
        raise ValueError(f"{ends}: {source.kind or target.kind} accepts no {' or '.join(changes)}; remove it")
    return Transfer(at, to, name, noise, factor, offset, faults, (from_beside, to_beside), target.items, origin)


def _numbers(items: Mapping[str, int] | None) -> str:
    return some([f"{name} {number}" for name, number in (items or {}).items()], MAX_NAMED_SIGNALS)


def _signals(component: Component, side: str) -> tuple[Signal, ...]:
    both: tuple[Signal, ...] = (*getattr(component, side), *getattr(component, f"exact_{side}"))
    return both


def _check_faults(building: Building) -> None:
    """Check the injected faults of a scenario: connection, time within the run, required keys."""
    scenario = building.scenario
    targets = dict.fromkeys(c.target for c in scenario.connections)
    needs = {"delay": "delay", "dropout": "probability"} | dict.fromkeys(("bias", "scale", "stuck", "spike"), "value")
    for k, fault in zip(building.file.places["faults"], scenario.faults, strict=True):
        if fault.on not in targets and fault.on.partition("[")[0] not in targets:
            hint = did_you_mean(fault.on, targets) or f" (connected: {some([*targets], MAX_NAMED_SIGNALS)})"
            building.note(("faults", k, "on"), f"{fault.on} is not connected{hint}")
        if getattr(scenario.components.get(fault.on.partition(".")[0]), "step", None) is not None:
            building.note(("faults", k, "on"), f"{fault.on} belongs to a component with its own step; remove this step")
        key = needs.get(fault.kind)
        if key is not None and getattr(fault, key) is None:
            building.note(("faults", k), f"{fault.kind} needs {key}; add it")
        rounded = 0.0 if fault.delay is None else whole_steps(fault.delay, scenario.step) * scenario.step
        if fault.delay is not None and abs(rounded - fault.delay) > 1e-9 * rounded:
            message = (
                f"a delay of {fault.delay:g} s on {fault.on} is not a whole number of steps; it is rounded "
                f"to {rounded:g} s"
            )
            building.warnings.append(message)
        first, last = points(fault.begin, fault.end, scenario.start_time, scenario.step, scenario.steps + 1)
        if not max(0, first) <= min(last, scenario.steps):
            end = scenario.start_time + scenario.duration
            building.note(
                ("faults", k),
                f"is active at no communication point within {scenario.start_time:g} … {end:g} s; change its times",
            )


def connection_warnings(building: Building) -> Iterator[str]:
    """Yield a warning for each component with inputs that have neither a connection nor a value in the scenario."""
    driven = building.scenario.targets
    driven |= {target for event in building.scenario.events for target in event.set}
    for name, component in building.components.items():
        declared = building.scenario.components[name]
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
            where = "not connected; they keep the start value of the FMU"
            if isinstance(declared, FixComponent):
                where = "inputs not connected, so their fixes are 0"
            yield f"{where}: {some(free, MAX_NAMED_SIGNALS)}"
