"""Validity of a run of an FMU with a record of credibility: time in the region of its logs, and error bands."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from cosim.blocks.fmu import FmuBlock
from cosim.core.arrays import Array, NamedArrays
from cosim.core.text import percent
from cosim.credibility.found import read_credibility
from cosim.files.results import Results
from cosim.report.panels import Panel, signal_panel

Validity = Mapping[str, Any]


def validities(components: Iterable[Any], results: Results) -> dict[str, dict[str, Any]]:
    """Return component → validity in a run, for FMUs with a record of credibility."""
    found = {}
    for block in components:
        if not (isinstance(block, FmuBlock) and any(read_credibility(block.path))):
            continue
        names = {column.partition(".")[2]: column for column in results.columns if column.startswith(f"{block.name}.")}
        signals = {name: results[column] for name, column in names.items()}
        for v in block.description.modelVariables:
            if v.causality == "input" and v.name not in names and v.name not in block.connected:
                with suppress(TypeError, ValueError):  # an input that keeps its start value
                    start = float(block.start_values.get(v.name, v.start))
                    signals[v.name] = np.full(results.time.size, start)
        if entry := validity_of(block.path, results.time, signals):
            found[block.name] = entry
    return found


def validity_of(fmu: Path, time: Array, signals: NamedArrays) -> dict[str, Any]:
    """Return the validity of a run of an FMU for its manifest, empty for an FMU without a record.

    Args:
        signals: Inputs and outputs of the FMU, shape (rows,).

    Returns:
        `share`: share of the time within the region; `outside`: times of leaving and of coming back [s]; `leaves`: time
        of the first leaving for more than one row, `by` its coordinate; `missing`: coordinates that were not recorded;
        `bands`: error bands; `problem`: what is wrong with the record.
    """
    record, problem = read_credibility(fmu)
    if record is None:
        return {"problem": problem} if problem else {}
    entry: dict[str, Any] = {"share": None, "outside": [], "by": "", "leaves": None, "missing": [], "problem": problem}
    entry["bands"] = record.bands.model_dump(mode="json", include={"level", "horizons", "widths", "units", "reason"})
    if record.region.reason or not time.size:
        return entry | {"reason": record.region.reason}
    from cosim.credibility.region import Stretch, distances

    away = distances(record.region, Stretch(time, signals))
    if len(away.missing) == len(record.region.coordinates):
        return entry | {"reason": "none of its signals is recorded", "missing": [*away.missing]}
    inside, end = away.ratio <= 1.0, np.append(away.time[1:], time[-1])  # a value that is not finite is outside
    lasts = end - away.time
    entry["share"] = float(lasts[inside].sum() / lasts.sum()) if lasts.any() else float(inside.mean())
    edges = np.flatnonzero(np.diff(np.concatenate([[True], inside, [True]]).astype(int)))
    bounds = np.append(away.time, time[-1])[edges].tolist()
    entry["outside"] = [list(pair) for pair in zip(bounds[::2], bounds[1::2], strict=True)]
    if not inside.all():  # a single row may be a false alarm
        lasting = [begin for begin, end in entry["outside"] if end - begin > 1.5 * record.region.step]
        entry["leaves"] = (lasting or bounds)[0]
        row = int(np.searchsorted(away.time, entry["leaves"]))
        entry["by"] = record.region.coordinates[int(away.farthest[min(row, inside.size - 1)])].name
    return entry | {"missing": [*away.missing]}


def validity_sentence(name: str, entry: Validity) -> str:
    """Return a sentence on how long a component was in its region; "" without this share and a reason for that."""
    share = entry.get("share")
    if share is None:
        return f"{name}: validity not judged: {entry['reason']}" if entry.get("reason") else ""
    leaves = f"; leaves the data at {entry['leaves']:.4g} s by {entry['by']}" if entry["by"] else ""
    partly = f" (not judged: {', '.join(entry['missing'])})" if entry["missing"] else ""
    return f"{name}: valid for {percent(share)} of the run{leaves}{partly}"


def validity_warnings(validity: Mapping[str, Validity]) -> list[str]:
    """Return the problems of the records of components."""
    return [f"{name}: {entry['problem']}" for name, entry in validity.items() if entry.get("problem")]


def output_panels(name: str, entry: Validity, time: Array, outputs: NamedArrays) -> list[Panel]:
    """Return a panel for each output with a band: the output, its band, and the time outside the region.

    Args:
        outputs: Output → values, shape (rows,).
    """
    bands, panels = entry.get("bands") or {}, []
    widths, level = bands.get("widths") or {}, percent(float(bands.get("level", 0.0)))
    for output, values in outputs.items():
        if output not in widths:
            continue
        half = band_of(entry, output, time - time[:1])
        unit = str(bands["units"].get(output) or "")
        lines, band = [(output, values, "true")], (f"{level} of the errors", values - half, values + half)
        panels.append(signal_panel(f"{name}.{output}", unit, lines, band, outside=outside_of(entry)))
    return panels


def band_of(entry: Validity, output: str, ages: Array) -> Array:
    """Return the half-width of the band of an output by the time since the start [s], NaN where unknown."""
    from cosim.credibility.bands import Bands

    return Bands.model_validate(entry["bands"]).at(output, ages)


def bands_of_run(manifest: Mapping[str, Any], column: str, time: Array) -> Array | None:
    """Return the half-width of the band of a recorded signal, None without a band in the manifest of the run."""
    name, _, output = column.partition(".")
    entry = (manifest.get("validity") or {}).get(name) or {}
    if output not in ((entry.get("bands") or {}).get("widths") or {}):
        return None
    return band_of(entry, output, time - time[:1])


def outside_of(entry: Validity) -> Sequence[tuple[float, float]]:
    """Return the intervals outside the region [s]."""
    return tuple((float(a), float(b)) for a, b in entry.get("outside") or ())
