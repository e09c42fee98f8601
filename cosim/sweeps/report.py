"""The page of a sweep: criteria met, bands over time, what the outcomes are sensitive to, the runs that failed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import counted, display, joined, percent, plain, written
from cosim.base.version import __version__
from cosim.report.drawing import Charts
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace
from cosim.report.template import render
from cosim.sweeps.run_statistics import Sensitivity, quantiles, sensitivity
from cosim.sweeps.store import TABLE, read_table, signal_of
from cosim.sweeps.sweep_result import Swept, way_of

TEMPLATE = Path(__file__).with_name("templates") / "sweep.html.j2"
MOST_BANDS = 16
MOST_RUNS = 20_000  # of which a band is made


def page(swept: Swept) -> str:
    """One self-contained page, from what the sweep left."""
    table, _ = read_table(swept.folder / TABLE)
    record, charts = swept.record, Charts()
    names = swept.sweep.job.signals[:MOST_BANDS]
    drawing = charts.over(np.array(record["times"], float), 5 * len(names))
    failed, runs = record["failed"], record["runs"]
    agree = "DO NOT" not in record["check"]["sentence"]
    failures = Badge(f"{failed} failed", "bad") if failed else Badge("none failed", "good")
    badges = [Badge(counted(runs, "run")), Badge(way_of(record)), failures]
    return render(
        TEMPLATE,
        {
            "name": record["name"],
            "description": swept.sweep.file.description,
            "badges": badges,
            "criteria": [_criterion(c) for c in record["criteria"]],
            "values": [_spread(c, np.array(table.column(c["name"]).to_pylist(), float)) for c in record["criteria"]],
            "factors": _factors(swept),
            "plots": drawing.plots([_band(name, signal_of(table, name, MOST_RUNS), record) for name in names]),
            "data": charts.data(),
            "sensitivities": [_table(s) for s in _sensitivities(swept, table)],
            "failures": record["failures"],
            "more_failures": max(0, failed - len(record["failures"])),
            "check": record["check"]["sentence"],
            "agree": agree,
            "sampling": swept.sweep.file.sampling,
            "repeat": f"cosim sweep {swept.sweep.yaml.path}",
            "version": __version__,
        },
    )


def _criterion(c: Mapping[str, Any]) -> Mapping[str, Any]:
    unit, factor = display(c["unit"])
    low, high = c["ci95"]
    return {
        "name": c["name"],
        "max": joined(plain(c["max"] * factor, None), unit),
        "met": f"{c['met']} of {c['of']}",
        "share": percent(c["met"] / c["of"]) if c["of"] else "–",
        "interval": f"{percent(low)} … {percent(high)}",
    }


def _spread(c: Mapping[str, Any], values: Array) -> Mapping[str, Any]:
    unit, factor = display(c["unit"])
    good = values[np.isfinite(values)]
    shown = quantiles(good) if good.size else np.full(5, np.nan)
    never = c["of"] - good.size
    return {
        "name": c["name"],
        "quantiles": [joined(plain(float(v) * factor, 3), unit) for v in shown],
        "never": str(never) if never else "–",
    }


def _factors(swept: Swept) -> list[Mapping[str, str]]:
    found: list[Mapping[str, str]] = []
    for factor in swept.sweep.factors:
        varied, values = swept.sweep.file.vary[factor.name], swept.sweep.columns[factor.name]
        given: Any = getattr(varied, varied.way)
        said = given.model_dump(by_alias=True) if hasattr(given, "model_dump") else given
        text = str(said)
        if isinstance(said, dict):
            text = ", ".join(f"{key} {value}" for key, value in said.items())
        elif isinstance(said, list | tuple):
            text = ", ".join(map(str, said[:8])) + (", …" if len(said) > 8 else "")
        way, different = varied.way.replace("_", " "), counted(len(set(map(str, values))), "value")
        shown = {"unit": written(factor.unit), "way": way, "said": text, "different": different}
        found.append({"name": factor.name, **shown})
    return found


def _band(name: str, values: Array, record: Mapping[str, Any]) -> Panel:
    unit, factor = display(record["units"].get(name, ""))
    if not values.size or values.shape[1] != len(record["times"]):  # no run came to its end
        return Panel(name, unit or "1", ())
    q = quantiles(values) * factor
    traces = (Trace("median", q[2], "true"), Trace("25 %", q[1], "reference"), Trace("75 %", q[3], "reference"))
    return Panel(name, unit or "1", traces, Band("5 … 95 % of the runs", q[0], q[4]))


def _sensitivities(swept: Swept, table: Any) -> list[Sensitivity]:
    """Of the criteria, and of each signal at its end."""
    factors = {n: v for n, v in swept.sweep.columns.items() if n != "seed"}
    outcomes: dict[str, Array] = {
        c["name"]: np.array(table.column(c["name"]).to_pylist(), float) for c in swept.record["criteria"]
    }
    for name in swept.sweep.job.signals[:MOST_BANDS]:
        last = [np.nan if row is None else row[-1] for row in table.column(name).to_pylist()]
        outcomes[f"{name} at the end"] = np.array(last)
    saltelli, seed = swept.sweep.file.sampling == "saltelli", swept.sweep.file.seed
    found = (sensitivity(n, v, factors, saltelli=saltelli, seed=seed) for n, v in outcomes.items())
    return [s for s in found if s is not None]


def _table(s: Sensitivity) -> Mapping[str, Any]:
    others = [_pair(p) for p in s.total] or [plain(v, 2) for v in s.pawn]
    rows = [
        {"name": name, "first": _pair(first), "other": other}
        for name, first, other in zip(s.factors, s.first, others, strict=True)
    ]
    return {"outcome": s.outcome, "rows": rows, "total": bool(s.total), "chance": plain(s.chance, 2)}


def _pair(pair: tuple[float, float]) -> str:
    return f"{plain(pair[0], 2)} ± {plain(pair[1], 1)}"
