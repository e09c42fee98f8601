"""Results and manifest of a run, as pages read them; missing entries are accepted."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from cosim.blocks.coupling import DEFAULT
from cosim.core.arrays import Array
from cosim.core.text import amount, displayed, plain
from cosim.files.results import Results
from cosim.report.panels import Trace
from cosim.report.template import Row

MIN_READINGS = 100  # readings of the current call, half a second, below which shares of the wall time are too uncertain


def mapping(value: Any) -> Mapping[str, Any]:
    """Return a value if it is a mapping, otherwise an empty mapping."""
    return value if isinstance(value, Mapping) else {}


def mappings(value: Any) -> list[Mapping[str, Any]]:
    """Return the mappings in a list; an empty list for other values."""
    return [item for item in value if isinstance(item, Mapping)] if isinstance(value, list | tuple) else []


def texts(value: Any) -> list[str]:
    """Return the items of a list as texts; a single text counts as a list of one."""
    return [
        str(item) for item in ([value] if isinstance(value, str) else value if isinstance(value, list | tuple) else ())
    ]


def number(value: Any, default: float = float("nan")) -> float:
    """Return a float, or the default if not numeric."""
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return default


@dataclass(frozen=True)
class ComponentPage:
    """Sections on some components, which are added to the page of a run.

    Attributes:
        template: Extends run.html.j2.
        values: Values of the template besides the values of every page.
        tiles: Key figures, by default those of the criteria.
        shown: Columns in these sections, omitted from the signals.
        data: Data of the script.
    """

    template: Path
    values: Mapping[str, Any] = field(default_factory=dict)
    tiles: Sequence[Row] = ()
    shown: frozenset[str] = frozenset()
    data: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Run:
    """Results and manifest of a run; entries of the manifest may be missing."""

    results: Results
    manifest: Mapping[str, Any]

    def part(self, key: str) -> Mapping[str, Any]:
        """Return the mapping under a key of the manifest; empty if it is missing."""
        return mapping(self.manifest.get(key))

    @property
    def scenario(self) -> Mapping[str, Any]:
        """Return the scenario of the manifest."""
        return self.part("scenario")

    @cached_property
    def components(self) -> dict[str, Mapping[str, Any]]:
        """Return component → its entry in the scenario."""
        return {str(name): mapping(c) for name, c in mapping(self.scenario.get("components")).items()}

    @cached_property
    def connections(self) -> list[Mapping[str, Any]]:
        """Return the connections of the scenario."""
        return mappings(self.scenario.get("connections"))

    @cached_property
    def links(self) -> list[tuple[str, str]]:
        """Return the connections as pairs (source, target) of `component.variable`."""
        pairs = ((link.get("from"), link.get("to")) for link in self.connections)
        return [(source, target) for source, target in pairs if isinstance(source, str) and isinstance(target, str)]

    @property
    def algorithm(self) -> str:
        """Return the name of the coupling algorithm; the default if it is not recorded."""
        return str(self.scenario.get("algorithm") or (DEFAULT.name if self.links else ""))

    @cached_property
    def variables(self) -> dict[str, set[str]]:
        """Return component → names of its recorded variables."""
        variables: dict[str, set[str]] = {}
        for column in self.results.columns:
            component, _, variable = column.partition(".")
            variables.setdefault(component, set()).add(variable)
        return variables

    @property
    def time(self) -> Array:
        """Return the communication points [s]."""
        return self.results.time

    @property
    def has_failed(self) -> bool:
        """Return True if the simulation stopped early."""
        return str(self.manifest.get("status") or "ok") != "ok"

    def signal(self, column: str) -> Array | None:
        """Return a column of the results, None if it is not recorded."""
        if column not in self.results:
            return None
        return self.results[column]

    @cached_property
    def items(self) -> dict[str, dict[float, str]]:
        """Return column → number → item, for columns of enumerations."""
        columns = self.part("items").items()
        return {str(c): {number(v): str(name) for name, v in mapping(items).items()} for c, items in columns}

    def trace(self, column: str, style: str, label: str = "") -> Trace:
        """Return the line of a column, with values in the display unit."""
        values, is_held = displayed(self.results[column], self.unit(column)), column in self.results.whole
        return Trace(label or column, values, style, held=is_held, items=self.items.get(column, {}))

    def unit(self, column: str) -> str:
        """Return the unit of a column, or ""."""
        return self.results.units.get(column, "")

    def start(self, component: str | None) -> Mapping[str, Any]:
        """Return the start values that the scenario sets for a component."""
        return mapping(self.components.get(component or "", {}).get("start"))

    def source(self, target: str) -> str | None:
        """Return the output connected to an input, if any."""
        return next((source for source, end in self.links if end == target), None)


def disturbances(run: Run, link: Mapping[str, Any]) -> list[str]:
    """Return texts on the noise (standard deviation) and the injected faults of a connection."""
    parts, noise, target = list[str](), mapping(link.get("noise")), str(link.get("to"))
    if noise:
        unit = run.unit(target) or run.unit(str(link.get("from")))
        variance, bias = number(noise.get("variance"), 0.0), number(noise.get("bias"), 0.0)
        parts += [f"σ\u00a0=\u00a0{amount(math.sqrt(variance), unit, difference=True)}"] if variance > 0 else []
        parts += [f"bias {amount(bias, unit, difference=True)}"] if bias else []
        parts += [f"{key} {value}" for key, value in noise.items() if key not in ("variance", "bias")]
        parts = [", ".join(parts) or "none"]
    return [*parts, *(fault_text(fault) for fault in faults_on(run, [target]))]


def faults_on(run: Run, inputs: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return the faults that are injected into connections to these inputs."""
    names = {*inputs, *(name.partition("[")[0] for name in inputs)}
    return [fault for fault in mappings(run.scenario.get("faults")) if fault.get("on") in names]


def fault_text(fault: Mapping[str, Any]) -> str:
    """Return an injected fault as text: `bias 0.1 from 2 s to 4 s`."""
    sizes = [str(fault["value"])] if "value" in fault else []
    sizes += [f"of {fault['delay']} s"] if "delay" in fault else []
    sizes += [f"with probability {fault['probability']}"] if "probability" in fault else []
    times = [f"{key} {fault[key]} s" for key in ("from", "to") if key in fault]
    return " ".join([f"fault: {fault.get('kind', '?')}", *sizes, *times])


def time_sentence(timings: Mapping[str, Any]) -> str:
    """Return a sentence on the component with the most wall time; "" if times were not measured."""
    components = mapping(timings.get("components"))
    if not components or not number(timings.get("readings")) >= MIN_READINGS:
        return ""
    name, entry = next(iter(components.items()))
    times = mapping(entry)
    steps = sum(number(times.get(call)) for call in ("step", "set", "get"))
    words = f"{plain(steps, 2)} s in steps, {plain(number(times.get('other')), 2)} s in loading"
    sentence = f"{name} takes {number(times.get('share')):.0%} of the time, loading included ({words})"
    if (waiting := number(timings.get("waiting"), 0.0)) > 0.0:
        sentence += f"; {plain(waiting, 2)} s of waiting for the pace or in a pause are not counted"
    return f"{sentence}."
