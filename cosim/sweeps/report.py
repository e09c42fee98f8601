"""The page of a sweep: criteria met, sensitivities, scatter plots, bands over time, runs to look at."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import append_unit, counted, display, percent, plain, some, written
from cosim.files.kinds import shell_path
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Panel, Trace, extent, signal_panel
from cosim.report.template import render
from cosim.sweeps.reading import Swept, repeat_command
from cosim.sweeps.sampling import MIN_SENSITIVITY_RUNS, QUANTILES, Factor, Sensitivity, are_numbers, sensitivity
from cosim.sweeps.store import SWEEP_TABLE, hardest, read_table, signal_of
from cosim.sweeps.sweep_file import DISTRIBUTIONS, Grid

TEMPLATE = Path(__file__).with_name("templates") / "sweep.html.j2"
MOST_BANDS = 16
MAX_BAND_RUNS = 20_000  # at most, for a band
MAX_SCATTER_POINTS = 2000  # runs in a scatter plot
MOST_SCATTERED = 4  # criteria with scatter plots, each over two factors
MOST_OTHERS = 24  # further scatter plots
MAX_HISTOGRAM_BINS, MAX_PARALLEL_LINES = 60, 300  # of a histogram; of parallel coordinates
MOST_LISTED = 10  # runs farthest from meeting a criterion
MARK_WIDTH = 0.012  # width of the mark at what chance reaches
Criterion = Mapping[str, Any]


def page(swept: Swept) -> str:
    """Return the self-contained HTML page of a sweep."""
    table, _ = read_table(swept.folder / SWEEP_TABLE)
    record, charts, study, values = swept.record, Charts(), swept.sweep, swept.criteria
    names, criteria = study.job.signals[:MOST_BANDS], record["criteria"]
    failed, completed = record["failed"], record["runs"] - record["failed"]
    outcomes = dict(values)
    for name in names:
        last = [np.nan if row is None else row[-1] for row in table.column(name).to_pylist()]
        outcomes[f"{name} at the end"] = np.array(last)
    varied, saltelli = {n: v for n, v in study.columns.items() if n != "seed"}, study.file.sampling == "saltelli"
    estimates = (sensitivity(n, v, varied, saltelli=saltelli, seed=study.file.seed) for n, v in outcomes.items())
    indices = [s for s in estimates if s is not None]
    # Criteria that every completed run meets have no sensitivities. If there are no others, signals are first.
    missed = {c["name"] for c in criteria if c["met"] != c["of"]}
    first = [s for s in indices if s.outcome in missed]
    others = [s for s in indices if s.outcome not in values]
    warnings = [*record["warnings"]]
    if completed < MIN_SENSITIVITY_RUNS:
        warnings.append(f"Too few runs for sensitivities: {completed} completed, {MIN_SENSITIVITY_RUNS} are needed.")
    ways = {factor.way for factor in study.file.vary.values()}
    note = "" if ways.isdisjoint({"values", "grid"}) else "Every combination of listed values is run."
    if not ways.isdisjoint(DISTRIBUTIONS):
        note = f"Distributions are sampled together ({study.file.sampling}). {note}"
    shares, quantiles = list[Mapping[str, Any]](), list[Sequence[str]]()
    for c in criteria:
        share, (unit, factor), good = c["met"] / max(1, c["of"]), display(c["unit"]), values[c["name"]]
        good = good[np.isfinite(good)]
        row = {"name": c["name"], "met": f"{c['met']} of {c['of']}", "share": percent(share) if c["of"] else "–"}
        row |= {"max": append_unit(plain(c["max"] * factor, None), unit), "bar": _bar(share, *c["ci95"])}
        shares.append({**row, "interval": " … ".join(map(percent, c["ci95"]))})
        at = np.quantile(good, QUANTILES) if good.size else np.full(len(QUANTILES), np.nan)
        quantiles.append((c["name"], *(_figure(v, c["unit"]) for v in at.tolist()), str(c["of"] - good.size or "–")))
    scatters, more_scatters = _scatters(swept, table, {s.outcome: s.ranked for s in indices}, charts)
    bands = []
    for name in names if completed else ():
        q = np.quantile(signal_of(table, name, MAX_BAND_RUNS), QUANTILES, axis=0)
        lines = ("median", q[2], "true"), ("25 %", q[1], "reference"), ("75 %", q[3], "reference")
        bands.append(signal_panel(name, record["units"].get(name, ""), lines, ("5 … 95 % of the runs", q[0], q[4])))
    worst = _worst(swept, table) if criteria else []
    met_all = bool(criteria) and record["met_all"] == record["runs"]
    context = {
        "name": record["name"],
        "description": study.file.description,
        "outcome": swept.headline,
        "badges": [counted(record["runs"], "run"), (f"{failed} aborted", "bad") if failed else "all completed"],
        "warnings": warnings,
        "tone": "plain" if not criteria else "good" if met_all else "bad",
        "criteria": shares,
        "values": quantiles,
        "worst": worst,
        "hardest_name": hardest(record)["name"] if criteria else "",
        "histograms": histograms(criteria, values, charts),
        "parallel": _parallel_coordinates(swept, table),
        "scatters": scatters,
        "more_scatters": more_scatters,
        "factors": [_factor(swept, factor) for factor in study.factors],
        "plots": charts.over(np.array(record["times"], float)).plots(bands),
        "always_met": [s.outcome for s in indices if s.outcome in values.keys() - missed],
        "unranked": sorted(missed - {s.outcome for s in first}) if first else [],
        "sensitivities": [_indices(s) for s in first or others],
        "more_sensitivities": [_indices(s) for s in others] if first else [],
        "failures": record["failures"],
        "more_failures": max(0, failed - len(record["failures"])),
        "sampling_note": note,
        "repeat": f"cosim sweep {shell_path(study.yaml.path)}",
    }
    return render(TEMPLATE, context, charts)


def _bar(value: float, low: float, high: float) -> Mapping[str, float]:
    """Return a share and its interval in percent, for a bar."""
    value, low, high = (round(100 * min(1.0, max(0.0, v)), 2) for v in (value, low, high))
    return {"value": value, "low": low, "width": round(high - low, 2)}


def _figure(value: float, unit: str) -> str:
    """Return a value in its display unit."""
    shown, factor = display(unit)
    return append_unit(plain(value * factor, 3), shown)


def _worst(swept: Swept, table: Any) -> list[Mapping[str, Any]]:
    """Return the worst runs by the criterion that the fewest runs meet; runs with an undefined value are first."""
    criterion = hardest(swept.record)
    reached, runs = swept.criteria[criterion["name"]], table.column("run").to_pylist()
    completed = np.array(table.column("status").to_pylist()) == "ok"
    far = np.where(np.isfinite(reached), reached, np.inf)
    failing = np.flatnonzero(completed & (far > criterion["max"]))
    rows: list[Mapping[str, Any]] = []
    for k in failing[np.argsort(-far[failing], kind="stable")][:MOST_LISTED]:
        cells = {name: column[runs[k]] for name, column in swept.sweep.columns.items()}
        texts = (f"{name} = {f'{v:.4g}' if isinstance(v, float) else v}" for name, v in cells.items())
        value = _figure(float(reached[k]), criterion["unit"]) if np.isfinite(reached[k]) else "never"
        command = repeat_command(swept.sweep, runs[k])
        rows.append({"run": runs[k], "value": value, "factors": ", ".join(texts), "command": command})
    return rows


def _numeric_factors(swept: Swept) -> dict[str, tuple[Array, str]]:
    """Return factor → (values in all runs, unit), for numeric factors."""
    units = {factor.name: factor.unit for factor in swept.sweep.factors}
    columns = swept.sweep.columns.items()
    return {n: (np.array(c, float), units[n]) for n, c in columns if n != "seed" and are_numbers(c)}


def _scatters(
    swept: Swept, table: Any, ranked: Mapping[str, Sequence[str]], charts: Charts
) -> tuple[list[Plot], list[Plot]]:
    """Draw criteria over their two most important factors, and over the others; criteria met by all runs are last."""
    factors, criteria = _numeric_factors(swept), swept.record["criteria"]
    missed = [c for c in criteria if c["met"] != c["of"]] or criteria
    runs, plots, others = np.array(table.column("run").to_pylist(), int), list[Plot](), list[Plot]()
    for c in sorted(criteria, key=lambda c: c["met"])[:MOST_SCATTERED]:
        values = swept.criteria[c["name"]]
        good = np.flatnonzero(np.isfinite(values))
        good = good[:: max(1, -(-good.size // MAX_SCATTER_POINTS))]
        unit, factor = display(c["unit"])
        for place, name in enumerate(dict.fromkeys((*ranked.get(c["name"], ()), *factors))):
            if name not in factors or good.size < 2 or np.ptp(factors[name][0][runs[good]]) == 0.0:
                continue
            x_unit, scale = display(factors[name][1])
            x = factors[name][0][runs[good]] * scale
            order, y, limit = np.argsort(x, kind="stable"), values[good] * factor, c["max"] * factor
            panel = Panel(f"{c['name']} over {name}", unit or "1", [Trace(c["name"], y[order], "s0 dots", x=x[order])])
            also = {"run": runs[good][order].astype(float)}
            marks = {"reach": _around([*y, limit], 0.06), "levels": [limit], "limit": "limit"}
            chart = charts.points(panel, _around(x, 0.04), (name, x_unit or "1"), also, **marks)
            (plots if place < 2 and c in missed else others).append(chart)
    return plots, others[:MOST_OTHERS]


def _around(values: Array | Sequence[float], room: float) -> tuple[float, float]:
    """Return limits of an axis that exceed the values by `room`, a share of their range."""
    low, high = float(np.min(values)), float(np.max(values))
    margin = room * (high - low) or 1.0
    return low - margin, high + margin


def histograms(criteria: Sequence[Criterion], values: Mapping[str, Array], charts: Charts) -> list[Plot]:
    """Draw a histogram of each criterion's values over the runs, with the limit."""
    plots = []
    for c in criteria:
        unit, factor = display(c["unit"])
        found, limit = values[c["name"]][np.isfinite(values[c["name"]])] * factor, c["max"] * factor
        if found.size < 2 or np.ptp(found) == 0.0:
            continue
        counts, edges = np.histogram(found, min(MAX_HISTOGRAM_BINS, np.histogram_bin_edges(found, "auto").size - 1))
        trace = Trace("runs", np.array([0.0, *counts, 0.0]), "s0", held=True, x=np.array([edges[0], *edges]))
        panel = Panel(c["name"], "runs", [trace], limit_label="limit")
        plots.append(charts.alone(panel, _around([*edges, limit], 0.04), (c["name"], unit or "1"), uprights=[limit]))
    return plots


def _parallel_coordinates(swept: Swept, table: Any) -> Mapping[str, Any] | None:
    """Return axes and lines of runs in parallel coordinates: numeric factors, then criteria that a run misses.

    The rarer kind of runs is drawn last, above the other one. The result is None if no run misses a criterion.
    """
    criteria = [c for c in swept.record["criteria"] if c["met"] != c["of"]]
    runs = np.array(table.column("run").to_pylist(), int)
    axes = {name: (column[runs], unit) for name, (column, unit) in _numeric_factors(swept).items()}
    axes |= {c["name"]: (swept.criteria[c["name"]], c["unit"]) for c in criteria}
    axes = {name: entry for name, entry in axes.items() if (span := extent([entry[0]])) and span[1] > span[0]}
    if len(axes) < 2 or not criteria:
        return None
    is_met = np.all([np.array(table.column(f"{c['name']} met").to_pylist(), bool) for c in criteria], axis=0)
    chosen = np.unique(np.linspace(0, runs.size - 1, min(runs.size, MAX_PARALLEL_LINES)).astype(int))
    heads, heights = [], []
    for k, (name, (values, unit)) in enumerate(axes.items()):
        low, high = np.nanmin(values), np.nanmax(values)
        left = 100.0 * k / (len(axes) - 1)
        heads.append({"name": name, "high": _figure(high, unit), "low": _figure(low, unit), "left": left})
        heights.append(100.0 * (high - values) / (high - low))
    lines = []
    for row in sorted(chosen, key=lambda row: is_met[row] == (np.mean(is_met) < 0.5)):
        points = [f"{h['left']:.1f},{y[row]:.1f}" for h, y in zip(heads, heights, strict=True) if np.isfinite(y[row])]
        lines.append({"points": " ".join(points), "met": bool(is_met[row]), "run": int(runs[row])})
    return {"axes": heads, "lines": lines}


def _factor(swept: Swept, factor: Factor) -> Sequence[str]:
    """Return name, unit, kind of variation, values, and number of different values of a factor."""
    varied, values = swept.sweep.file.vary[factor.name], swept.sweep.columns[factor.name]
    entries: Any = getattr(varied, varied.way)
    if isinstance(entries, Grid):
        entries = [f"{key} {value}" for key, value in entries.model_dump(by_alias=True).items()]
    listed = some([*map(str, entries if isinstance(entries, list | tuple) else [entries])], 8)
    different = counted(len(set(map(str, values))), "value")
    return factor.name, written(factor.unit) or "–", varied.way.replace("_", " "), listed, different


def _indices(s: Sensitivity) -> Mapping[str, Any]:
    """Return name, rank, bar, size and first-order index of each factor, for the template."""

    def pair(value: float, half: float) -> str:
        return f"{plain(value, 2)} ± {plain(half, 1)}"

    rows, ranks = [], {name: str(k) for k, name in enumerate(s.ranked, 1)}
    for k, name in enumerate(s.factors):
        # without total indices, a mark at what chance reaches
        drawn, text = _bar(s.pawn[k], s.chance, s.chance + MARK_WIDTH), plain(s.pawn[k], 2)
        if s.total:
            size, half = s.total[k]
            drawn, text = _bar(size, size - half, size + half), pair(size, half)
        rank = ranks.get(name, "not proven")
        rows.append({"name": name, "rank": rank, "bar": drawn, "size": text, "first": pair(*s.first[k])})
    return {"outcome": s.outcome, "rows": rows, "total": bool(s.total), "chance": plain(s.chance, 2)}
