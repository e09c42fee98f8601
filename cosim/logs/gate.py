"""Checks of a log before it is used: clock, channels, units, axes and excitation."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import combinations

import numpy as np

from cosim.core.arrays import NamedValues
from cosim.core.errors import Fault, InputError
from cosim.core.text import amount, counted, percent, plain
from cosim.core.units import DEGREES
from cosim.logs.log import FULL_TURN, MISSING_ROW_STEPS, Finding, Log, Severity, name_list, noise_level
from cosim.logs.model_comparison import fast_part, fit_slope, input_unit_findings
from cosim.logs.spikes import Spikes, find_spikes, out_of_line
from cosim.model.traits import Traits, rate_of

SEVERITIES = ("fault", "warning", "note")
MAX_INTEGRATED_PAUSE_S = 0.2  # [s] without a reading
INSEPARABLE_CORRELATION = 0.98  # correlation of two inseparable inputs
SLOWER = 1.5  # ratio of the log's step to the model's from which the steps disagree
SHORT_LOG_S = 10.0  # [s]; the first 2 s and whole windows of 2 s must leave enough rows
MIN_AGREEMENT = 0.9  # correlation of the change of a signal with the integral of its rate
FAR_OFF = 8.0  # multiple of the noise


def gate(
    log: Log,
    rate: float | None = None,
    traits: Traits | None = None,
    spikes: Spikes | None = None,
    starts: NamedValues | None = None,
) -> list[Finding]:
    """Return all findings on a log, faults first.

    Args:
        rate: Step of the model [s], None if not declared.
        traits: Signal properties of the model; None without a model.
        spikes: Outliers that were found with a model; by default they are searched without a model.
        starts: Start values of inputs in the model, which indicate their sizes; None to omit this comparison.
    """
    clock = [*_timing(log), *([] if rate is None else _rate(log, rate))]
    channels = [*_inputs(log), *_outputs(log), *outliers(log, find_spikes(log) if spikes is None else spikes)]
    findings = [*clock, *channels, *frame_findings(log, traits)]
    if starts is not None:
        findings += input_unit_findings(log, starts, traits.bounds if traits else {})
    if any(f.severity == "fault" for f in clock):  # a wrong clock unit causes the scale error
        findings = [f for f in findings if f.kind != "scale"]
    findings += [Finding("note", "assumed", "", text) for text in log.assumed]
    findings += [Finding("warning", "undeclared", name, text) for name, text in log.undeclared.items()]
    for name, hint in log.unread.items():
        if hint:
            message = f"is not read: the model has no signal of this name{hint}"
            findings.append(Finding("warning", "unread", name, message))
    if others := [name or "a column without a name" for name, hint in log.unread.items() if not hint]:
        message = (
            f"{counted(len(others), 'column')} not read, because the model has no signal of this name: "
            f"{name_list(others)}"
        )
        findings.append(Finding("note", "unread", "", message))
    return sorted(findings, key=lambda f: SEVERITIES.index(f.severity))


def refuse_faults(log: Log, findings: Sequence[Finding]) -> None:
    """Raise InputError with all findings that make the log unusable, if there are any."""
    if faults := gate_faults(log, findings):
        raise InputError(faults)


def gate_faults(log: Log, findings: Sequence[Finding]) -> list[Fault]:
    """Return the findings that make the log unusable, as faults of the file."""
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
    regular = ratio[ratio <= MISSING_ROW_STEPS]
    spread, worst = float(np.std(regular)), float(np.max(np.abs(regular - 1.0), initial=0.0))
    if worst > 0.01:
        message = (
            f"rows are {amount(log.step, 's')} apart, with a jitter of {percent(spread)} (at most {percent(worst)}); "
            "`cosim replay` steps at these times, `cosim refine` at equal intervals"
        )
        yield Finding("warning" if spread > 0.1 else "note", "jitter", "time", message)
    holes = np.flatnonzero(ratio > MISSING_ROW_STEPS)
    missing = np.maximum(1.0, np.rint(ratio[holes]) - 1.0)
    gaps = dt[holes] > log.pause
    for kind, chosen in (("dropouts", ~gaps), ("gaps", gaps)):
        places = holes[chosen]
        if places.size:
            rows, first, longest = int(missing[chosen].sum()), float(log.time[places[0]]), float(dt[places].max())
            message = (
                f"{counted(rows, 'row')} missing in {counted(places.size, 'place')}, first after t = {first:.6g} s, "
                f"the longest {amount(longest, 's')}; inputs are held constant there, so changes in between are lost"
            )
            numbers = {"rows": rows, "places": places.size, "first": first, "longest": longest}
            yield Finding("warning", kind, "time", message, numbers)
    duration = float(log.time[-1] - log.time[0])
    if duration < SHORT_LOG_S * log.slowness:
        better = plain(2.0 * SHORT_LOG_S * log.slowness)
        message = f"the log lasts {amount(duration, 's')}; {better} s or more give better results"
        yield Finding("warning", "short", "time", message)


def _rate(log: Log, rate: float) -> Iterator[Finding]:
    """Yield a finding if the row spacing differs from the step of the model."""
    ratio, duration = log.step / rate, float(log.time[-1] - log.time[0])
    # Without a stated unit, the time may be in another unit. A log in minutes then appears to last seconds; otherwise
    # its rows really are minutes apart.
    units = (("ms", 1e3), ("us", 1e6), *((("min", 1.0 / 60.0),) if duration < SHORT_LOG_S else ()))
    unit = next((unit for unit, factor in units if 0.5 < ratio / factor < 2.0 and not log.written.get("time")), None)
    severity: Severity = "warning"
    if unit:
        severity = "fault"
        told = f'. If the time is in {unit}, rename its column to "time [{unit}]", otherwise to "time [s]"'
    elif ratio > SLOWER:
        told = "; inputs are held constant between rows"
    else:
        return
    message = f"rows are {plain(log.step)}\u00a0s apart; the step of the model is {plain(rate)}\u00a0s{told}"
    yield Finding(severity, "rate", "time", message)


# -- inputs -------------------------------------------------------------------------------------


def _inputs(log: Log) -> Iterator[Finding]:
    """Yield findings on each input (RMS, 95 % power bandwidth, saturation), and on inseparable inputs."""
    moving = {}
    for name, values in log.inputs.items():
        if np.ptp(values) <= 1e-9 * np.abs(values).max():
            message = (
                f"is constant at {amount(float(np.median(values)), log.units[name])}: it gives no excitation, and "
                "effects that act only through it cannot be identified"
            )
            yield Finding("note", "constant", name, message)
        else:
            moving[name] = values
            power = np.abs(np.fft.rfft(values - values.mean())) ** 2
            power[0] = 0.0
            below = int(np.searchsorted(np.cumsum(power), 0.95 * power.sum()))
            bandwidth = amount(below / (values.size * log.step), "Hz", 2)
            low, high, slack = float(values.min()), float(values.max()), 1e-6 * float(np.ptp(values))
            ends = [int(np.count_nonzero(np.abs(values - end) <= slack)) for end in (low, high)]
            share = sum(ends) / values.size if max(ends) > 2 else 0.0
            unit = log.units[name]
            typical = amount(float(values.std()), unit, difference=True)
            least, most = (amount(size, unit) for size in (low, high))
            at_ends = f" ({percent(share)} of the rows at an end of this range)" if share else ""
            spread = f"standard deviation {typical}, 95 % of the power of its variations below {bandwidth}"
            message = f"range {least} … {most}{at_ends}, {spread}"
            yield Finding("note", "excitation", name, message)
    if log.inputs and not moving:
        yield Finding(
            "warning", "no_excitation", "", "all inputs are constant: the log has almost no information about a model"
        )
    for one, other in combinations(moving, 2):
        rho = float(np.corrcoef(moving[one], moving[other])[0, 1])
        if abs(rho) > INSEPARABLE_CORRELATION:
            direction, correlation = "with" if rho > 0 else "against", plain(rho, 3)
            message = f"moves {direction} {other} (correlation {correlation}): their effects cannot be separated"
            yield Finding("note", "alike", one, message, {"correlation": rho})


# -- outputs ------------------------------------------------------------------------------------


def _outputs(log: Log) -> Iterator[Finding]:
    for name, values in log.outputs.items():
        good = np.isfinite(values)
        readings = values[good]
        if np.ptp(readings) <= 1e-12 * max(1.0, float(np.abs(readings).max())):
            message = (
                f"is constant at {amount(float(readings[0]), log.units[name])} throughout; check that the sensor "
                "is connected"
            )
            yield Finding("warning", "constant", name, message)
        else:
            # A sensor that repeats values is slow or frozen; its residual would look like a delay or an effect.
            starts = np.concatenate(([0], 1 + np.flatnonzero(np.diff(readings)), [readings.size]))
            runs = np.diff(starts)
            usual, most = float(np.median(runs)), int(runs.max())
            noise, span = noise_level(readings), float(np.ptp(readings))
            if usual >= 2.0 and np.mean(np.abs(runs - usual) <= 1.0) > 0.8:
                message = (
                    f"changes only every {usual:.0f} rows: a slower sensor with repeated values. Empty the cells in "
                    "between; otherwise the repetition looks like a delay"
                )
                yield Finding("warning", "held", name, message)
            elif usual == 1.0 and most * log.step > 0.2 and most >= 10 and noise > 1e-5 * span:
                k = starts[int(np.argmax(runs))]
                value, first = amount(float(readings[k]), log.units[name]), float(log.time[good][k])
                message = (
                    f"is exactly {value} in {most} rows from t = {first:.6g} s, although its noise is larger "
                    "elsewhere: the sensor was frozen, at the end of its range, or at rest without noise"
                )
                yield Finding("warning", "frozen", name, message, {"rows": float(most), "first": first})


def outliers(log: Log, spikes: Spikes) -> Iterator[Finding]:
    """Yield a warning for each channel with outliers."""
    for name, rows in spikes.items():
        first, worst = float(log.time[rows[0]]), float(out_of_line(log, log.outputs[name])[rows].max())
        count, deviation = counted(rows.size, "reading"), amount(worst, log.units[name], difference=True)
        message = (
            f"has {count} (not explained by neighbours or model), first at t = {first:.6g} s, the largest deviation "
            f"{deviation}; `cosim refine` ignores such readings, other commands use them: empty the cells"
        )
        yield Finding("warning", "outliers", name, message)


# -- units and signs between channels --------------------------------------------------------------


def frame_findings(log: Log, traits: Traits | None = None) -> Iterator[Finding]:
    """Yield findings on angles in degrees, jumps by a turn, and wrong rates.

    Args:
        traits: Signal properties of the model; without a model, rates are guessed from names and give only warnings.
    """
    rates_by_name = {name: rate for name in log.outputs if (rate := rate_of(name, log.outputs))}
    rates, bounds = (traits.rates, traits.bounds) if traits else (rates_by_name, {})
    for name, rate in rates.items():
        if name in log.outputs and rate in log.outputs:
            yield from _against_rate(log, name, rate, declared=traits is not None)
    for name, values in (*log.inputs.items(), *log.outputs.items()):
        if log.units[name] != "rad":
            continue
        limits = bounds.get(name)
        good = values[np.isfinite(values)]
        size = float(np.abs(good).max())
        cure, stated = f'if it is in degrees, rename the column to "{name} [deg]"', log.written.get(name)
        if stated:
            cure = f'check the unit "{stated}" in its header, or extend the limits of the model'
        if limits and not limits[0] <= float(good.min()) <= float(good.max()) <= limits[1]:
            low, high = (plain(v) for v in limits)
            message = f"reaches {plain(size)} rad, outside the limits of the model ({low} to {high}); {cure}"
            yield Finding("fault", "degrees", name, message)
        elif not stated and ((name in log.inputs and size > FULL_TURN) or size > 20.0 * FULL_TURN):
            yield Finding("warning", "degrees", name, f"reaches {plain(size)} rad; {cure}")
        jumps = np.flatnonzero(np.abs(np.diff(good)) > math.pi)
        if jumps.size and name in log.outputs and size <= 20.0 * FULL_TURN:
            first = float(log.time[np.isfinite(values)][jumps[0] + 1])
            message = (
                f"jumps by more than half a turn {counted(jumps.size, 'time')}, first at t = {first:.6g} s; angles "
                "must be continuous"
            )
            yield Finding("warning", "jumps", name, message, {"count": float(jumps.size), "first": first})
    for name, times in log.unwrapped.items():
        message = f"has {counted(len(times), 'jump')} of a turn, first at t = {times[0]:.6g} s; the jumps are removed"
        yield Finding("note", "wrapped", name, message)


def _against_rate(log: Log, name: str, rate: str, *, declared: bool) -> Iterator[Finding]:
    """Yield findings from a comparison of a signal with the integral of its rate.

    With consistent units and signs, the slope of the signal over the integral is 1.
    """
    good = np.isfinite(log.outputs[rate])
    if good.sum() < 2 or np.median(np.diff(log.time[good])) >= MAX_INTEGRATED_PAUSE_S * log.slowness:
        return  # between such readings, the integral is a guess
    rates = np.interp(log.time, log.time[good], log.outputs[rate][good])
    area = np.concatenate(([0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(log.time))))
    fit = fit_slope(log, log.outputs[name], area)
    if fit is None:
        return
    slope = fit.slope
    severity: Severity = "fault" if declared else "warning"
    if abs(fit.correlation) < MIN_AGREEMENT:
        moved, turned = (float(np.nanstd(fast_part(log, values))) for values in (log.outputs[name], area))
        if moved > FAR_OFF * noise_level(log.outputs[name]) and turned > 0.5 * moved:
            message = (
                f"does not follow the integral of {rate} (correlation {plain(fit.correlation, 2)}), although both "
                "change by far more than their noise: one of the two jumps or changes its sign within the log, or they "
                "belong to different bodies"
            )
            yield Finding("warning", "disagreement", name, message)
    elif slope < 0.0:
        message = (
            f"has the opposite sign of d {name}/dt (slope {plain(slope)}); reverse the sign of one: the rate must be "
            "positive while the signal increases"
        )
        yield Finding(severity, "sign", rate, message)
    elif any(0.7 < slope / scale < 1.4 for scale in (DEGREES, 1.0 / DEGREES)):
        degrees, other, unit = (name, rate, "deg") if slope > 1.0 else (rate, name, "deg/s")
        written = " and ".join(f'"{n} [{log.written[n]}]"' for n in (degrees, other) if log.written.get(n))
        cure = f'give the unit in the header, "{degrees} [{unit}]"' + (f", which has {written}" if written else "")
        message = f"is {plain(max(slope, 1.0 / slope))} times the value expected from {other}: one is in degrees, the "
        yield Finding(severity, "degrees", degrees, f"{message}other in radians; {cure}")
    elif abs(slope - 1.0) > max(0.03, 5.0 * fit.error):
        message = (
            f"integrates to {plain(1.0 / slope)} times the change of {name}: a scale is wrong, or the range of one "
            "sensor is limited"
        )
        yield Finding("warning", "scale", rate, message)
