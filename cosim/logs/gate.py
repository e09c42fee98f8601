"""Gate: checks of a log before use, of clock, channels, units, frame and excitation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from cosim.core.errors import Fault, InputError
from cosim.core.text import amount, counted, percent, plain
from cosim.logs.channel_noise import noise_level
from cosim.logs.finding import Finding, Severity
from cosim.logs.frames import frame_findings
from cosim.logs.log import MISSING, Log, name_list
from cosim.logs.spikes import Spikes, find_spikes, out_of_line
from cosim.model.traits import Traits

ORDER = ("fault", "warning", "note")
ALIKE = 0.98  # correlation of two inseparable inputs
SLOWER, FASTER = 1.5, 50.0  # ratio of the log's step to the model's from which the steps disagree
SHORT = 10.0  # [s]; the first 2 s and whole windows of 2 s must leave enough rows


def gate(
    log: Log, rate: float | None = None, traits: Traits | None = None, spikes: Spikes | None = None
) -> list[Finding]:
    """Return all findings on a log, faults first.

    Args:
        rate: Step of the model [s], None if not declared.
        traits: Signal properties of the model, None without a model.
        spikes: Outliers confirmed by a model; default: search without a model.
    """
    clock = [*_timing(log), *([] if rate is None else _rate(log, rate))]
    channels = [*_inputs(log), *_outputs(log), *outliers(log, find_spikes(log) if spikes is None else spikes)]
    findings = [*clock, *channels, *frame_findings(log, traits)]
    if any(f.severity == "fault" for f in clock):  # a wrong clock unit causes the scale error
        findings = [f for f in findings if f.kind != "scale"]
    findings += [Finding("warning", "undeclared", name, text) for name, text in log.undeclared.items()]
    for name, hint in log.unread.items():
        if hint:
            message = f"is not read: the model has none of this name{hint}"
            findings.append(Finding("warning", "unread", name, message))
    if others := [name or "one without a name" for name, hint in log.unread.items() if not hint]:
        message = f"{counted(len(others), 'column')} not read, for the model has none of this name: {name_list(others)}"
        findings.append(Finding("note", "unread", "", message, {"columns": len(others)}))
    return sorted(findings, key=lambda f: ORDER.index(f.severity))


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
        message = f"time starts at {start:.0f} s; a model whose effects depend on time takes it as it is"
        yield Finding("note", "epoch", "time", message, {"start": start})


def _rate(log: Log, rate: float) -> Iterator[Finding]:
    """Yield a finding on rows that are not as far apart as the steps of the model."""
    ratio, duration = log.step / rate, float(log.time[-1] - log.time[0])
    # Not stated, the unit may be another one. A log in minutes appears to last only seconds; otherwise rows really are
    # minutes apart.
    units = (("ms", 1e3), ("us", 1e6), *((("min", 1.0 / 60.0),) if duration < SHORT else ()))
    unit = next((unit for unit, factor in units if 0.5 < ratio / factor < 2.0 and not log.written.get("time")), None)
    severity: Severity = "note"
    if unit:
        severity = "fault"
        told = f'; is the time in {unit}? Then call it "time [{unit}]", or "time [s]" if it is not'
    elif ratio > SLOWER:
        severity = "warning"
        told = "; what was commanded between two rows is not in the log, and no command but that of a row acts"
    elif ratio < 1.0 / FASTER:
        severity, told = "warning", ": each row is a step, and takes its time; fewer would do"
    elif abs(1.0 / ratio - round(1.0 / ratio)) > 0.02:
        told = ", no whole number of rows a step"
    elif abs(ratio - 1.0) > 0.02:
        told = f": {counted(round(1.0 / ratio), 'row')} a step"
    else:
        return
    message = f"rows are {plain(log.step)}\u00a0s apart, the model is made for {plain(rate)}\u00a0s{told}"
    yield Finding(severity, "rate", "time", message, {"step": log.step, "rate": rate})


# -- inputs -------------------------------------------------------------------------------------


def _inputs(log: Log) -> Iterator[Finding]:
    """Yield findings on the excitation by each input: RMS, 95 % power bandwidth and saturation; and on alike inputs."""
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
            power = np.abs(np.fft.rfft(values - values.mean())) ** 2
            power[0] = 0.0
            below = int(np.searchsorted(np.cumsum(power), 0.95 * power.sum()))
            bandwidth, rms = below / (values.size * log.step), float(values.std())
            low, high, slack = float(values.min()), float(values.max()), 1e-6 * float(np.ptp(values))
            ends = [int(np.count_nonzero(np.abs(values - end) <= slack)) for end in (low, high)]
            share = sum(ends) / values.size if max(ends) > 2 else 0.0
            typical, least, most = (amount(size, log.units[name]) for size in (rms, low, high))
            at_ends = f", there {percent(share)} of the rows" if share else ""
            message = (
                f"moves {typical} (rms) with 95 % of its power below {amount(bandwidth, 'Hz', 2)}, between {least} "
                f"and {most}{at_ends}"
            )
            numbers = {"rms": rms, "bandwidth": bandwidth, "saturated": share, "low": low, "high": high}
            yield Finding("note", "excitation", name, message, numbers)
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
            # A sensor that repeats values is slow or frozen; its residual would look like a delay or an effect.
            starts = np.concatenate(([0], 1 + np.flatnonzero(np.diff(readings)), [readings.size]))
            runs = np.diff(starts)
            usual, most = float(np.median(runs)), int(runs.max())
            noise, span = noise_level(readings), float(np.ptp(readings))
            if usual >= 2.0 and np.mean(np.abs(runs - usual) <= 1.0) > 0.8:
                message = (
                    f"changes only every {usual:.0f} rows: a slower sensor, held. Leave the cells in between empty, or "
                    "the hold passes for a delay"
                )
                yield Finding("warning", "held", name, message, {"rows": usual})
            elif usual == 1.0 and most * log.step > 0.2 and most >= 10 and noise > 1e-5 * span:
                k = starts[int(np.argmax(runs))]
                value, first = amount(float(readings[k]), log.units[name]), float(log.time[good][k])
                message = (
                    f"is exactly {value} in {most} rows from t = {first:.6g} s, although its noise is larger "
                    "elsewhere: the sensor was frozen, at the end of its range, or at rest where it makes no noise"
                )
                yield Finding("warning", "frozen", name, message, {"rows": float(most), "first": first})


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
