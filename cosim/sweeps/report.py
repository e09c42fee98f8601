"""The page of a sweep: criteria met, sensitivities, scatter plots, bands over time, runs to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import append_unit, counted, display, displayed, percent, plain, shown_unit, some, written
from cosim.core.version import __version__
from cosim.files.kinds import shell_path
from cosim.report.charts import Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Band, Panel, Trace, extent
from cosim.report.template import render
from cosim.sweeps.reading import Swept, repeat_command
from cosim.sweeps.sampling import MIN_RUNS, QUANTILES, Factor, Sensitivity, are_numbers, sensitivity
from cosim.sweeps.store import TABLE, hardest, read_table, signal_of
from cosim.sweeps.sweep_file import DISTRIBUTIONS, Grid

TEMPLATE = Path(__file__).with_name("templates") / "sweep.html.j2"
MOST_BANDS = 16
MOST_RUNS = 20_000  # at most, for a band
MOST_POINTS = 2000  # runs in a scatter plot
MOST_SCATTERED = 4  # criteria with scatter plots, each over two factors
NEVER = "never"
MOST_OTHERS = 24  # further scatter plots
MOST_BINS, MOST_LINES = 60, 300  # of a histogram; of parallel coordinates
MOST_LISTED = 10  # runs farthest from meeting a criterion
MARK = 0.012  # width of the mark at what chance reaches


def page(swept: Swept) -> str:
    """Return the self-contained HTML page of a sweep."""
    table, _ = read_table(swept.folder / TABLE)
    record, charts, study = swept.record, Charts(), swept.sweep
    names, criteria = study.job.signals[:MOST_BANDS], record["criteria"]
    drawing = charts.over(np.array(record["times"], float))
    failed, completed = record["failed"], record["runs"] - record["failed"]
    values = swept.criteria
    outcomes = dict(values)
    for name in names:
        last = [np.nan if row is None else row[-1] for row in table.column(name).to_pylist()]
        outcomes[f"{name} at the end"] = np.array(last)
    varied, saltelli = {n: v for n, v in study.columns.items() if n != "seed"}, study.file.sampling == "saltelli"
    estimates = (sensitivity(n, v, varied, saltelli=saltelli, seed=study.file.seed) for n, v in outcomes.items())
    indices = [s for s in estimates if s is not None]
    # Criteria that every completed run meets are left out of the sensitivities. Without others, the signals come first.
    missed = {c["name"] for c in criteria if c["met"] != c["of"]}
    first = [s for s in indices if s.outcome in missed]
    others = [s for s in indices if s.outcome not in values]
    warnings = [*record["warnings"]]
    if completed < MIN_RUNS:
        warnings.append(f"Too few runs for sensitivities: {completed} completed, {MIN_RUNS} are needed.")
    ways = {factor.way for factor in study.file.vary.values()}
    drawn, listed = not ways.isdisjoint(DISTRIBUTIONS), not ways.isdisjoint({"values", "grid"})
    note = "Every combination is run." if listed else ""  # how the values of several factors are combined
    if drawn:
        note = f"Distributions are sampled together ({study.file.sampling})"
        note += "; each sample is combined with every listed value." if listed else "."
    scatters = _scatters(swept, table, values, {s.outcome: s.ranked for s in indices}, charts)
    context = {
        "name": record["name"],
        "description": study.file.description,
        "outcome": swept.headline,
        "badges": [
            Badge(counted(record["runs"], "run")),
            Badge(f"{failed} aborted", "bad") if failed else Badge("all completed"),
        ],
        "warnings": warnings,
        "tone": "plain",
        "criteria": [],
        "worst": [],
        "histograms": histograms(criteria, values, charts),
        "parallel": _parallel_coordinates(swept, table, values),
        "scatters": scatters[0],
        "more_scatters": scatters[1],
        "factors": [_factor(swept, factor) for factor in study.factors],
        "plots": drawing.plots([_band(name, signal_of(table, name, MOST_RUNS), record) for name in names]),
        "data": charts.data(),  # after all drawings
        "always_met": [s.outcome for s in indices if s.outcome in values.keys() - missed],
        "unranked": sorted(missed - {s.outcome for s in first}) if first else [],
        "sensitivities": [_indices(s) for s in first or others],
        "more_sensitivities": [_indices(s) for s in others] if first else [],
        "failures": record["failures"],
        "more_failures": max(0, failed - len(record["failures"])),
        "sampling_note": note,
        "repeat": f"cosim sweep {shell_path(study.yaml.path)}",
        "version": __version__,
    }
    if criteria:
        rows, spreads = list[Mapping[str, Any]](), list[Mapping[str, Any]]()
        for c in criteria:
            unit, factor = display(c["unit"])
            share = c["met"] / c["of"] if c["of"] else 0.0
            row = {"name": c["name"], "max": append_unit(plain(c["max"] * factor, None), unit)}
            row |= {"met": f"{c['met']} of {c['of']}", "share": percent(share) if c["of"] else "–"}
            rows.append({**row, "interval": " … ".join(map(percent, c["ci95"])), "bar": _bar(share, *c["ci95"])})
            good = values[c["name"]][np.isfinite(values[c["name"]])]
            quantiles = np.quantile(good, QUANTILES) if good.size else np.full(5, np.nan)
            texts = [append_unit(plain(float(v) * factor, 3), unit) for v in quantiles]
            spreads.append({"name": c["name"], "quantiles": texts, "never": str(c["of"] - good.size or "–")})
        worst, name = _worst(swept, table, values), hardest(record)["name"]
        equal = bool(worst) and worst[-1]["value"] == NEVER  # none of the listed runs is worse than another
        context |= {
            "worst": worst,
            "worst_words": f"{'Runs that never meet' if equal else 'Runs farthest from the limit of'} {name}",
            "worst_note": "The first of the runs that never settle." if equal else "Farthest from its limit first.",
            "hardest_name": name,
            "tone": "good" if record["met_all"] == record["runs"] else "bad",
            "criteria": rows,
            "values": spreads,
        }
    return render(TEMPLATE, context)


def _bar(value: float, low: float, high: float) -> Mapping[str, float]:
    """Return a share and its interval in percent."""
    value, low, high = (round(100 * min(1.0, max(0.0, v)), 2) for v in (value, low, high))
    return {"value": value, "low": low, "width": round(high - low, 2)}


def _worst(swept: Swept, table: Any, values: Mapping[str, Array]) -> list[Mapping[str, Any]]:
    """Return the worst runs by the hardest criterion."""
    criterion = hardest(swept.record)
    reached, runs = values[criterion["name"]], table.column("run").to_pylist()
    completed = np.array(table.column("status").to_pylist()) == "ok"
    far = np.where(np.isfinite(reached), reached, np.inf)
    failing = np.flatnonzero(completed & (far > criterion["max"]))
    unit, factor = display(criterion["unit"])
    rows: list[Mapping[str, Any]] = []
    for k in failing[np.argsort(-far[failing], kind="stable")][:MOST_LISTED]:
        run = runs[k]
        cells = {name: column[run] for name, column in swept.sweep.columns.items()}
        texts = (f"{name} = {f'{v:.4g}' if isinstance(v, float) else v}" for name, v in cells.items())
        value = append_unit(plain(float(reached[k]) * factor, 3), unit) if np.isfinite(reached[k]) else NEVER
        command = repeat_command(swept.sweep, run)
        rows.append({"run": run, "value": value, "factors": ", ".join(texts), "command": command})
    return rows


def _scatters(
    swept: Swept, table: Any, values: Mapping[str, Array], ranked: Mapping[str, Sequence[str]], charts: Charts
) -> tuple[list[Plot], list[Plot]]:
    """Draw criteria over their two most important factors, and over the others; those that every run meets last."""
    units = {factor.name: factor.unit for factor in swept.sweep.factors}
    columns = {name: column for name, column in swept.sweep.columns.items() if name != "seed" and are_numbers(column)}
    criteria = swept.record["criteria"]
    missed = [c for c in criteria if c["met"] != c["of"]] or criteria
    runs, plots, others = np.array(table.column("run").to_pylist(), int), list[Plot](), list[Plot]()
    for c in sorted(criteria, key=lambda c: c["met"])[:MOST_SCATTERED]:
        good = np.flatnonzero(np.isfinite(values[c["name"]]))
        good = good[:: max(1, -(-good.size // MOST_POINTS))]
        unit, factor = display(c["unit"])
        by_rank = dict.fromkeys((*ranked.get(c["name"], ()), *columns))
        for place, name in enumerate(by_rank):
            x_unit, scale = display(units[name])
            x = np.array([columns[name][run] for run in runs[good]], float) * scale
            if x.size < 2 or np.ptp(x) == 0.0:
                continue
            order, y, limit = np.argsort(x, kind="stable"), values[c["name"]][good] * factor, c["max"] * factor
            low, high = min(float(y.min()), limit), max(float(y.max()), limit)
            room, edge = 0.06 * (high - low) or 1.0, 0.04 * float(np.ptp(x))
            ends = float(x.min()) - edge, float(x.max()) + edge
            trace = Trace(c["name"], y[order], "s0 dots", x=x[order])
            panel = Panel(f"{c['name']} over {name}", unit or "1", [trace], None, (limit,), "limit")
            also = {"run": runs[good][order].astype(float)}
            is_first = place < 2 and c in missed
            chart = charts.points(panel, ends, (name, x_unit or "1"), also, reach=(low - room, high + room))
            (plots if is_first else others).append(chart)
    return plots, others[:MOST_OTHERS]


def histograms(criteria: Sequence[Mapping[str, Any]], values: Mapping[str, Array], charts: Charts) -> list[Plot]:
    """Draw the number of runs by the value of each criterion, with its limit."""
    plots = []
    for c in criteria:
        unit, factor = display(c["unit"])
        found = values[c["name"]][np.isfinite(values[c["name"]])] * factor
        if found.size < 2 or np.ptp(found) == 0.0:
            continue
        limit = c["max"] * factor
        counts, edges = np.histogram(found, min(MOST_BINS, np.histogram_bin_edges(found, "auto").size - 1))
        trace = Trace("runs", np.array([0.0, *counts, 0.0]), "s0", held=True, x=np.array([edges[0], *edges]))
        low, high = min(edges[0], limit), max(edges[-1], limit)
        room = 0.04 * (high - low)
        panel = Panel(c["name"], "runs", [trace], None, (), "limit")
        plots.append(charts.alone(panel, (low - room, high + room), (c["name"], unit or "1"), uprights=[limit]))
    return plots


def _parallel_coordinates(swept: Swept, table: Any, outcomes: Mapping[str, Array]) -> Mapping[str, Any] | None:
    """Return axes and lines of runs in parallel coordinates: numeric factors, then criteria that a run misses.

    The rarer kind of runs comes last and lies above the other one. None if no run misses a criterion.
    """
    criteria = [c for c in swept.record["criteria"] if c["met"] != c["of"]]
    runs = np.array(table.column("run").to_pylist(), int)
    units = {factor.name: factor.unit for factor in swept.sweep.factors}
    columns = {name: c for name, c in swept.sweep.columns.items() if name != "seed" and are_numbers(c)}
    axes = {name: (np.array(column, float)[runs], units[name]) for name, column in columns.items()}
    axes |= {c["name"]: (outcomes[c["name"]], c["unit"]) for c in criteria}
    axes = {name: entry for name, entry in axes.items() if (span := extent([entry[0]])) and span[1] > span[0]}
    if len(axes) < 2 or not criteria:
        return None
    is_met = np.all([np.array(table.column(f"{c['name']} met").to_pylist(), bool) for c in criteria], axis=0)
    chosen = np.unique(np.linspace(0, runs.size - 1, min(runs.size, MOST_LINES)).astype(int))
    heads, heights = [], []
    for k, (name, (values, own)) in enumerate(axes.items()):
        unit, factor = display(own)
        low, high = np.nanmin(values), np.nanmax(values)
        ends = [append_unit(plain(float(end) * factor, 3), unit) for end in (high, low)]
        heads.append({"name": name, "high": ends[0], "low": ends[1], "left": 100.0 * k / (len(axes) - 1)})
        heights.append(100.0 * (high - values) / (high - low))
    lines = []
    for row in sorted(chosen, key=lambda row: is_met[row] == (np.mean(is_met) < 0.5)):
        points = [f"{h['left']:.1f},{y[row]:.1f}" for h, y in zip(heads, heights, strict=True) if np.isfinite(y[row])]
        lines.append({"points": " ".join(points), "met": bool(is_met[row]), "run": int(runs[row])})
    return {"axes": heads, "lines": lines}


def _factor(swept: Swept, factor: Factor) -> Mapping[str, str]:
    varied, values = swept.sweep.file.vary[factor.name], swept.sweep.columns[factor.name]
    entries: Any = getattr(varied, varied.way)
    if isinstance(entries, Grid):
        entries = [f"{key} {value}" for key, value in entries.model_dump(by_alias=True).items()]
    listed = entries if isinstance(entries, list | tuple) else [entries]
    return {
        "name": factor.name,
        "unit": written(factor.unit),
        "way": varied.way.replace("_", " "),
        "values": some([*map(str, listed)], 8),
        "different": counted(len(set(map(str, values))), "value"),
    }


def _band(name: str, values: Array, record: Mapping[str, Any]) -> Panel:
    own = record["units"].get(name, "")
    unit = shown_unit(own)
    if not values.size or values.shape[1] != len(record["times"]):  # no run is complete
        return Panel(name, unit or "1", ())
    q = displayed(np.quantile(values, QUANTILES, axis=0), own)
    traces = (Trace("median", q[2], "true"), Trace("25 %", q[1], "reference"), Trace("75 %", q[3], "reference"))
    return Panel(name, unit or "1", traces, Band("5 … 95 % of the runs", q[0], q[4]))


def _indices(s: Sensitivity) -> Mapping[str, Any]:
    def pair(value: float, half: float) -> str:
        return f"{plain(value, 2)} ± {plain(half, 1)}"

    rows, ranks = [], {name: str(k) for k, name in enumerate(s.ranked, 1)}
    for k, name in enumerate(s.factors):
        if s.total:
            size, half = s.total[k]
            drawn, text = _bar(size, size - half, size + half), pair(size, half)
        else:  # with a mark at what chance reaches
            drawn, text = _bar(s.pawn[k], s.chance, s.chance + MARK), plain(s.pawn[k], 2)
        rank = ranks.get(name, "not proven")
        rows.append({"name": name, "rank": rank, "bar": drawn, "size": text, "first": pair(*s.first[k])})
    return {"outcome": s.outcome, "rows": rows, "total": bool(s.total), "chance": plain(s.chance, 2)}
