"""Checks of a log before use: clock, channels, units, frame and excitation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.text import amount, counted, percent, plain
from cosim.logs.channel_noise import noise_level
from cosim.logs.finding import Finding, Severity
from cosim.logs.frames import frames
from cosim.logs.log import MISSING, Log, named
from cosim.logs.spikes import Spikes, find_spikes, out_of_line
from cosim.logs.static_table import alike, table_findings
from cosim.model.traits import Traits

ORDER = ("fault", "warning", "note")
SLOWER, FASTER = 1.5, 50.0  # ratio of the log's step to the model's from which the steps disagree
SHORT = 10.0  # [s]; the first 2 s and whole windows of 2 s must leave enough rows


def gate(
    log: Log,
    rate: float | None = None,
    strict: bool = False,
    traits: Traits | None = None,
    spikes: Spikes | None = None,
) -> list[Finding]:
    """Return all findings on a log, faults first.

    Args:
        rate: Step of the model [s], None if not declared.
        strict: Report a log slower than `rate` as a fault instead of a warning.
        traits: Signal properties of the model, None without a model.
        spikes: Outliers confirmed by a model; default: search without a model.
    """
    if log.table:
        findings = list(table_findings(log, traits))
    else:
        clock = [*_timing(log), *_rate(log, rate, strict)]
        wild = outliers(log, find_spikes(log) if spikes is None else spikes)
        findings = [*clock, *_inputs(log), *_outputs(log), *wild, *frames(log, traits)]
        if any(f.severity == "fault" for f in clock):  # a wrong clock unit causes the scale error
            findings = [f for f in findings if f.kind != "scale"]
    return sorted((*findings, *_undeclared(log), *_unread(log)), key=lambda f: ORDER.index(f.severity))


def refuse_faults(log: Log, findings: Sequence[Finding]) -> None:
    """Raise InputError if a finding makes the log unusable."""
    if faults := gate_faults(log, findings):
        raise InputError(faults)


def gate_faults(log: Log, findings: Sequence[Finding]) -> list[Fault]:
    """Return the fatal findings as faults of the file."""
    faults = []
    for f in findings:
        if f.severity == "fault":
            text = f"{f.channel}: {f.sentence}" if f.channel else f.sentence
            faults.append(Fault(log.path, log.header, log.cells.get(f.channel, 1), text))
    return faults


def _undeclared(log: Log) -> Iterator[Finding]:
    """Warn of columns with a unit for signals without a unit."""
    for name, said in log.undeclared.items():
        yield Finding("warning", "undeclared", name, said)


def _unread(log: Log) -> Iterator[Finding]:
    """Note unread columns; warn of each with a similar name in the model."""
    for name, hint in ((n, h) for n, h in log.unread.items() if h):
        yield Finding("warning", "unread", name, f"is not read: the model has none of this name{hint}")
    others = [name or "one without a name" for name, hint in log.unread.items() if not hint]
    if others:
        text = f"{counted(len(others), 'column')} not read, for the model has none of this name: {named(others)}"
        yield Finding("note", "unread", "", text, {"columns": len(others)})


# -- clock --------------------------------------------------------------------------------------


def _timing(log: Log) -> Iterator[Finding]:
    dt = np.diff(log.time)
    ratio = dt / log.step
    regular = ratio[ratio <= MISSING]
    spread, worst = float(np.std(regular)), float(np.max(np.abs(regular - 1.0), initial=0.0))
    if worst > 0.01:
        severity: Severity = "warning" if spread > 0.1 else "note"
        text = (
            f"rows are {amount(log.step, 's')} apart, give or take {percent(spread)} (at most {percent(worst)}); "
            "replays step at their times, the filter of `cosim refine` at equal ones"
        )
        yield Finding(severity, "jitter", "time", text, {"step": log.step, "spread": spread, "worst": worst})
    holes = np.flatnonzero(ratio > MISSING)
    missing = np.maximum(1.0, np.rint(ratio[holes]) - 1.0)
    gaps = dt[holes] > log.pause
    for kind, chosen in (("dropouts", ~gaps), ("gaps", gaps)):
        places = holes[chosen]
        if places.size:
            rows, first, longest = int(missing[chosen].sum()), float(log.time[places[0]]), float(dt[places].max())
            text = (
                f"{counted(rows, 'row')} missing in {counted(places.size, 'place')}, first after t = {first:.6g} s, "
                f"the longest {amount(longest, 's')}; commands are held over them, so what was commanded in between is "
                "not replayed"
            )
            numbers = {"rows": rows, "places": places.size, "first": first, "longest": longest}
            yield Finding("warning", kind, "time", text, numbers)
    duration = float(log.time[-1] - log.time[0])
    if duration < SHORT * log.slowness:
        text = f"the log lasts {amount(duration, 's')}; {plain(2.0 * SHORT * log.slowness)} s and more tell more"
        yield Finding("warning", "short", "time", text, {"duration": duration})
    if abs(start := float(log.time[0])) > 1e6:
        text = f"time starts at {start:.0f} s; a model whose effects depend on time takes it as it is"
        yield Finding("note", "epoch", "time", text, {"start": start})


def _unit_meant(log: Log, ratio: float) -> str | None:
    """Return the probable unit of the time, None if stated or seconds.

    A log in minutes seems to last only seconds; otherwise rows really are minutes apart.
    """
    if log.written.get("time"):
        return None
    lasts = float(log.time[-1] - log.time[0])
    units = (("ms", 1e3), ("us", 1e6), *((("min", 1.0 / 60.0),) if lasts < SHORT else ()))
    return next((unit for unit, factor in units if 0.5 < ratio / factor < 2.0), None)


def _rate(log: Log, rate: float | None, strict: bool) -> Iterator[Finding]:
    if rate is None:
        return
    ratio, numbers = log.step / rate, {"step": log.step, "rate": rate}
    place = f"rows are {plain(log.step)}\u00a0s apart, the model is made for {plain(rate)}\u00a0s"
    if unit := _unit_meant(log, ratio):
        cure = f'"time [{unit}]", or "time [s]" if it is not'
        yield Finding("fault", "rate", "time", f"{place}; is the time in {unit}? Then call it {cure}", numbers)
    elif strict and ratio > SLOWER:
        yield Finding("fault", "rate", "time", f"{place}; commands in between are lost; log every command", numbers)
    elif ratio > SLOWER:
        lost = "what was commanded between two rows is not in the log, and no command but that of a row acts"
        yield Finding("warning", "rate", "time", f"{place}; {lost}", numbers)
    elif ratio < 1.0 / FASTER:
        fewer = "each row is a step, and takes its time; fewer would do"
        yield Finding("warning", "rate", "time", f"{place}: {fewer}", numbers)
    elif abs(1.0 / ratio - round(1.0 / ratio)) > 0.02:
        yield Finding("note", "rate", "time", f"{place}, no whole number of rows a step", numbers)
    elif abs(ratio - 1.0) > 0.02:
        yield Finding("note", "rate", "time", f"{place}: {counted(round(1.0 / ratio), 'row')} a step", numbers)


# -- inputs -------------------------------------------------------------------------------------


def _inputs(log: Log) -> Iterator[Finding]:
    moving = {}
    for name, values in log.inputs.items():
        if np.count_nonzero(np.diff(values)) < 3 or np.ptp(values) <= 1e-9 * np.abs(values).max():
            where = amount(float(np.median(values)), log.units[name])
            text = f"stands at {where}: it excites nothing, and what acts through it alone cannot be identified"
            yield Finding("note", "constant", name, text, {"rms": float(values.std())})
        else:
            moving[name] = values
            yield _excitation(log, name, values)
    if log.inputs and not moving:
        yield Finding("warning", "no_excitation", "", "no input moves: such a log says next to nothing about a model")
    yield from alike(moving, "moves")


def _excitation(log: Log, name: str, values: Array) -> Finding:
    """Return RMS, 95 % power bandwidth and saturation of an input as a finding."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    power[0] = 0.0
    below = int(np.searchsorted(np.cumsum(power), 0.95 * power.sum()))
    bandwidth, rms = below / (values.size * log.step), float(values.std())
    low, high, slack = float(values.min()), float(values.max()), 1e-6 * float(np.ptp(values))
    ends = [int(np.count_nonzero(np.abs(values - end) <= slack)) for end in (low, high)]
    share = sum(ends) / values.size if max(ends) > 2 else 0.0
    unit, there = log.units[name], f", there {percent(share)} of the rows" if share else ""
    text = (
        f"moves {amount(rms, unit)} (rms) with 95 % of its power below {amount(bandwidth, 'Hz', 2)}, "
        f"between {amount(low, unit)} and {amount(high, unit)}{there}"
    )
    numbers = {"rms": rms, "bandwidth": bandwidth, "saturated": share, "low": low, "high": high}
    return Finding("note", "excitation", name, text, numbers)


# -- outputs ------------------------------------------------------------------------------------


def _outputs(log: Log) -> Iterator[Finding]:
    for name, values in log.outputs.items():
        good = np.isfinite(values)
        seen = values[good]
        share = float(good.mean())
        if share < 1.0:
            every = float(np.median(np.diff(log.time[good]))) if seen.size > 1 else math.nan
            text = f"measured in {percent(share)} of the rows, every {amount(every, 's')}"
            yield Finding("note", "missing", name, text, {"share": share, "every": every})
        if np.ptp(seen) <= 1e-12 * max(1.0, float(np.abs(seen).max())):
            text = f"stands at {amount(float(seen[0]), log.units[name])} throughout: is the sensor connected?"
            yield Finding("warning", "constant", name, text, {"value": float(seen[0])})
        else:
            yield from _repeats(log, name, log.time[good], seen)


def _repeats(log: Log, name: str, time: Array, values: Array) -> Iterator[Finding]:
    """Warn of a held slow sensor or a frozen one, which look like a delay or an effect."""
    starts = np.concatenate(([0], 1 + np.flatnonzero(np.diff(values)), [values.size]))
    runs = np.diff(starts)
    usual = float(np.median(runs))
    noise, span = noise_level(values), float(np.ptp(values))
    if usual >= 2.0 and np.mean(np.abs(runs - usual) <= 1.0) > 0.8:
        cure = "Leave the cells in between empty, or the hold passes for a delay"
        text = f"changes only every {usual:.0f} rows: a slower sensor, held. {cure}"
        yield Finding("warning", "held", name, text, {"rows": usual})
    elif usual == 1.0 and runs.max() * log.step > 0.2 and runs.max() >= 10 and noise > 1e-5 * span:
        k = int(np.argmax(runs))
        value, first = amount(float(values[starts[k]]), log.units[name]), float(time[starts[k]])
        place = f"repeats {value} for {runs[k]} rows from t = {first:.6g} s"
        text = f"{place}, at its noise that is no measurement: frozen, or at the end of its range"
        yield Finding("warning", "frozen", name, text, {"rows": float(runs[k]), "first": first})


def outliers(log: Log, spikes: Spikes) -> Iterator[Finding]:
    """Warn of each channel with outliers."""
    for name, rows in spikes.items():
        off = out_of_line(log, log.outputs[name])[rows]
        first, worst = float(log.time[rows[0]]), float(off.max())
        text = (
            f"has {counted(rows.size, 'reading')} that its neighbours and the model do not explain, first at "
            f"t = {first:.6g} s, the farthest off by {amount(worst, log.units[name])}; `cosim refine` leaves such "
            "readings out, other commands take them as they are: leave the cells empty"
        )
        yield Finding("warning", "outliers", name, text, {"count": float(rows.size), "first": first, "worst": worst})
