"""Consistency of units and signs between channels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cosim.base.arrays import Array
from cosim.base.linear_algebra import least_squares
from cosim.base.messages import Note
from cosim.base.text import amount, counted, plain
from cosim.logs.channel_noise import noise_level
from cosim.logs.finding import Finding, Severity
from cosim.logs.log import TURN, Log
from cosim.logs.planar_motion import axis_findings
from cosim.model.traits import Traits, rate_of

STILL = 1e-9  # [unit of the signal] change below which only rounding is visible
DEGREES = 180.0 / math.pi
MIN_AGREEMENT = 0.9  # correlation of the change of a signal with the integral of its rate
FAR_OFF = 8.0  # multiple of the usual miss, or of the noise
PAUSE = 0.2  # [s] without a reading
BLOCK = 0.5  # [s] over which a signal's change is compared with the integral of its rate


def frame_findings(log: Log, traits: Traits | None = None) -> Iterator[Finding]:
    """Yield findings on degrees, jumps of a turn, wrong rates and mirrored frames.

    Args:
        traits: Signal properties of the model; without a model, rates are guessed from names and give only warnings.
    """
    rates_by_name = {name: rate for name in log.outputs if (rate := rate_of(name, log.outputs))}
    rates, bounds = (traits.rates, traits.bounds) if traits else (rates_by_name, {})
    for name, rate in rates.items():
        if name in log.outputs and rate in log.outputs:
            yield from _against_rate(log, name, rate, declared=traits is not None)
    for name, values in (*log.inputs.items(), *log.outputs.items()):
        if log.units[name] == "rad":
            yield from _magnitude(log, name, values, bounds.get(name))
    for name, times in log.unwrapped.items():
        message = (
            f"has {counted(len(times), 'jump')} of a turn, first at t = {times[0]:.6g} s; undone, it is continuous"
        )
        yield Finding("note", "wrapped", name, message, {"count": float(len(times)), "first": times[0]})
    if traits and traits.planar:
        yield from axis_findings(log, traits.planar)


def _against_rate(log: Log, name: str, rate: str, *, declared: bool) -> Iterator[Finding]:
    """Yield findings from comparing a signal with the integral of its rate, Δy = s·∫ẏ dt + b·T over blocks.

    With consistent units, signs and sensors, s is 1 and b is 0.
    """
    change, integral, length = _blocks(log, log.outputs[name], log.outputs[rate])
    if change.size < 8 or np.std(integral) == 0.0 or np.std(change) <= STILL:
        return
    rho = float(np.corrcoef(change, integral)[0, 1])
    if abs(rho) < MIN_AGREEMENT:
        jumps = list(_jump_findings(log, name, rate, (change, integral), change - integral))
        yield from jumps or _disagreement(log, name, rate, (change, integral), rho)
        return
    design = np.column_stack((integral, length))
    slope, drift = least_squares(design, change)
    residual = change - design @ (slope, drift)
    yield from _jump_findings(log, name, rate, (change, integral), residual)
    sigma = math.sqrt(float(residual @ residual) / (change.size - 2))
    error_slope, error_drift = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    numbers = {"slope": float(slope), "correlation": rho, "drift": float(drift)}
    severity: Severity = "fault" if declared else "warning"
    if slope < 0.0:
        message = (
            f"has the opposite sign of d {name}/dt (slope {plain(float(slope))}); turn one of them round: the rate is "
            "positive where the signal grows"
        )
        yield Finding(severity, "sign", rate, message, numbers)
    elif any(0.7 < slope / scale < 1.4 for scale in (DEGREES, 1.0 / DEGREES)):
        degrees, other, unit = (name, rate, "deg") if slope > 1.0 else (rate, name, "deg/s")
        ratio, cure = plain(float(max(slope, 1 / slope)), 3), _unit_cure(log, degrees, other, unit)
        message = f"is {ratio} times what {other} says: one is in degrees, the other in radians. {cure}"
        yield Finding(severity, "degrees", degrees, message, numbers)
    elif abs(slope - 1.0) > max(0.03, 5.0 * error_slope):
        message = (
            f"integrates to {plain(float(1 / slope), 3)} times the change of {name}: a scale is off, or one of "
            "them is limited"
        )
        yield Finding("warning", "scale", rate, message, numbers)
    if slope > 0.0 and abs(drift) > 5.0 * error_drift and abs(drift) > 0.003 * float(np.nanstd(log.outputs[rate])):
        bias = amount(float(-drift / slope), log.units[rate], 2)
        yield Finding(
            "note",
            "drift",
            rate,
            Note(f"is {bias} above d {name}/dt throughout: a bias of one of the sensors"),
            numbers,
        )


def _jump_findings(log: Log, name: str, rate: str, moves: tuple[Array, Array], miss: Array) -> Iterator[Finding]:
    """Yield a warning for a single block in which a signal changes and its rate does not.

    Args:
        moves: Changes of the signal and integrals of its rate, by block.
        miss: Deviation of each change from the usual relation of both.
    """
    k, others = int(np.argmax(np.abs(miss))), np.arange(miss.size) != int(np.argmax(np.abs(miss)))
    scale = max(1.4826 * float(np.median(np.abs(miss))), math.sqrt(2.0) * noise_level(log.outputs[name]))
    change, integral = moves[0][others], moves[1][others]
    if abs(miss[k]) <= FAR_OFF * scale or not (np.std(change) > 0.0 and np.std(integral) > 0.0):
        return
    if float(np.corrcoef(change, integral)[0, 1]) > MIN_AGREEMENT:
        message = (
            f"jumps by {amount(abs(float(miss[k])), log.units[name])} at one place, and {rate} shows no such "
            "motion: was the sensor set anew?"
        )
        yield Finding("warning", "jumps", name, message, {"size": float(miss[k])})


def _disagreement(log: Log, name: str, rate: str, moves: tuple[Array, Array], rho: float) -> Iterator[Finding]:
    """Yield a warning for a signal that does not follow the integral of its rate, though both move beyond noise."""
    change, integral = (float(np.std(values)) for values in moves)
    if change > FAR_OFF * noise_level(log.outputs[name]) and integral > 0.5 * change:
        message = (
            f"does not follow the integral of {rate} (correlation {plain(rho, 2)}), though both move far beyond "
            "their noise: one of them has another sign in a part of the log, or belongs to another body"
        )
        yield Finding("warning", "disagreement", name, message, {"correlation": rho})


def _unit_cure(log: Log, degrees: str, other: str, unit: str) -> str:
    """Return the cure for a column whose values are in degrees, according to the units in the header.

    Args:
        degrees: Name of the column.
        other: Signal that contradicts the column.
        unit: Unit to state in the header.
    """
    headers = " and ".join(f'"{name} [{log.written[name]}]"' for name in (degrees, other) if log.written.get(name))
    if log.written.get(degrees):
        return f"The header says {headers}: one of the units is wrong"
    return f'Give the unit in the header, "{degrees} [{unit}]"'


def _blocks(log: Log, values: Array, rates: Array) -> tuple[Array, Array, Array]:
    """Return change, integrated rate and length of consecutive blocks with both signals."""
    good = np.flatnonzero(np.isfinite(values) & np.isfinite(rates))
    time, y, rate = log.time[good], values[good], rates[good]
    if time.size < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    area = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))))
    edges = np.flatnonzero(np.diff(np.floor((time - time[0]) / (BLOCK * log.slowness)), prepend=-1.0))
    change, integral, length = np.diff(y[edges]), np.diff(area[edges]), np.diff(time[edges])
    if edges.size < 2:
        return change, integral, length
    longest = np.maximum.reduceat(np.diff(time)[: edges[-1]], edges[:-1])
    whole = longest < PAUSE * log.slowness  # over a pause, the integral is a guess
    return change[whole], integral[whole], length[whole]


def angle_cure(log: Log, name: str) -> str:
    """Return advice for an angle that is too large: check the unit in the header, or state degrees."""
    if written := log.written.get(name):
        return f'its header says "{written}": is it so, and may the model not go there?'
    return f'if it is in degrees, call it "{name} [deg]"'


def _magnitude(log: Log, name: str, values: Array, bounds: tuple[float, float] | None) -> Iterator[Finding]:
    """Yield findings on angles that are too large for radians, and on jumps by a full turn.

    Args:
        bounds: Limits declared by the model.
    """
    good = values[np.isfinite(values)]
    size, numbers = float(np.abs(good).max()), {"largest": float(np.abs(good).max())}
    cure, stated = angle_cure(log, name), bool(log.written.get(name))
    if bounds and not bounds[0] <= float(good.min()) <= float(good.max()) <= bounds[1]:
        low, high = (plain(v) for v in bounds)
        message = f"reaches {plain(size)} rad, beyond what the model allows ({low} to {high}); {cure}"
        yield Finding("fault", "degrees", name, message, numbers)
    elif not stated and ((name in log.inputs and size > TURN) or size > 20.0 * TURN):
        yield Finding("warning", "degrees", name, f"reaches {plain(size)} rad; {cure}", numbers)
    jumps = np.flatnonzero(np.abs(np.diff(good)) > math.pi)
    if jumps.size and name in log.outputs and size <= 20.0 * TURN:
        first = float(log.time[np.isfinite(values)][jumps[0] + 1])
        message = (
            f"jumps by more than half a turn {counted(jumps.size, 'time')}, first at t = {first:.6g} s; an angle "
            "is continuous"
        )
        yield Finding("warning", "jumps", name, message, {"count": float(jumps.size), "first": first})
