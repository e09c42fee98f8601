"""Gate: checks of a log before use, of clock, channels, units, frame and excitation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from cosim.base.arrays import Array
from cosim.base.errors import Fault, InputError
from cosim.base.messages import Note
from cosim.base.text import amount, counted, percent, plain
from cosim.logs.channel_noise import noise_level
from cosim.logs.finding import Finding
from cosim.logs.frames import frame_findings
from cosim.logs.log import MISSING, Log, name_list
from cosim.logs.spikes import Spikes, find_spikes, out_of_line
from cosim.model.traits import Traits

ORDER = ("fault", "warning", "note")
ALIKE = 0.98  # correlation of two inseparable inputs
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
    clock = [*_timing(log), *_rate(log, rate, strict)]
    channels = [*_inputs(log), *_outputs(log), *outliers(log, find_spikes(log) if spikes is None else spikes)]
    findings = [*clock, *channels, *frame_findings(log, traits)]
    if any(f.severity == "fault" for f in clock):  # a wrong clock unit causes the scale error
        findings = [f for f in findings if f.kind != "scale"]
    return sorted((*findings, *_warn_undeclared(log), *_unread(log)), key=lambda f: ORDER.index(f.severity))


def refuse_faults(log: Log, findings: Sequence[Finding]) -> None:
    """Raise InputError if a finding makes the log unusable."""
    if faults := gate_faults(log, findings):
        raise InputError(faults)


def gate_faults(log: Log, findings: Sequence[Finding]) -> list[Fault]:
    """Return the fatal findings as faults of the file."""
    faults = []
    for f in findings:
        if f.severity == "fault":
            message = f"{f.channel}: {f.sentence}" if f.channel else f.sentence
            faults.append(Fault(log.path, log.header, log.cells.get(f.channel, 1), message))
    return faults


def _warn_undeclared(log: Log) -> Iterator[Finding]:
    """Yield a warning for each column without unit."""
    for name, text in log.undeclared.items():
        yield Finding("warning", "undeclared", name, text)


def _unread(log: Log) -> Iterator[Finding]:
    """Yield a note on columns unknown to the model, and a warning for each name similar to a signal."""
    for name, hint in log.unread.items():
        if hint:
            yield Finding("warning", "unread", name, f"is not read: the model has none of this name{hint}")
    if others := [name or "one without a name" for name, hint in log.unread.items() if not hint]:
        message = f"{counted(len(others), 'column')} not read, for the model has none of this name: {name_list(others)}"
        yield Finding("note", "unread", "", message, {"columns": len(others)})


# -- clock --------------------------------------------------------------------------------------


def _timing(log: Log) -> Iterator[Finding]:
    dt = np.diff(log.time)
    ratio = dt / log.step
    regular = ratio[ratio <= MISSING]
    spread, worst = float(np.std(regular)), float(np.max(np.abs(regular - 1.0), initial=0.0))
    if worst > 0.01:
        message = (
            f"rows are {amount(log.step, 's')} apart, give or take {percent(spread)} (at most {percent(worst)}); "
            "replays step at their times, the filter of `cosim refine` at equal ones"
        )
        numbers = {"step": log.step, "spread": spread, "worst": worst}
        yield Finding("warning" if spread > 0.1 else "note", "jitter", "time", message, numbers)
    holes = np.flatnonzero(ratio > MISSING)
    missing = np.maximum(1.0, np.rint(ratio[holes]) - 1.0)
    gaps = dt[holes] > log.pause
    for kind, chosen in (("dropouts", ~gaps), ("gaps", gaps)):
        places = holes[chosen]
        if places.size:
            rows, first, longest = int(missing[chosen].sum()), float(log.time[places[0]]), float(dt[places].max())
            message = (
                f"{counted(rows, 'row')} missing in {counted(places.size, 'place')}, first after t = {first:.6g} "
                f"s, the longest {amount(longest, 's')}; commands are held over them, so what was commanded in "
                "between is not replayed"
            )
            numbers = {"rows": rows, "places": places.size, "first": first, "longest": longest}
            yield Finding("warning", kind, "time", message, numbers)
    duration = float(log.time[-1] - log.time[0])
    if duration < SHORT * log.slowness:
        message = f"the log lasts {amount(duration, 's')}; {plain(2.0 * SHORT * log.slowness)} s and more tell more"
        yield Finding("warning", "short", "time", message, {"duration": duration})
    if abs(start := float(log.time[0])) > 1e6:
        yield Finding(
            "note",
            "epoch",
            "time",
            Note(f"time starts at {start:.0f} s; a model whose effects depend on time takes it as it is"),
            {"start": start},
        )


def _probable_unit(log: Log, ratio: float) -> str | None:
    """Return the probable unit of the time, None if stated or seconds.

    A log in minutes appears to last only seconds; otherwise rows really are minutes apart.
    """
    if log.written.get("time"):
        return None
    duration = float(log.time[-1] - log.time[0])
    units = (("ms", 1e3), ("us", 1e6), *((("min", 1.0 / 60.0),) if duration < SHORT else ()))
    return next((unit for unit, factor in units if 0.5 < ratio / factor < 2.0), None)


def _rate(log: Log, rate: float | None, strict: bool) -> Iterator[Finding]:
    if rate is None:
        return
    ratio, numbers = log.step / rate, {"step": log.step, "rate": rate}
    place = {"step": plain(log.step), "rate": plain(rate)}
    if unit := _probable_unit(log, ratio):
        yield Finding(
            "fault",
            "rate",
            "time",
            (
                'rows are {step} s apart, the model is made for {rate} s; is the time in {unit}? Then call it "time '
                '[{unit}]", or "time [s]" if it is not'
            ).format(unit=unit, **place),
            numbers,
        )
    elif strict and ratio > SLOWER:
        yield Finding(
            "fault",
            "rate",
            "time",
            (
                "rows are {step} s apart, the model is made for {rate} s; commands in between are lost; log every "
                "command"
            ).format(**place),
            numbers,
        )
    elif ratio > SLOWER:
        yield Finding(
            "warning",
            "rate",
            "time",
            (
                "rows are {step} s apart, the model is made for {rate} s; what was commanded between two rows is "
                "not in the log, and no command but that of a row acts"
            ).format(**place),
            numbers,
        )
    elif ratio < 1.0 / FASTER:
        yield Finding(
            "warning",
            "rate",
            "time",
            (
                "rows are {step} s apart, the model is made for {rate} s: each row is a step, and takes its time; "
                "fewer would do"
            ).format(**place),
            numbers,
        )
    elif abs(1.0 / ratio - round(1.0 / ratio)) > 0.02:
        yield Finding(
            "note",
            "rate",
            "time",
            Note(
                "rows are {step} s apart, the model is made for {rate} s, no whole number of rows a step".format(
                    **place
                )
            ),
            numbers,
        )
    elif abs(ratio - 1.0) > 0.02:
        message = "rows are {step} s apart, the model is made for {rate} s: {count} a step".format(
            count=counted(round(1.0 / ratio), "row"), **place
        )
        yield Finding("note", "rate", "time", message, numbers)


# -- inputs -------------------------------------------------------------------------------------


def _inputs(log: Log) -> Iterator[Finding]:
    moving = {}
    for name, values in log.inputs.items():
        if np.count_nonzero(np.diff(values)) < 3 or np.ptp(values) <= 1e-9 * np.abs(values).max():
            message = (
                f"is constant at {amount(float(np.median(values)), log.units[name])}: it excites nothing, and "
                "effects that act only through it cannot be identified"
            )
            yield Finding("note", "constant", name, message, {"rms": float(values.std())})
        else:
            moving[name] = values
            yield _excitation(log, name, values)
    if log.inputs and not moving:
        yield Finding("warning", "no_excitation", "", "no input moves: such a log says next to nothing about a model")
    for one, other in combinations(moving, 2):
        rho = float(np.corrcoef(moving[one], moving[other])[0, 1])
        if abs(rho) > ALIKE:
            direction, correlation = "with" if rho > 0 else "against", plain(rho, 3)
            message = (
                f"moves {direction} {other} (correlation {correlation}): what one does cannot be separated from "
                "what the other does"
            )
            yield Finding("note", "alike", one, message, {"correlation": rho})


def _excitation(log: Log, name: str, values: Array) -> Finding:
    """Return a finding on the excitation by an input: RMS, 95 % power bandwidth and saturation."""
    power = np.abs(np.fft.rfft(values - values.mean())) ** 2
    power[0] = 0.0
    below = int(np.searchsorted(np.cumsum(power), 0.95 * power.sum()))
    bandwidth, rms = below / (values.size * log.step), float(values.std())
    low, high, slack = float(values.min()), float(values.max()), 1e-6 * float(np.ptp(values))
    ends = [int(np.count_nonzero(np.abs(values - end) <= slack)) for end in (low, high)]
    share = sum(ends) / values.size if max(ends) > 2 else 0.0
    sizes = {key: amount(value, log.units[name]) for key, value in (("rms", rms), ("low", low), ("high", high))}
    at_ends = f", there {percent(share)} of the rows" if share else ""
    message = "moves {rms} (rms) with 95 % of its power below {bandwidth}, between {low} and {high}{share}".format(
        bandwidth=amount(bandwidth, "Hz", 2), share=at_ends, **sizes
    )
    numbers = {"rms": rms, "bandwidth": bandwidth, "saturated": share, "low": low, "high": high}
    return Finding("note", "excitation", name, message, numbers)


# -- outputs ------------------------------------------------------------------------------------


def _outputs(log: Log) -> Iterator[Finding]:
    for name, values in log.outputs.items():
        good = np.isfinite(values)
        readings = values[good]
        share = float(good.mean())
        if share < 1.0:
            interval = float(np.median(np.diff(log.time[good]))) if readings.size > 1 else math.nan
            message = f"measured in {percent(share)} of the rows, every {amount(interval, 's')}"
            yield Finding("note", "missing", name, message, {"share": share, "every": interval})
        if np.ptp(readings) <= 1e-12 * max(1.0, float(np.abs(readings).max())):
            message = (
                f"is constant at {amount(float(readings[0]), log.units[name])} throughout; check that the sensor "
                "is connected"
            )
            yield Finding("warning", "constant", name, message, {"value": float(readings[0])})
        else:
            yield from _repeats(log, name, log.time[good], readings)


def _repeats(log: Log, name: str, time: Array, values: Array) -> Iterator[Finding]:
    """Yield a warning if a sensor repeats values, because it is slow or frozen.

    The residual of this sensor would look like a delay or an effect.
    """
    starts = np.concatenate(([0], 1 + np.flatnonzero(np.diff(values)), [values.size]))
    runs = np.diff(starts)
    usual = float(np.median(runs))
    noise, span = noise_level(values), float(np.ptp(values))
    if usual >= 2.0 and np.mean(np.abs(runs - usual) <= 1.0) > 0.8:
        yield Finding(
            "warning",
            "held",
            name,
            (
                f"changes only every {usual:.0f} rows: a slower sensor, held. Leave the cells in between empty, or "
                "the hold passes for a delay"
            ),
            {"rows": usual},
        )
    elif usual == 1.0 and runs.max() * log.step > 0.2 and runs.max() >= 10 and noise > 1e-5 * span:
        k = int(np.argmax(runs))
        value, first = amount(float(values[starts[k]]), log.units[name]), float(time[starts[k]])
        message = (
            f"is exactly {value} in {runs[k]} rows from t = {first:.6g} s, although its noise is larger "
            "elsewhere: the sensor was frozen, at the end of its range, or at rest where it makes no noise"
        )
        yield Finding("warning", "frozen", name, message, {"rows": float(runs[k]), "first": first})


def outliers(log: Log, spikes: Spikes) -> Iterator[Finding]:
    """Yield a warning for each channel with outliers."""
    for name, rows in spikes.items():
        first, worst = float(log.time[rows[0]]), float(out_of_line(log, log.outputs[name])[rows].max())
        count, deviation = counted(rows.size, "reading"), amount(worst, log.units[name])
        message = (
            f"has {count} that its neighbours and the model do not explain, first at t = {first:.6g} s, the "
            f"farthest off by {deviation}; `cosim refine` leaves such readings out, other commands take them as "
            "they are: leave the cells empty"
        )
        yield Finding("warning", "outliers", name, message, {"count": float(rows.size), "first": first, "worst": worst})
