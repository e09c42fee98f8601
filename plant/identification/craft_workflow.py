"""Workflow for logs of a craft: analysis, model.yaml, identify.json and page."""

from __future__ import annotations

from pathlib import Path

from cosim.base.text import counted
from cosim.base.version import __version__
from cosim.report.charts import Charts
from cosim.report.html_tables import Badge
from cosim.report.template import render
from cosim.storage.files import check_writable
from cosim.storage.yaml_file import YamlFile
from plant.identification.craft import CraftOutcome, read_craft
from plant.identification.distance import distance
from plant.identification.report import number, plot_of
from plant.identification.rest_noise import noise
from plant.identification.write import RECORD, REPORT, model_text, write

FILES = ("model.yaml", RECORD, REPORT)
TEMPLATE = Path(__file__).with_name("templates") / "craft_logs.html.j2"
TITLES = {"rest": "Noise at rest, eqs 5.44\u20135.46", "distance": "Distance covered, §5.5"}


def identify_craft(yaml: YamlFile, out: Path, *, report: bool = True) -> CraftOutcome:
    """Analyse logs of a craft and write results.

    The files of an earlier identification are replaced.

    Raises:
        InputError: Every fault of the file and its logs.
    """
    craft = read_craft(yaml)
    check_writable(out, FILES, craft.files)
    outcome, file = CraftOutcome(craft), craft.file
    if file.rest is not None:
        outcome.results.append(noise(craft.rest, craft.loaded.model, file.rest.window))
    if file.distance is not None:
        parameter, output = file.distance.parameter, file.distance.output
        outcome.results.append(distance(craft.runs, craft.loaded, parameter, output, craft.distances))
    draw = (lambda: page(outcome)) if report else None
    write(out, (FILES[0], _model(outcome)), {"name": file.name}, outcome.results, draw, read=craft.files)
    return outcome


def _model(outcome: CraftOutcome) -> str:
    loaded = outcome.craft.loaded
    identified = {e.name: e for r in outcome.results if r.test == "distance" for e in r.estimates}
    values = {**loaded.parameters, **{n: e.value for n, e in identified.items()}}
    return model_text(loaded.source, values, loaded.sensors, identified, "runs")


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
