"""The page of a linearisation: poles and their meaning, the operating point, Bode plots, the matrices."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path, PurePath

import numpy as np

from cosim.core.arrays import Array
from cosim.core.text import append_unit, counted, plain, split_sentence, written
from cosim.linearization.linear_model import Linear, Pole, poles
from cosim.linearization.write import Outcome, headline, number, pole_rows
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Panel, Trace
from cosim.report.template import render

TEMPLATE = Path(__file__).with_name("templates") / "linearize.html.j2"
CURVES_PER_PANEL = 6
MAX_BODE_PAIRS = 40  # of panels, magnitude and phase
MAX_PAGE_COLUMNS = 24  # rows and columns of a displayed matrix
FREQUENCY_POINTS = 400  # number of frequencies
DECADE = 10.0  # range of frequencies, as a factor below the slowest and above the fastest nonzero pole
MIN_RESPONSE = 1e-12  # smallest drawn response, relative to the largest


def page(outcome: Outcome) -> str:
    """Return the self-contained HTML page of the first linearization."""
    linear, structure, charts = outcome.first, outcome.structure, Charts()
    times = np.array([m.point.time for m in outcome.linear])
    description = f"{outcome.title}, linearised at t = {plain(linear.point.time)} s: {linear.method}."
    plots = []
    if structure.poles:
        plots.append(pole_map(structure.poles, charts))
    if len(times) > 1:
        description += (
            f" {len(times)} times from {plain(times[0])} to {plain(times[-1])} s; this page shows the first, "
            "linear.json and linear.mat contain all."
        )
        real = np.array([sorted(poles(m.A).real) for m in outcome.linear]).reshape(len(times), -1)
        traces = [Trace(f"{j + 1}", real[:, j], f"s{j % 6}") for j in range(real.shape[1])]
        plots += charts.over(times).plots([Panel("Real parts of the poles", "1/s", traces)])
    stability, reach = split_sentence(headline(structure, linear))
    omega = frequencies(linear)
    bode = bode_panels(linear, omega)
    drawing = charts.over(omega, ("frequency", "rad/s"), log=True) if bode else None
    stable = "asymptotically stable" if linear.at_rest else "all poles in the left half-plane"
    names, rates = (*linear.states, *linear.inputs), [*map(number, linear.rates), *[""] * len(linear.inputs)]
    point = zip(names, map(number, (*linear.point.states, *linear.point.inputs)), rates, strict=True)
    matrices = []
    for name in "ABCD":
        matrix, rows, columns = linear.matrix(name)
        texts = [(n, [number(v) if v else "" for v in row]) for n, row in zip(rows, matrix, strict=True)]
        fits = len(columns) <= MAX_PAGE_COLUMNS and len(rows) <= 4 * MAX_PAGE_COLUMNS
        matrices.append({"name": name, "columns": columns, "fits": fits, "rows": texts})
    values = {
        "name": PurePath(outcome.name).name,
        "description": description,
        "outcome": stability,
        "reach": reach,
        "badges": [
            *(counted(len(getattr(linear, f"{noun}s")), noun) for noun in ("state", "input", "output")),
            (stable, "good") if structure.stable else f"not {stable}",
            ("equilibrium", "good") if linear.at_rest else "not an equilibrium: derivatives are not zero",
        ],
        "notes": outcome.notes,
        "point": [
            (n, append_unit(value, written(linear.units.get(n, ""))), rate or "input") for n, value, rate in point
        ],
        "time": plain(linear.point.time),
        "plots": plots,
        "poles": pole_rows(structure),
        "rank": (structure.controllable, structure.observable, len(linear.states)),
        "condition": number(structure.condition) if math.isfinite(structure.condition) else "",
        "bode": drawing.plots([panel for pair in bode[:MAX_BODE_PAIRS] for panel in pair]) if drawing else [],
        "left_out": len(bode[MAX_BODE_PAIRS:]),
        "matrices": matrices,
        "largest": MAX_PAGE_COLUMNS,
    }
    return render(TEMPLATE, values, charts)


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


def frequencies(linear: Linear) -> Array:
    """Return frequencies [rad/s] that span the poles; 0.01 … 100 without poles."""
    sizes = np.abs(poles(linear.A))
    nonzero = sizes[sizes > 1e-6 * sizes.max(initial=0.0)]
    low, high = (nonzero.min() / DECADE, nonzero.max() * DECADE) if nonzero.size else (0.01, 100.0)
    return np.asarray(10.0 ** np.linspace(np.floor(np.log10(low)), np.ceil(np.log10(high)), FREQUENCY_POINTS))


def bode_panels(linear: Linear, omega: Array) -> list[tuple[Panel, Panel]]:
    """Return panels of magnitude and phase of each output, with a curve for each input that affects it."""
    g = np.asarray(linear.ss()(1j * omega, squeeze=False))  # (outputs, inputs, frequencies)
    sizes = np.abs(g).max(axis=2, initial=0.0)
    acting = sizes > MIN_RESPONSE * np.maximum(sizes.max(axis=0, initial=0.0), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        decibels = 20.0 * np.log10(np.abs(g))
    decibels[~np.isfinite(decibels)] = np.nan
    kinds = ("magnitude", "dB", decibels), ("phase", "°", np.degrees(np.unwrap(np.angle(g))))
    figures = []
    for i, name in enumerate(linear.outputs):
        inputs = np.flatnonzero(acting[i]).tolist()
        for first in range(0, len(inputs), CURVES_PER_PANEL):
            chosen = [*enumerate(inputs[first : first + CURVES_PER_PANEL])]
            size, phase = (
                Panel(f"{name}: {kind}", unit, [Trace(linear.inputs[k], values[i, k], f"s{j}") for j, k in chosen])
                for kind, unit, values in kinds
            )
            figures.append((size, phase))
    return figures
