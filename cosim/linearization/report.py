"""The page of a linearisation: poles and their meaning, the operating point, Bode plots, the matrices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.text import counted, plain, split_sentence, written
from cosim.base.version import __version__
from cosim.linearization.descriptions import headline, number, pole_rows
from cosim.linearization.frequency_response import Response, frequencies, response
from cosim.linearization.kinks import RATE, Kink, KinkSlopes
from cosim.linearization.linear_model import Linear
from cosim.linearization.result import Outcome
from cosim.linearization.system_structure import Pole, poles
from cosim.report.charts import Abscissa, Charts, Plot
from cosim.report.html_tables import Badge
from cosim.report.panels import Panel, Trace
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "linearize.html.j2"
CURVES_PER_PANEL = 6
MAX_PAIRS = 40  # of panels, magnitude and phase
MAX_COLUMNS = 24  # of a displayed matrix
MIN_RESPONSE = 1e-12  # relative to the largest response


def page(outcome: Outcome) -> str:
    """Return a self-contained page of the first linearisation."""
    linear, structure = outcome.first, outcome.structure
    times = [m.point.time for m in outcome.linear]
    description = f"{outcome.title}, linearised at t = {plain(linear.point.time)} s: {linear.method}."
    if len(times) > 1:
        description += (
            f" {len(times)} times from {plain(times[0])} to {plain(times[-1])} s; this page shows the first, "
            "linear.json and linear.mat hold all."
        )
    stability, reach = split_sentence(headline(structure, linear))
    charts = Charts()
    bode = _bode(linear)
    plots = _draw([(size, phase) for _, size, phase in bode[:MAX_PAIRS]], frequencies(linear), charts)
    return render(
        TEMPLATE,
        {
            "name": PurePath(outcome.name).name,
            "description": description,
            "outcome": stability,
            "reach": reach,
            "badges": _badges(linear, structure.stable),
            "notes": outcome.notes,
            "states": _values(linear, linear.states, linear.point.states, linear.rates),
            "inputs": _values(linear, linear.inputs, linear.point.inputs),
            "time": plain(linear.point.time),
            "map": pole_map(structure.poles, charts) if structure.poles else None,
            "poles": pole_rows(structure),
            "rank": (structure.controllable, structure.observable, len(linear.states)),
            "condition": number(structure.condition) if math.isfinite(structure.condition) else "",
            "bode": [(output, pair) for (output, *_), pair in zip(bode, plots, strict=False)],
            "left_out": max(0, len(bode) - MAX_PAIRS),
            "along": _along(outcome, charts),
            "data": charts.data(),  # after all drawings
            "kinks": [_kink_row(k, r) for k in linear.kinks for r in k.rows],
            "matrices": [_matrix(linear, n) for n in "ABCD"],
            "largest": MAX_COLUMNS,
            "version": __version__,
        },
    )


def _kink_row(kink: Kink, row: KinkSlopes) -> dict[str, str]:
    slope = f"rate of {row.name}" if row.of == RATE else row.name
    values = {"value": kink.value, "below": row.below, "above": row.above, "jump": row.jump}
    return {"variable": kink.variable, "row": slope, "side": kink.side, **{n: number(v) for n, v in values.items()}}


def _badges(linear: Linear, is_stable: bool) -> list[Badge]:
    groups = ((linear.states, "state"), (linear.inputs, "input"), (linear.outputs, "output"))
    sizes = [Badge(counted(len(group), noun)) for group, noun in groups]
    stable = "asymptotically stable" if linear.at_rest else "all poles to the left"
    stability = Badge(stable, "good") if is_stable else Badge(f"not {stable}", "plain")
    rest = Badge("equilibrium", "good") if linear.at_rest else Badge("no equilibrium: derivatives are not zero")
    return [*sizes, stability, rest]


def _values(linear: Linear, names: Sequence[str], values: Array, rates: Array | None = None) -> list[dict[str, str]]:
    rate_texts = [""] * len(names) if rates is None else [number(v) for v in rates]
    return [
        {"name": n, "unit": written(linear.unit(n)), "value": number(v), "rate": rate}
        for n, v, rate in zip(names, values, rate_texts, strict=True)
    ]


def _matrix(linear: Linear, name: str) -> dict[str, Any]:
    matrix = getattr(linear, name)
    rows = linear.states if name in "AB" else linear.outputs
    columns = linear.states if name in "AC" else linear.inputs
    return {
        "name": name,
        "columns": columns,
        "fits": len(columns) <= MAX_COLUMNS and len(rows) <= 4 * MAX_COLUMNS,
        "rows": [(n, [number(v) if v else "" for v in row]) for n, row in zip(rows, matrix, strict=True)],
    }


def pole_map(every: Sequence[Pole], charts: Charts) -> Plot:
    """Draw the poles as crosses in the complex plane."""
    inward = sorted(every, key=lambda p: (p.value.real, p.value.imag))
    real, imag = np.array([p.value.real for p in inward]), np.array([p.value.imag for p in inward])
    reach = max(float(np.abs(imag).max()), 0.1 * float(np.abs(real).max()), 1e-3)
    low, high = min(float(real.min()), 0.0), max(float(real.max()), 0.0)
    margin = 0.06 * (high - low or reach)
    panel = Panel("Imaginary part of the poles", "rad/s", [Trace("imaginary part", imag, "s0 crosses", x=real)])
    also = {
        "real part [1/s]": real,
        "ωₙ [rad/s]": np.array([p.natural_frequency for p in inward]),
        "ζ": np.array([p.damping_ratio for p in inward]),
        "times": np.array([p.count for p in inward], float),
    }
    ends, shown = (low - margin, high + margin), {"uprights": (0.0,), "limit": "imaginary axis"}
    return charts.points(panel, ends, ("real part", "1/s"), also, reach=(-1.15 * reach, 1.15 * reach), **shown)


def _bode(linear: Linear) -> list[tuple[str, Panel, Panel]]:
    """Return magnitude and phase of each output."""
    g = response(linear, frequencies(linear))
    sizes = np.abs(g).max(axis=2, initial=0.0)
    acting = sizes > MIN_RESPONSE * np.maximum(sizes.max(axis=0, initial=0.0), 1e-300)
    figures = []
    for i, name in enumerate(linear.outputs):
        inputs = np.flatnonzero(acting[i]).tolist()
        for first in range(0, len(inputs), CURVES_PER_PANEL):
            figures.append((name, *_pair(linear, g, i, inputs[first : first + CURVES_PER_PANEL])))
    return figures


def _pair(linear: Linear, g: Response, i: int, inputs: Sequence[int]) -> tuple[Panel, Panel]:
    sizes, phases = [], []
    for j, k in enumerate(inputs):
        with np.errstate(divide="ignore", invalid="ignore"):
            decibels = 20.0 * np.log10(np.abs(g[i, k]))
            phase = np.degrees(np.unwrap(np.angle(g[i, k])))
        sizes.append(Trace(linear.inputs[k], np.where(np.isfinite(decibels), decibels, np.nan), f"s{j}"))
        phases.append(Trace(linear.inputs[k], phase, f"s{j}"))
    name = linear.outputs[i]
    return Panel(f"{name}: magnitude", "dB", sizes), Panel(f"{name}: phase", "°", phases)


def _draw(pairs: Sequence[tuple[Panel, Panel]], omega: Array, charts: Charts) -> list[tuple[Plot, ...]]:
    """Draw the magnitude and the phase of each Bode plot over a common frequency axis."""
    if not pairs:
        return []
    drawing = charts.over(omega, Abscissa(("frequency", "rad/s"), log=True))
    return [tuple(drawing.plots(pair)) for pair in pairs]


def _along(outcome: Outcome, charts: Charts) -> Plot | None:
    """Draw the poles' real parts over several times."""
    if len(outcome.linear) < 2:
        return None
    time = np.array([m.point.time for m in outcome.linear])
    real = np.array([sorted(poles(m.A).real) for m in outcome.linear]).reshape(len(time), -1)
    traces = [Trace(f"{j + 1}", real[:, j], f"s{j % 6}") for j in range(real.shape[1])]
    return charts.over(time).plots([Panel("Real parts of the poles", "1/s", traces)])[0]
