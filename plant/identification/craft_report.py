"""The page of parameters identified from logs of a craft."""

from __future__ import annotations

from pathlib import Path

from cosim.base.text import counted
from cosim.base.version import __version__
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge
from cosim.report.template import render
from plant.identification.craft import CraftOutcome
from plant.identification.report import number, plot_of

TEMPLATE = Path(__file__).with_name("templates") / "craft_logs.html.j2"
TITLES = {"rest": "Noise at rest, eqs 5.44\u20135.46", "distance": "Distance covered, §5.5"}


def page(outcome: CraftOutcome) -> str:
    """Return the self-contained HTML page of a craft identification."""
    craft, charts = outcome.craft, Charts()
    logs = len(craft.rest) + len(craft.runs)
    rows = []
    for e in outcome.estimates.values():
        value, low, high, thesis = (number(v, e.unit, e.half_width) for v in (e.value, e.low, e.high, e.thesis))
        shown = {"value": value, "interval": f"{low} … {high}", "thesis": thesis}
        rows.append({"name": e.name, "origin": e.origin, **shown})
    return render(
        TEMPLATE,
        {
            "name": craft.file.name,
            "headline": f"{counted(len(rows), 'number')} identified from {counted(logs, 'log')} of the craft.",
            "rows": rows,
            "version": __version__,
            "badges": [Badge(craft.loaded.model.title), Badge(counted(logs, "log"))],
            "parts": [
                {
                    "name": r.test,
                    "title": TITLES[r.test],
                    "notes": r.notes,
                    "plots": [plot_of(f, charts) for f in r.figures],
                }
                for r in outcome.results
            ],
            "repeat": f"cosim identify {craft.yaml.path}",
            "data": charts.data(),  # after all drawings
        },
    )
