"""The page of a sweep: criteria met, sensitivities, scatter plots, bands over time, runs to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import append_unit, counted, display, percent, plain, written
from cosim.base.version import __version__
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace
from cosim.report.template import render
from cosim.storage.kinds import shell_path
from cosim.sweeps.run_statistics import MIN_RUNS, Sensitivity, quantiles, sensitivity
from cosim.sweeps.sampling import are_numbers
from cosim.sweeps.store import TABLE, read_table, signal_of
from cosim.sweeps.sweep_file import Grid
from cosim.sweeps.sweep_result import Swept, hardest, headline, repeat_command, way_of, way_sentence

TEMPLATE = Path(__file__).with_name("templates") / "sweep.html.j2"
MOST_BANDS = 16
MOST_RUNS = 20_000  # at most, for a band
MOST_POINTS = 2000  # runs in a scatter plot
MOST_SCATTERED = 4  # criteria with scatter plots, each over two factors
NEVER = "never"
LISTED = {"values", "grid"}  # ways of variation without a distribution
MOST_LISTED = 10  # runs farthest from meeting a criterion
WIDE = 0.2  # half-width of a sensitivity's interval; the page asks for more runs above


def page(swept: Swept) -> str:
    """Return the self-contained HTML page of a sweep."""
    table, _ = read_table(swept.folder / TABLE)
    record, charts = swept.record, Charts()
    names = swept.sweep.job.signals[:MOST_BANDS]
    drawing = charts.over(np.array(record["times"], float))
    failed, runs = record["failed"], record["runs"]
    indices = _sensitivities(swept, table)
    failures = Badge(f"{failed} aborted", "bad") if failed else Badge("all completed")
    badges = [Badge(counted(runs, "run")), Badge(way_of(record)), failures]
    return render(
        TEMPLATE,
        {
            "name": record["name"],
            "description": swept.sweep.file.description,
            "outcome": headline(record),
            "badges": badges,
            "warnings": _warnings(swept, indices),
            **_criteria_context(swept, table),
            "scatters": _scatters(swept, table, indices, charts),
            "factors": _factors(swept),
            "plots": drawing.plots([_band(name, signal_of(table, name, MOST_RUNS), record) for name in names]),
            "data": charts.data(),  # after all drawings
            **_sensitivity_tables(record, indices),
            "failures": record["failures"],
            "more_failures": max(0, failed - len(record["failures"])),
            "way": way_sentence(record),
            "check": swept.check,
            "sampling_note": _sampling_note(swept),
            "repeat": f"cosim sweep {shell_path(swept.sweep.yaml.path)}",
            "version": __version__,
        },
    )


def _criteria_context(swept: Swept, table: Any) -> Mapping[str, Any]:
    """Return criteria, values and the worst runs."""
    record = swept.record
    if not record["criteria"]:
        return {"tone": "plain", "worst": [], "hardest_name": "", "criteria": [], "values": []}
    worst, name = _worst(swept, table), hardest(record)["name"]
    equal = bool(worst) and worst[-1]["value"] == NEVER  # none of the listed runs is worse than another
    return {
        "worst_words": f"{'Runs that never meet' if equal else 'Runs farthest from the limit of'} {name}",
        "worst_note": "The first of the runs that never settle." if equal else "Farthest from its limit first.",
        "tone": "good" if record.get("met_all") == record["runs"] else "bad",
        "worst": worst,
        "hardest_name": name,
        "criteria": [_criterion(c) for c in record["criteria"]],
        "values": [_spread(c, _values_of(table, c["name"])) for c in record["criteria"]],
    }


def _sensitivity_tables(record: Mapping[str, Any], indices: Sequence[Sensitivity]) -> Mapping[str, Any]:
    """Return the sensitivities of criteria that runs fail, then of signals.

    Criteria that every run meets are left out. Without criteria to show, the signals come first.
    """
    failed, met = (_names_of(record, met=met) for met in (False, True))
    others = [s for s in indices if s.outcome not in failed | met]
    first = [s for s in indices if s.outcome in failed]
    return {
        "always_met": [s.outcome for s in indices if s.outcome in met],
        "unranked": sorted(failed - {s.outcome for s in first}) if first else [],
        "sensitivities": [_table(s) for s in first or others],
        "more_sensitivities": [_table(s) for s in others] if first else [],
    }


def _names_of(record: Mapping[str, Any], *, met: bool) -> set[str]:
    """Return the criteria that every completed run meets, or the other ones."""
    return {c["name"] for c in record["criteria"] if (c["met"] == c["of"]) == met}


def _criterion(c: Mapping[str, Any]) -> Mapping[str, Any]:
    unit, factor = display(c["unit"])
    low, high = c["ci95"]
    return {
        "name": c["name"],
        "max": append_unit(plain(c["max"] * factor, None), unit),
        "met": f"{c['met']} of {c['of']}",
        "share": percent(c["met"] / c["of"]) if c["of"] else "–",
        "interval": f"{percent(low)} … {percent(high)}",
        "bar": _bar(c["met"] / c["of"] if c["of"] else 0.0, low, high),
    }


def _bar(value: float, low: float, high: float) -> Mapping[str, float]:
    """Return a share and its interval in percent."""
    value, low, high = (round(100 * min(1.0, max(0.0, v)), 2) for v in (value, low, high))
    return {"value": value, "low": low, "width": round(high - low, 2)}


def _warnings(swept: Swept, indices: Sequence[Sensitivity]) -> list[str]:
    """Return the limits of the conclusions from these runs."""
    completed = swept.record["runs"] - swept.record["failed"]
    texts = list(swept.record["warnings"])
    if completed < MIN_RUNS:
        texts.append(f"Too few runs for sensitivities: {completed} completed, {MIN_RUNS} are needed.")
    widest = max((half for s in indices for _, half in (*s.first, *s.total)), default=0.0)
    if widest > WIDE:
        widths = {s.outcome: max(half for _, half in (*s.first, *s.total)) for s in indices}
        texts.append(
            f"Too few runs to rank the factors of {max(widths, key=lambda n: widths[n])}: intervals of its "
            f"indices reach ±{plain(widest, 2)}. Take more runs."
        )
    if swept.check.code.startswith("W-"):
        texts.append(swept.check)
    return texts


def _values_of(table: Any, name: str) -> Array:
    return np.array(table.column(name).to_pylist(), float)


def _sampling_note(swept: Swept) -> str:
    """Return how the values of several factors are combined."""
    ways = {varied.way for varied in swept.sweep.file.vary.values()}
    drawn, listed = ways - LISTED - {"each", "count"}, ways & LISTED
    text = f"Distributions are sampled together ({swept.sweep.file.sampling})" if drawn else ""
    if listed:
        text += "; each sample is combined with every listed value" if drawn else "Every combination is run"
    return f"{text}." if text else ""


def _worst(swept: Swept, table: Any) -> list[Mapping[str, Any]]:
    """Return the worst runs by the hardest criterion."""
    criterion = hardest(swept.record)
    values, runs = _values_of(table, criterion["name"]), np.array(table.column("run").to_pylist(), int)
    completed = np.array([status == "ok" for status in table.column("status").to_pylist()])
    far = np.where(np.isfinite(values), values, np.inf)
    failing = np.flatnonzero(completed & (far > criterion["max"]))
    unit, factor = display(criterion["unit"])
    names = [f.name for f in swept.sweep.factors]
    return [
        {
            "run": int(runs[k]),
            "value": append_unit(plain(float(values[k]) * factor, 3), unit) if np.isfinite(values[k]) else NEVER,
            "factors": ", ".join(f"{n} = {_short(swept.sweep.columns[n][runs[k]])}" for n in names),
            "command": repeat_command(swept.sweep, int(runs[k])),
        }
        for k in failing[np.argsort(-far[failing], kind="stable")][:MOST_LISTED]
    ]


def _short(value: Any) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def _scatters(swept: Swept, table: Any, indices: Sequence[Sensitivity], charts: Charts) -> list[Plot]:
    """Draw criteria over their most important factors, criteria that every run meets only if there are no others."""
    ranked = {s.outcome: s.factors for s in indices}
    numbers = [f.name for f in swept.sweep.factors if f.name != "seed" and are_numbers(swept.sweep.columns[f.name])]
    failed, criteria = _names_of(swept.record, met=False), swept.record["criteria"]
    drawable = [c for c in criteria if c["name"] in failed] or criteria
    first = sorted(drawable, key=lambda c: c["met"])[:MOST_SCATTERED]
    pairs = [(c, name) for c in first for name in ranked.get(c["name"], tuple(numbers))[:2]]
    drawn = (_scatter(swept, table, c, name, charts) for c, name in pairs)
    return [plot for plot in drawn if plot is not None]


def _scatter(swept: Swept, table: Any, c: Mapping[str, Any], name: str, charts: Charts) -> Plot | None:
    """Draw a criterion over a varying factor; return None for a constant factor or fewer than two values."""
    values, runs = _values_of(table, c["name"]), np.array(table.column("run").to_pylist(), int)
    good = np.flatnonzero(np.isfinite(values))
    good = good[:: max(1, -(-good.size // MOST_POINTS))]
    unit, factor = display(c["unit"])
    x_unit, scale = display(next(f.unit for f in swept.sweep.factors if f.name == name))
    x = np.array([swept.sweep.columns[name][run] for run in runs[good]], float) * scale
    if x.size < 2 or np.ptp(x) == 0.0:
        return None
    order, y, limit = np.argsort(x, kind="stable"), values[good] * factor, c["max"] * factor
    low, high = min(float(y.min()), limit), max(float(y.max()), limit)
    room, edge = 0.06 * (high - low) or 1.0, 0.04 * float(np.ptp(x))
    ends, reach = (float(x.min()) - edge, float(x.max()) + edge), (low - room, high + room)
    trace = Trace(c["name"], y[order], "s0 dots", x=x[order])
    panel = Panel(f"{c['name']} over {name}", unit or "1", [trace], None, (limit,), "limit")
    also = {"run": runs[good][order].astype(float)}
    return charts.points(panel, ends, (name, x_unit or "1"), also, reach=reach)


def _spread(c: Mapping[str, Any], values: Array) -> Mapping[str, Any]:
    unit, factor = display(c["unit"])
    good = values[np.isfinite(values)]
    values = quantiles(good) if good.size else np.full(5, np.nan)
    never = c["of"] - good.size
    return {
        "name": c["name"],
        "quantiles": [append_unit(plain(float(v) * factor, 3), unit) for v in values],
        "never": str(never) if never else "–",
    }


def _factors(swept: Swept) -> list[Mapping[str, str]]:
    rows: list[Mapping[str, str]] = []
    for factor in swept.sweep.factors:
        varied, values = swept.sweep.file.vary[factor.name], swept.sweep.columns[factor.name]
        entries: Any = getattr(varied, varied.way)
        if isinstance(entries, Grid):
            text = ", ".join(f"{key} {value}" for key, value in entries.model_dump(by_alias=True).items())
        elif isinstance(entries, list | tuple):
            text = ", ".join(map(str, entries[:8])) + (", …" if len(entries) > 8 else "")
        else:
            text = str(entries)
        way, different = varied.way.replace("_", " "), counted(len(set(map(str, values))), "value")
        row = {"name": factor.name, "unit": written(factor.unit), "way": way, "values": text, "different": different}
        rows.append(row)
    return rows


def _band(name: str, values: Array, record: Mapping[str, Any]) -> Panel:
    unit, factor = display(record["units"].get(name, ""))
    if not values.size or values.shape[1] != len(record["times"]):  # no run is complete
        return Panel(name, unit or "1", ())
    q = quantiles(values) * factor
    traces = (Trace("median", q[2], "true"), Trace("25 %", q[1], "reference"), Trace("75 %", q[3], "reference"))
    return Panel(name, unit or "1", traces, Band("5 … 95 % of the runs", q[0], q[4]))


def _sensitivities(swept: Swept, table: Any) -> list[Sensitivity]:
    """Return the sensitivities of criteria and final signals."""
    factors = {n: v for n, v in swept.sweep.columns.items() if n != "seed"}
    outcomes: dict[str, Array] = {c["name"]: _values_of(table, c["name"]) for c in swept.record["criteria"]}
    for name in swept.sweep.job.signals[:MOST_BANDS]:
        last = [np.nan if row is None else row[-1] for row in table.column(name).to_pylist()]
        outcomes[f"{name} at the end"] = np.array(last)
    saltelli, seed = swept.sweep.file.sampling == "saltelli", swept.sweep.file.seed
    indices = (sensitivity(n, v, factors, saltelli=saltelli, seed=seed) for n, v in outcomes.items())
    return [s for s in indices if s is not None]


def _table(s: Sensitivity) -> Mapping[str, Any]:
    others = [_pair(p) for p in s.total] or [plain(v, 2) for v in s.pawn]
    rows = [
        {"name": name, "first": _pair(first), "other": other, "bar": _bar(first[0], first[0] - first[1], sum(first))}
        for name, first, other in zip(s.factors, s.first, others, strict=True)
    ]
    return {"outcome": s.outcome, "rows": rows, "total": bool(s.total), "chance": plain(s.chance, 2)}


def _pair(pair: tuple[float, float]) -> str:
    return f"{plain(pair[0], 2)} ± {plain(pair[1], 1)}"
