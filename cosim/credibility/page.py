"""The page of the record of credibility of an FMU: region, error bands, parameters, logs."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cosim.core.text import amount, counted, plain
from cosim.credibility.record import Credibility, require_credibility
from cosim.files.files import write_text
from cosim.report.charts import Charts, Plot
from cosim.report.panels import Panel, Trace, axis_unit
from cosim.report.template import Row, render

TEMPLATE = Path(__file__).with_name("templates") / "credibility.html.j2"
ESTIMATE_DIGITS = 6  # of estimates and intervals


def write_page(fmu: Path) -> Path:
    """Write the page of an FMU's record into the current folder and return its path; raise InputError without one."""
    record, problem = require_credibility(fmu)
    charts, region = Charts(), record.region
    values = {
        "name": f"{record.model} ({fmu.name})",
        "record": record,
        "problem": problem,
        "badges": [record.verdict, counted(len(record.logs), "log"), f"by {record.command}"],
        "bands": [_band_plot(record, name, charts) for name in record.bands.widths],
        "coordinates": [
            (c.name, c.kind, amount(c.low, c.unit, 4), amount(c.high, c.unit, 4)) for c in region.coordinates
        ],
        "left_out": [Row(name, reason) for name, reason in region.left_out.items()],
        "parameters": [
            (
                n,
                amount(p.value, p.unit, ESTIMATE_DIGITS),
                " … ".join(amount(e, p.unit, ESTIMATE_DIGITS) for e in p.ci95 or ()),
            )
            for n, p in record.parameters.items()
        ],
        "logs": [
            (log.source, use, log.rows, f"{plain(log.duration)} s", log.sha256)
            for use, of in (("estimate", record.logs), ("sealed", record.sealed))
            for log in of
        ],
    }
    path = Path(f"{fmu.stem}-credibility.html")
    write_text(path, render(TEMPLATE, values, charts))
    return path


def _band_plot(record: Credibility, name: str, charts: Charts) -> Plot:
    """Draw the half-width of a band over the time since the start of a run."""
    bands = record.bands
    ends = np.array([0.0, *bands.horizons])
    widths = np.array([np.nan if w is None else w for w in bands.widths[name]])
    label = f"{100 * bands.level:g} % of the errors are smaller"
    trace = Trace(label, np.append(widths, widths[-1:]), "true", held=True, x=ends)
    panel = Panel(f"Error of {name}", axis_unit(bands.units.get(name, "")), [trace])
    largest = 1.08 * float(np.nanmax(widths))
    return charts.alone(panel, (0.0, float(ends[-1])), ("time since the start", "s"), reach=(0.0, largest))
