"""Where the wall time of a run went: rows of the report, and a sentence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from cosim.base.text import plain
from cosim.simulation.report.recorded import Run, mapping, mappings, number

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
    """Return a sentence on slow components, if measured."""
    if not number(timings.get("readings")) >= MIN_READINGS:
        return ""
    parts: dict[str, list[str]] = {}
    for name, entry in mapping(timings.get("components")).items():
        times = mapping(entry)
        steps = sum(number(times.get(call)) for call in ("step", "set", "get"))
        words = f"{plain(steps, 2)} s in steps, {plain(number(times.get('other')), 2)} s in loading"
        parts[str(name)] = [f"{number(times.get('share')):.0%} of the time, loading included ({words})"]
        break
    for slower in mappings(timings.get("slower")):
        factor, since = number(slower.get("factor")), number(slower.get("since"))
        words = f"{plain(factor, 2)} times longer for a step after {since:g} s"
        name = str(slower.get("component")) or "every component"
        parts.setdefault(name, []).append(words)
    sentences = [f"{name} takes {', and '.join(words)}" for name, words in parts.items()]
    if parts and (waiting := number(timings.get("waiting"), 0.0)) > 0.0:
        sentences.append(f"{plain(waiting, 2)} s of waiting for the pace or in a pause are not counted")
    return "; ".join(sentences) + "." if parts else ""
