"""Limits of an experiment: excursions from the start, and ranges of commands."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from contextlib import suppress

from cosim.core.text import did_you_mean
from cosim.core.units import NUMBER, conversion, read_quantity
from cosim.estimation.subject.interface import Subject
from cosim.experiment.rigs import Ranges
from cosim.model.model import Model

RANGE = re.compile(rf"(?P<name>[^=]+)=\s*(?P<low>{NUMBER})\s*\.\.\s*(?P<high>{NUMBER})\s*(?P<unit>.*)")


def inputs_to_limit(model: Model | Subject) -> tuple[str, ...]:
    """Return inputs without a declared limit."""
    return tuple(
        q.name for q in model.inputs if q.name not in model.excursion and not all(map(math.isfinite, q.bounds))
    )


def limits_and_ranges(
    model: Model, limits: Sequence[str], ranges: Sequence[str], logged: Ranges, faults: list[str]
) -> tuple[dict[str, float], dict[str, tuple[float, float]]]:
    """Return the largest allowed excursion of each limited signal, and the range of each input; extend `faults`.

    A range is the declared range, narrowed by NAME=MIN..MAX, or for an input without range and limit the range in logs.
    """
    spans = {q.name: q.bounds for q in model.inputs}
    units = {q.name: q.unit for q in (*model.outputs, *model.inputs)}
    for text in ranges:
        match, name = RANGE.fullmatch(text.strip()), text.partition("=")[0].strip()
        if name not in spans:
            faults.append(f'--range {text}: no input "{name}"{did_you_mean(name, spans)} (inputs: {", ".join(spans)})')
            continue
        unit, (low, high) = units[name], spans[name]
        convert = conversion(match["unit"].strip(), unit) if match else None
        lower, upper = (convert(float(match[end])) if match and convert else math.nan for end in ("low", "high"))
        if not lower < upper:
            message = f"say between what {name} stays, lower end first [{unit}], as {name}=0..10"
            faults.append(f"--range {text}: {message}")
        elif not max(lower, low) < min(upper, high):
            message = f"the model declares {low:g}..{high:g} {unit} of {name}; choose a range that overlaps"
            faults.append(f"--range {text}: {message}")
        else:
            spans[name] = max(lower, low), min(upper, high)
    reaches, starts = dict(model.excursion), dict(zip(spans, model.start_command(), strict=True))
    for text in limits:
        name, _, value = (part.strip() for part in text.partition("="))
        if name not in units:
            faults.append(f'--limit {text}: no input or output "{name}"{did_you_mean(name, units)}')
            continue
        size = math.nan
        with suppress(ValueError):
            size = read_quantity(value, units[name], difference=True)
        if size > 0:
            reaches[name] = size
        else:
            faults.append(f"--limit {text}: say how far {name} may go, above 0 [{units[name]}], such as {name}=0.1")
    for q in model.inputs:
        if q.name in reaches:
            continue
        pairs = zip(spans[q.name], logged.get(q.name, spans[q.name]), strict=True)
        low, high = (end if math.isfinite(end) else logged_end for end, logged_end in pairs)
        reach = max(high - starts[q.name], starts[q.name] - low)
        if math.isfinite(reach) and reach > 0.0:
            spans[q.name], reaches[q.name] = (low, high), reach
        else:
            faults.append(
                f"how far from {q.start:g} may {q.name} go? Say --limit {q.name}=VALUE or --range "
                f"{q.name}=MIN..MAX [{q.unit}]"
            )
    return reaches, {name: span for name, span in spans.items() if any(map(math.isfinite, span))}
