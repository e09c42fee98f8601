"""A run in words; each sentence is computed from the data and omitted if untrue."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from cosim.core.text import amount, counted, join_names
from cosim.simulation.report.recorded import Run, mappings, number

NEGLIGIBLE = 1e-9  # share of its limit below which a value is shown as 0
NAMES = {"peak": "largest magnitude"}  # of kinds, others are shown as the scenario names them


def criteria(run: Run) -> list[dict[str, Any]]:
    """Return title, value, allowed value, margin and outcome of the manifest's criteria as text."""
    rows = []
    for entry in mappings(run.manifest.get("criteria")):
        own_unit, unit = run.unit(str(entry.get("of"))), str(entry.get("unit") or "")
        value, bound = number(entry.get("value")), number(entry.get("max"))
        kind, target = str(entry.get("kind", "criterion")), entry.get("to")
        met = bool(entry["met"]) if "met" in entry else value <= bound
        parts = [f"{NAMES.get(kind, kind.replace('_', ' '))} of {entry.get('of', '?')}"]
        if target is not None:
            parts.append(f"to {target if isinstance(target, str) else amount(number(target), own_unit, None)}")
        if "band" in entry:
            parts.append(f"within ±{amount(number(entry['band']), own_unit, None)}")
        parts += [f"{word} {amount(number(entry[word]), 's', None)}" for word in ("after", "until") if word in entry]
        if abs(value) < NEGLIGIBLE * bound:
            value = 0.0
        text = amount(value, unit) if math.isfinite(value) else ("not settled" if kind == "settling_time" else "none")
        rest = bound - value
        margin = f"{amount(abs(rest), unit)} {'left' if rest >= 0 else 'over'}" if math.isfinite(rest) else ""
        allowed = f"≤ {amount(bound, unit, None)}" if math.isfinite(bound) else ""
        rows.append({"title": " ".join(parts), "value": text, "allowed": allowed, "margin": margin, "met": met})
    return rows


def outcome(run: Run, judged: Sequence[Mapping[str, Any]]) -> str:
    """Return the run's outcome in one or two sentences."""
    if run.has_failed:
        reason = str(run.manifest["status"]).removeprefix("failed").lstrip(": ") or "no reason was recorded"
        return f"The simulation failed: {reason}. The rows before that are shown."
    missed = [c for c in judged if not c["met"]]
    if missed:
        first = missed[0]
        detail = f"{first['title']}: {first['value']}" + (f", allowed {first['allowed']}" if first["allowed"] else "")
        verb, which = ("was", detail) if len(missed) == 1 else ("were", f"first, {detail}")
        return f"{len(missed)} of {counted(len(judged), 'criterion')} {verb} missed ({which})."
    if judged:
        every = {1: "The criterion was met.", 2: "Both criteria were met."}
        return every.get(len(judged), f"All {counted(len(judged), 'criterion')} were met.")
    names = list(run.components) or list(run.variables)
    if not names or not run.time.size:
        return "Nothing was recorded."
    steps = counted(run.time.size - 1, "communication step")
    over = f"{amount(float(run.time[-1] - run.time[0]), 's', None)} in {steps}"
    return f"Simulated {join_names(names)} over {over}. No criteria are set, so nothing was judged."
