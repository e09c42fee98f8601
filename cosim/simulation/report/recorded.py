"""Results and manifest of a run, as pages read them; any key of the manifest may be absent."""

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
    """Results and manifest of a run."""

    results: Results
    manifest: Mapping[str, Any]

    def part(self, key: str) -> Mapping[str, Any]:
        """Return the mapping under a key of the manifest; empty if it is missing."""
        return self.manifest.get(key) or {}

    @property
    def scenario(self) -> Mapping[str, Any]:
        """Return the scenario of the manifest."""
        return self.part("scenario")

    @property
    def components(self) -> Mapping[str, Mapping[str, Any]]:
        """Return component → its entry in the scenario."""
        return self.scenario.get("components", {})  # type: ignore[no-any-return]

    @property
    def connections(self) -> Sequence[Mapping[str, Any]]:
        """Return the connections of the scenario."""
        return self.scenario.get("connections", ())  # type: ignore[no-any-return]

    @property
    def links(self) -> list[tuple[str, str]]:
        """Return the connections as pairs (source, target) of `component.variable`."""
        return [(link["from"], link["to"]) for link in self.connections]

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
        return bool(self.manifest.get("status", "ok") != "ok")

    @cached_property
    def items(self) -> dict[str, dict[float, str]]:
        """Return column → number → item, for columns of enumerations."""
        return {c: {float(v): name for name, v in items.items()} for c, items in self.part("items").items()}

    def trace(self, column: str, style: str, label: str = "") -> Trace:
        """Return the line of a column, with values in the display unit."""
        values, is_held = displayed(self.results[column], self.unit(column)), column in self.results.whole
        return Trace(label or column, values, style, held=is_held, items=self.items.get(column, {}))

    def unit(self, column: str) -> str:
        """Return the unit of a column, or ""."""
        return self.results.units.get(column, "")

    def start(self, component: str | None) -> Mapping[str, Any]:
        """Return the start values that the scenario sets for a component."""
        return self.components.get(component or "", {}).get("start", {})  # type: ignore[no-any-return]

    def source(self, target: str) -> str | None:
        """Return the output connected to an input, if any."""
        return next((source for source, end in self.links if end == target), None)


def disturbances(run: Run, link: Mapping[str, Any]) -> list[str]:
    """Return texts on the noise (standard deviation) and the injected faults of a connection."""
    noise, unit = link.get("noise", {}), run.unit(link["to"]) or run.unit(link["from"])
    sigma, bias = math.sqrt(noise.get("variance", 0.0)), noise.get("bias", 0.0)
    parts = [f"σ\u00a0=\u00a0{amount(sigma, unit, difference=True)}"] if sigma else []
    parts += [f"bias {amount(bias, unit, difference=True)}"] if bias else []
    return [*filter(None, [", ".join(parts)]), *(fault_text(fault) for fault in faults_on(run, [link["to"]]))]


def faults_on(run: Run, inputs: Sequence[str]) -> list[Mapping[str, Any]]:
    """Return the faults that are injected into connections to these inputs."""
    names = {*inputs, *(name.partition("[")[0] for name in inputs)}
    return [fault for fault in run.scenario.get("faults", ()) if fault["on"] in names]


def fault_text(fault: Mapping[str, Any]) -> str:
    """Return an injected fault as text: `bias 0.1 from 2 s to 4 s`."""
    sizes = [str(fault["value"])] if "value" in fault else []
    sizes += [f"of {fault['delay']} s"] if "delay" in fault else []
    sizes += [f"with probability {fault['probability']}"] if "probability" in fault else []
    times = [f"{key} {fault[key]} s" for key in ("from", "to") if key in fault]
    return " ".join([f"fault: {fault['kind']}", *sizes, *times])


def time_sentence(timings: Mapping[str, Any]) -> str:
    """Return a sentence on the component with the most wall time; "" if times were not measured."""
    if not timings.get("components") or timings["readings"] < MIN_READINGS:
        return ""
    name, times = next(iter(timings["components"].items()))
    steps = times["step"] + times["set"] + times["get"]
    words = f"{plain(steps, 2)} s in steps, {plain(times['other'], 2)} s in loading"
    return f"{name} takes {times['share']:.0%} of the time, loading included ({words})."
