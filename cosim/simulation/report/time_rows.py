"""Where the wall time of a run went: rows of the report, and a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosim.base.text import plain
from cosim.simulation.report.recorded import Run, mapping, number

MIN_READINGS = 100  # about half a second, below which shares say little
MIN_SHARE = 0.01  # of a component with a row


@dataclass(frozen=True)
class TimeRow:
    """Wall time of a component by calls [s], as text."""

    label: str
    share: str
    step: str
    set: str
    get: str
    other: str


def time_rows(run: Run) -> list[TimeRow]:
    """Return the measured times of components, and of waiting."""
    timings = mapping(run.manifest.get("timings"))
    if not number(timings.get("readings")) >= MIN_READINGS:
        return []
    rows = []
    for name, entry in mapping(timings.get("components")).items():
        times = mapping(entry)
        if number(times.get("share")) >= MIN_SHARE:
            seconds = (f"{plain(number(times.get(call)), 2)} s" for call in ("step", "set", "get", "other"))
            rows.append(TimeRow(str(name), f"{number(times.get('share')):.0%}", *seconds))
    if (waiting := number(timings.get("waiting"), 0.0)) > 0.0:
        rows.append(TimeRow("waiting for the pace, or in a pause", "not counted", "", "", "", f"{plain(waiting, 2)} s"))
    return rows


def time_sentence(timings: Mapping[str, Any]) -> str:
    """Return a sentence on the slowest component, if measured."""
    if not number(timings.get("readings")) >= MIN_READINGS:
        return ""
    components = mapping(timings.get("components"))
    if not components:
        return ""
    name, entry = next(iter(components.items()))
    times = mapping(entry)
    steps = sum(number(times.get(call)) for call in ("step", "set", "get"))
    words = f"{plain(steps, 2)} s in steps, {plain(number(times.get('other')), 2)} s in loading"
    sentence = f"{name} takes {number(times.get('share')):.0%} of the time, loading included ({words})"
    if (waiting := number(timings.get("waiting"), 0.0)) > 0.0:
        sentence += f"; {plain(waiting, 2)} s of waiting for the pace or in a pause are not counted"
    return f"{sentence}."
