"""From a scenario to components laid out in one row of signals, in the order in which they step.

Every check that needs the FMUs' descriptions is made here; all faults are told at once.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.blocks.fmu import FmuBlock, read_description
from cosim.blocks.interface import Component, Signal
from cosim.blocks.noise import gaussian, stream
from cosim.blocks.sources import playback, reference
from cosim.errors import Fault, FmuError, InputError
from cosim.simulation.order import AlgebraicLoop, stages
from cosim.simulation.scenario import Connection, FmuComponent, Noise, PlaybackComponent, ReferenceComponent
from cosim.simulation.scenario_file import ScenarioFile
from cosim.simulation.start_values import Misfit, kind_of, settable, typed
from cosim.yaml_file import did_you_mean

Place = tuple[str | int, ...]


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


@dataclass(frozen=True)
class Stage:
    """A component and the transfers made right before it steps."""

    component: Component
    pulls: tuple[Transfer, ...] = ()


@dataclass(frozen=True)
class System:
    """Everything the master needs.

    stages: in the order in which they step
    held:   transfers made at the end of a step: their targets see the values of the step's start
    """

    stages: tuple[Stage, ...]
    held: tuple[Transfer, ...]
    columns: tuple[str, ...]
    units: Mapping[str, str]
    seed: int = 0
    start: float = 0.0
    warnings: tuple[str, ...] = ()
    fmus: Mapping[str, tuple[Path, Any]] = field(default_factory=dict)


def build_system(file: ScenarioFile, start_values: Mapping[str, Mapping[str, float]] | None = None) -> System:
    """System of a scenario; `start_values` by component are put under the scenario's own (designed gains)."""
    return _Builder(file, start_values or {}).build()


class _Builder:
    """Collects faults while the parts are put together."""

    def __init__(self, file: ScenarioFile, designed: Mapping[str, Mapping[str, float]]) -> None:
        self.file, self.scenario, self.designed = file, file.scenario, designed
        self.faults: list[Fault] = list(file.faults)
        self.warnings: list[str] = []
        self.components: dict[str, Component] = {}
        self.fmus: dict[str, tuple[Path, Any]] = {}

    def build(self) -> System:
        for name, component in self.scenario.components.items():
            self._component(name, component)
        whole = len(self.components) == len(self.scenario.components) and not self.file.broken
        self._check_design()
        first, columns, units = self._lay_out()
        transfers = [
            t for k, c in enumerate(self.scenario.connections) if (t := self._transfer(k, c, first)) is not None
        ]
        self._check_sources()
        self._check_signals_of_criteria(set(columns), whole)
        ordered: tuple[Stage, ...] = ()
        held: tuple[Transfer, ...] = ()
        if whole and len(transfers) == len(self.scenario.connections):
            ordered, held = self._order(transfers)
        if self.faults:
            raise InputError(self.faults)
        self._report_unconnected()
        return System(
            ordered, held, columns, units, self.scenario.seed, self.scenario.start_time, tuple(self.warnings), self.fmus
        )

    # -- components ---------------------------------------------------------------------------

    def _component(self, name: str, component: Any) -> None:
        where: Place = ("components", name)
        try:
            if isinstance(component, FmuComponent):
                self._fmu(name, component)
            elif isinstance(component, ReferenceComponent):
                self.components[name] = reference(name, component.signals)
            elif isinstance(component, PlaybackComponent):
                self.components[name] = playback(name, self.file.resolve(component.file))
        except InputError as error:
            self.faults += error.faults
        except FmuError as error:
            self.faults.append(self.file.fault((*where, "fmu"), str(error), exit_code=3))

    def _fmu(self, name: str, component: FmuComponent) -> None:
        path = self.file.resolve(component.fmu)
        where: Place = ("components", name, "fmu")
        if not path.is_file():
            cure = (
                f'; "cosim build --out {path.parent}" makes it' if path.name in {"plant.fmu", "controller.fmu"} else ""
            )
            self.faults.append(self.file.fault(where, f"no such FMU: {path}{cure}"))
            return
        description = read_description(path)
        values = {**self.designed.get(name, {}), **component.start}
        start = {
            variable: v
            for variable, given in values.items()
            if (v := self._start(name, description, variable, given)) is not None
        }
        connected = frozenset(
            c.target.partition(".")[2] for c in self.scenario.connections if c.target.startswith(f"{name}.")
        )
        self.fmus[name] = (path, description)
        self.components[name] = FmuBlock(name, path, description, start, connected)

    def _start(self, name: str, description: Any, variable_name: str, given: Any) -> Any:
        """A start value in the type and unit of its variable; a fault and None where it does not fit."""
        where: Place = ("components", name, "start", variable_name)
        variable = next((v for v in description.modelVariables if v.name == variable_name), None)
        if variable is None:
            known = [v.name for v in description.modelVariables if settable(v)]
            self.faults.append(
                self.file.fault(where, f'{name} has no variable "{variable_name}"{did_you_mean(variable_name, known)}')
            )
            return None
        if not settable(variable):
            self.faults.append(
                self.file.fault(where, f"{name}.{variable_name} is {kind_of(variable)}; it takes no start value")
            )
            return None
        value = typed(description, variable, given)
        if isinstance(value, Misfit):
            self.faults.append(self.file.fault(where, f"{name}.{variable_name} is {given!r}; {value.reason}"))
            return None
        return value

    # -- signals and connections --------------------------------------------------------------

    def _lay_out(self) -> tuple[dict[str, int], tuple[str, ...], dict[str, str]]:
        first: dict[str, int] = {}
        columns: list[str] = []
        units: dict[str, str] = {}
        for name, component in self.components.items():
            first[name] = len(columns)
            for signal in (*component.inputs, *component.outputs):
                columns.append(f"{name}.{signal.name}")
                units[columns[-1]] = signal.unit
        return first, tuple(columns), units

    def _transfer(self, k: int, connection: Connection, first: Mapping[str, int]) -> Transfer | None:
        k = self.file.connection_lines[k]
        source = self._end(("connections", k, "from"), connection.source, "outputs", "inputs")
        target = self._end(("connections", k, "to"), connection.target, "inputs", "outputs")
        if source is None or target is None:
            return None
        (source_component, i, source_signal), (target_component, j, target_signal) = source, target
        if not source_signal.agrees(target_signal):
            self.faults.append(
                self.file.fault(
                    ("connections", k),
                    f"unit mismatch: {connection.source} [{source_signal.unit}] to "
                    f"{connection.target} [{target_signal.unit}]",
                )
            )
        noise = connection.noise if self.scenario.noise else None
        at = first[source_component.name] + len(source_component.inputs) + i
        return Transfer(at, first[target_component.name] + j, connection.target, noise)

    def _end(self, where: Place, text: str, side: str, other_side: str) -> tuple[Component, int, Signal] | None:
        name, _, variable = text.partition(".")
        if name in self.file.broken:  # its own fault is told already
            return None
        if name not in self.scenario.components:
            self.faults.append(
                self.file.fault(where, f'no component "{name}"{did_you_mean(name, self.scenario.components)}')
            )
            return None
        component = self.components.get(name)
        if component is None:  # its own fault is told already
            return None
        signals: tuple[Signal, ...] = getattr(component, side)
        for k, signal in enumerate(signals):
            if signal.name == variable:
                return component, k, signal
        if any(s.name == variable for s in getattr(component, other_side)):
            message = f"{text} is one of the {other_side} of {name}; an output goes to an input"
        else:
            known = [s.name for s in signals]
            message = f'{name} has no {side[:-1]} "{variable}" of type Real{did_you_mean(variable, known)}'
            message += f" (its {side}: {', '.join(known) or 'none'})"
        self.faults.append(self.file.fault(where, message))
        return None

    def _check_sources(self) -> None:
        seen: dict[str, str] = {}
        for k, connection in zip(self.file.connection_lines, self.scenario.connections, strict=True):
            if connection.target in seen:
                message = (
                    f"two sources for {connection.target}: {seen[connection.target]} and {connection.source}; keep one"
                )
                self.faults.append(self.file.fault(("connections", k, "to"), message))
            seen.setdefault(connection.target, connection.source)

    def _check_design(self) -> None:
        design = self.scenario.design
        if design is None or design.component in self.file.broken:
            return
        if not isinstance(self.scenario.components.get(design.component), FmuComponent):
            message = f'design is for component "{design.component}", which is no FMU of components'
            self.faults.append(self.file.fault(("design",), message))

    def _check_signals_of_criteria(self, columns: set[str], whole: bool) -> None:
        for kind, k, criterion in self.scenario.goals:
            where: Place = ("criteria", kind, *(() if k is None else (k,)))
            for key, signal in (("of", criterion.of), ("to", criterion.to)):
                if isinstance(signal, str) and whole and signal not in columns:
                    self.faults.append(
                        self.file.fault((*where, key), f'no signal "{signal}"{did_you_mean(signal, columns)}')
                    )

    def _report_unconnected(self) -> None:
        fed = {c.target for c in self.scenario.connections}
        for name, component in self.components.items():
            declared = self.scenario.components[name]
            given = declared.start if isinstance(declared, FmuComponent) else {}
            free = [s.name for s in component.inputs if f"{name}.{s.name}" not in fed and s.name not in given]
            if free:
                self.warnings.append(
                    f"not connected, at the start value of the FMU: {', '.join(f'{name}.{s}' for s in free)}"
                )

    # -- order --------------------------------------------------------------------------------

    def _order(self, transfers: list[Transfer]) -> tuple[tuple[Stage, ...], tuple[Transfer, ...]]:
        if self.scenario.algorithm == "jacobi":
            return tuple(Stage(c) for c in self.components.values()), tuple(transfers)
        edges = [
            (c.source.partition(".")[0], c.target.partition(".")[0], c.target.partition(".")[2])
            for c in self.scenario.connections
        ]
        if self.scenario.order is not None and not self._check_order(self.scenario.order):
            return (), ()
        try:
            order, immediate, notes = stages(self.components, edges, self.scenario.order)
        except AlgebraicLoop as loop:
            message = (
                f"algebraic loop under gauss-seidel: {' → '.join(loop.cycle)}; each needs the other's value of the "
                f"same time. State their order (order: [{', '.join(sorted(set(loop.cycle)))}]) or algorithm: jacobi"
            )
            self.faults.append(self.file.fault(("connections",), message))
            return (), ()
        self.warnings += notes
        now = [t for t, is_now in zip(transfers, immediate, strict=True) if is_now]
        held = tuple(t for t, is_now in zip(transfers, immediate, strict=True) if not is_now)
        pulls = {n: tuple(t for t in now if t.name.partition(".")[0] == n) for n in order}
        return tuple(Stage(self.components[n], pulls[n]) for n in order), held

    def _check_order(self, order: list[str]) -> bool:
        missing = self.components.keys() - set(order)
        fmus_missing = sorted(n for n in missing if self.components[n].inputs)
        unknown = [n for n in order if n not in self.components]
        for n in unknown:
            self.faults.append(self.file.fault(("order",), f'no component "{n}"{did_you_mean(n, self.components)}'))
        if fmus_missing or len(set(order)) != len(order):
            self.faults.append(
                self.file.fault(
                    ("order",),
                    f"order names every component with inputs once; missing: {', '.join(fmus_missing) or 'none'}",
                )
            )
        return not (unknown or fmus_missing or len(set(order)) != len(order))
