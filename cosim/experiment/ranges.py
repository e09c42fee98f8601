"""Limits of an experiment: excursions from the start, and ranges of commands."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence

from cosim.base.units import NUMBER, conversion
from cosim.experiment.rigs import Ranges
from cosim.logs.log import Log
from cosim.model.model import Model
from cosim.storage.yaml_file import did_you_mean
from cosim.subject.interface import Subject

LIMIT = re.compile(rf"(?P<name>[^=]+)=\s*(?P<number>{NUMBER})\s*(?P<unit>.*)")
RANGE = re.compile(rf"(?P<name>[^=]+)=\s*(?P<low>{NUMBER})\s*\.\.\s*(?P<high>{NUMBER})\s*(?P<unit>.*)")


def inputs_to_limit(model: Model | Subject) -> tuple[str, ...]:
    """Return inputs without a declared limit."""
    return tuple(q.name for q in model.inputs if q.name not in model.excursion and not _whole(q.bounds))


def seen_in(logs: Sequence[Log]) -> dict[str, tuple[float, float]]:
    """Return input → least and largest command in some logs."""
    names = logs[0].inputs if logs else ()
    return {
        n: (min(float(log.inputs[n].min()) for log in logs), max(float(log.inputs[n].max()) for log in logs))
        for n in names
    }


def allowed(
    model: Model, limits: Sequence[str], ranges: Sequence[str], seen: Ranges, faults: list[str]
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Return the allowed excursions of signals and the ranges of inputs; extend `faults`.

    A range is the declared one, narrowed by NAME=MIN..MAX. For an input without range and limit, the logs' range
    counts.
    """
    spans = {q.name: q.bounds for q in model.inputs}
    faults += _narrowed(model, ranges, spans)
    found, starts = _limits(model, limits, faults), dict(zip(spans, model.start_command(), strict=True))
    for q in model.inputs:
        if q.name in found:
            continue
        low, high = _filled(spans[q.name], seen.get(q.name))
        reach = max(high - starts[q.name], starts[q.name] - low)
        if math.isfinite(reach) and reach > 0.0:
            spans[q.name], found[q.name] = (low, high), reach
        else:
            how = f"Say --limit {q.name}=VALUE or --range {q.name}=MIN..MAX [{q.unit}]"
            faults.append(f"how far from {q.start:g} may {q.name} go? {how}")
    return found, {name: span for name, span in spans.items() if any(map(math.isfinite, span))}


def _limits(model: Model, given: Sequence[str], faults: list[str]) -> dict[str, float]:
    """Return excursion limits: the model's, overridden by NAME=VALUE with unit."""
    units = {q.name: q.unit for q in (*model.outputs, *model.inputs)}
    limits = dict(model.excursion)
    for item in given:
        read = LIMIT.fullmatch(item.strip())
        name = read["name"].strip() if read else item.partition("=")[0].strip()
        if name not in units:
            faults.append(f'--limit {item}: no input or output "{name}"{did_you_mean(name, units)}')
        elif (
            read is None
            or (by := conversion(read["unit"].strip(), units[name], difference=True)) is None
            or not (size := by(float(read["number"]))) > 0
        ):
            faults.append(f"--limit {item}: say how far {name} may go, above 0 [{units[name]}], such as {name}=0.1")
        else:
            limits[name] = size
    return limits


def _narrowed(model: Model, given: Sequence[str], spans: dict[str, tuple[float, float]]) -> Iterator[str]:
    """Narrow declared ranges by NAME=MIN..MAX with unit, and yield faults."""
    units = {q.name: q.unit for q in model.inputs}
    for item in given:
        read = RANGE.fullmatch(item.strip())
        name = read["name"].strip() if read else item.partition("=")[0].strip()
        if name not in units:
            yield f'--range {item}: no input "{name}"{did_you_mean(name, units)} (inputs: {", ".join(units)})'
            continue
        by = conversion(read["unit"].strip(), units[name]) if read else None
        asked = (by(float(read["low"])), by(float(read["high"]))) if read and by else (1.0, 0.0)
        if not asked[0] < asked[1]:
            yield f"--range {item}: say between what {name} stays, lower end first [{units[name]}], as {name}=0..10"
            continue
        low, high = max(asked[0], spans[name][0]), min(asked[1], spans[name][1])
        if not low < high:
            yield f"--range {item}: the model declares {spans[name][0]:g}..{spans[name][1]:g} {units[name]} of {name}"
        else:
            spans[name] = low, high


def _filled(span: tuple[float, float], seen: tuple[float, float] | None) -> tuple[float, float]:
    """Return a range with open ends filled from the logs."""
    low, high = seen or (-math.inf, math.inf)
    return (span[0] if math.isfinite(span[0]) else low), (span[1] if math.isfinite(span[1]) else high)


def _whole(span: tuple[float, float]) -> bool:
    return all(map(math.isfinite, span))
