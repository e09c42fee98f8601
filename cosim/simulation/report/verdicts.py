"""A run in words; each sentence is computed from the data and omitted if untrue."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosim.base.text import amount, counted, join_names
from cosim.simulation.report.recorded import Run, mapping, mappings, number

NEGLIGIBLE = 1e-9  # share of its limit below which a value is shown as 0
NAMES = {"peak": "largest magnitude"}  # of kinds, others are shown as the scenario names them


@dataclass(frozen=True)
class CriterionText:
    """A criterion in the page's words."""

    title: str
    value: str
    allowed: str
    margin: str
    met: bool


def criteria(run: Run) -> list[CriterionText]:
    """Return the manifest's criteria as text."""
    return [_criterion(entry, run.unit(str(entry.get("of")))) for entry in mappings(run.manifest.get("criteria"))]


def _criterion(entry: Mapping[str, Any], unit_of_signal: str) -> CriterionText:
    unit, value, bound = str(entry.get("unit") or ""), number(entry.get("value")), number(entry.get("max"))
    kind = str(entry.get("kind", "criterion"))
    met = bool(entry["met"]) if "met" in entry else value <= bound
    target = entry.get("to")
    parts = [f"{NAMES.get(kind, kind.replace('_', ' '))} of {entry.get('of', '?')}"]
    if target is not None:
        parts.append(f"to {target if isinstance(target, str) else amount(number(target), unit_of_signal, None)}")
    parts += [f"within ±{amount(number(entry['band']), unit_of_signal, None)}"] if "band" in entry else []
    parts += [f"{word} {amount(number(entry[word]), 's', None)}" for word in ("after", "until") if word in entry]
    if abs(value) < NEGLIGIBLE * bound:
        value = 0.0
    text = amount(value, unit) if math.isfinite(value) else ("not settled" if kind == "settling_time" else "none")
    rest = bound - value
    margin = "" if not math.isfinite(rest) else f"{amount(abs(rest), unit)} {'left' if rest >= 0 else 'over'}"
    allowed = f"≤ {amount(bound, unit, None)}" if math.isfinite(bound) else ""
    return CriterionText(" ".join(parts), text, allowed, margin, met)


def has_failed(run: Run) -> bool:
    """Return whether the simulation stopped early."""
    return str(run.manifest.get("status") or "ok") != "ok"


def outcome(run: Run, judged: list[CriterionText]) -> str:
    """Return the run's outcome in one or two sentences."""
    missed = [c for c in judged if not c.met]
    if has_failed(run):
        status = str(run.manifest["status"])
        reason = status.removeprefix("failed").lstrip(": ") or "no reason was recorded"
        return f"The simulation failed: {reason}. The rows before that are shown."
    if not judged:
        return _describe_simulation(run)
    if not missed:
        every = {1: "The criterion was met.", 2: "Both criteria were met."}
        return every.get(len(judged), f"All {counted(len(judged), 'criterion')} were met.")
    verb = "was" if len(missed) == 1 else "were"
    first = missed[0]
    detail = f"{first.title}: {first.value}" + (f", allowed {first.allowed}" if first.allowed else "")
    which = detail if len(missed) == 1 else f"first, {detail}"
    return f"{len(missed)} of {counted(len(judged), 'criterion')} {verb} missed ({which})."


def _describe_simulation(run: Run) -> str:
    """Return a sentence on the simulated components, the duration and the number of steps."""
    names = list(mapping(run.scenario.get("components"))) or list(run.variables)
    if not names or not run.time.size:
        return "Nothing was recorded."
    duration, steps = float(run.time[-1] - run.time[0]), counted(run.time.size - 1, "communication step")
    over = f"{amount(duration, 's', None)} in {steps}"
    return f"Simulated {join_names(names)} over {over}. No criteria are set, so nothing was judged."
