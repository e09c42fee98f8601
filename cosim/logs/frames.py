"""Consistency of units and signs between channels."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cosim.core.arrays import Array
from cosim.core.linear_algebra import least_squares
from cosim.core.text import amount, counted, plain
from cosim.logs.channel_noise import noise_level
from cosim.logs.finding import Finding, Severity
from cosim.logs.log import TURN, Log
from cosim.model.planar import PlanarFrame
from cosim.model.traits import Traits, rate_of

STILL = 1e-9  # [unit of the signal] change below which only rounding is visible
DEGREES = 180.0 / math.pi
MIN_AGREEMENT = 0.9  # correlation of the change of a signal with the integral of its rate
FAR_OFF = 8.0  # multiple of the usual miss, or of the noise
PAUSE = 0.2  # [s] without a reading
TURNED = 9.0  # ratio of sideways motion to that of the mirror image from which an axis is reversed
LEAST_POSITIONS = 20  # positions
SPACING = 0.2  # [s] between positions
MIN_TURN = 0.2  # [rad] standard deviation of the heading from which exchanged axes differ from motion sideways
JUMP = 10.0  # multiple of a step that 99 % of the rows do not exceed
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
        if log.units[name] != "rad":
            continue
        limits = bounds.get(name)
        good = values[np.isfinite(values)]
        size, numbers = float(np.abs(good).max()), {"largest": float(np.abs(good).max())}
        cure, stated = f'if it is in degrees, call it "{name} [deg]"', log.written.get(name)
        if stated:
            cure = f'its header says "{stated}": is it so, and may the model not go there?'
        if limits and not limits[0] <= float(good.min()) <= float(good.max()) <= limits[1]:
            low, high = (plain(v) for v in limits)
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
    for name, times in log.unwrapped.items():
        message = (
            f"has {counted(len(times), 'jump')} of a turn, first at t = {times[0]:.6g} s; undone, it is continuous"
        )
        yield Finding("note", "wrapped", name, message, {"count": float(len(times)), "first": times[0]})
    if traits and (frame := traits.planar) and {frame.x, frame.y, frame.heading} <= log.outputs.keys():
        yield from _axis_findings(log, frame)


def _against_rate(log: Log, name: str, rate: str, *, declared: bool) -> Iterator[Finding]:
    """Yield findings from comparing a signal with the integral of its rate, Δy = s·∫ẏ dt + b·T over blocks.

    With consistent units, signs and sensors, s is 1 and b is 0.
    """
    good = np.flatnonzero(np.isfinite(log.outputs[name]) & np.isfinite(log.outputs[rate]))
    time, values, rates = log.time[good], log.outputs[name][good], log.outputs[rate][good]
    if time.size < 2:
        return
    area = np.concatenate(([0.0], np.cumsum(0.5 * (rates[1:] + rates[:-1]) * np.diff(time))))
    edges = np.flatnonzero(np.diff(np.floor((time - time[0]) / (BLOCK * log.slowness)), prepend=-1.0))
    if edges.size < 2:
        return
    longest = np.maximum.reduceat(np.diff(time)[: edges[-1]], edges[:-1])
    whole = longest < PAUSE * log.slowness  # over a pause, the integral is a guess
    change, integral, length = (np.diff(part[edges])[whole] for part in (values, area, time))
    if change.size < 8 or np.std(integral) == 0.0 or np.std(change) <= STILL:
        return
    rho = float(np.corrcoef(change, integral)[0, 1])
    if abs(rho) < MIN_AGREEMENT:
        jumps = [*_jump_findings(log, name, rate, (change, integral), change - integral)]
        yield from jumps
        moved, turned = float(np.std(change)), float(np.std(integral))
        if not jumps and moved > FAR_OFF * noise_level(log.outputs[name]) and turned > 0.5 * moved:
            message = (
                f"does not follow the integral of {rate} (correlation {plain(rho, 2)}), though both move far beyond "
                "their noise: one of them has another sign in a part of the log, or belongs to another body"
            )
            yield Finding("warning", "disagreement", name, message, {"correlation": rho})
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
        ratio, cure = plain(float(max(slope, 1 / slope)), 3), f'Give the unit in the header, "{degrees} [{unit}]"'
        if log.written.get(degrees):
            headers = " and ".join(f'"{n} [{log.written[n]}]"' for n in (degrees, other) if log.written.get(n))
            cure = f"The header says {headers}: one of the units is wrong"
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
        message = f"is {bias} above d {name}/dt throughout: a bias of one of the sensors"
        yield Finding("note", "drift", rate, message, numbers)


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


def _axis_findings(log: Log, frame: PlanarFrame) -> Iterator[Finding]:
    """Yield warnings for a reversed axis, exchanged axes and jumps; a body mostly moves along its heading."""
    x, y, heading = (log.outputs[name] for name in (frame.x, frame.y, frame.heading))
    good = np.flatnonzero(np.isfinite(x + y + heading))[:: max(1, round(SPACING / log.step))]
    if good.size < LEAST_POSITIONS:
        return
    dx, dy, pointing = np.diff(x[good]), np.diff(y[good]), 0.5 * (heading[good][1:] + heading[good][:-1])
    pairs = {"as recorded": (dx, dy), "mirrored": (dx, -dy), "exchanged": (dy, dx), "turned": (dy, -dx)}
    sideways = {way: float(np.sum((a * np.sin(pointing) - b * np.cos(pointing)) ** 2)) for way, (a, b) in pairs.items()}
    best = min(sideways, key=lambda way: sideways[way])
    ratio = sideways["as recorded"] / sideways[best] if sideways[best] > 0.0 else 0.0
    if ratio > TURNED and best == "mirrored":
        message = (
            f"the body moves sideways unless {frame.x}, {frame.y} or {frame.heading} is turned round: world Y "
            f"points left and {frame.heading} is positive to the left"
        )
        yield Finding("warning", "mirrored", frame.y, message, {"ratio": ratio})
    elif ratio > TURNED and float(pointing.std()) > MIN_TURN:
        message = f"the body moves sideways unless {frame.x} and {frame.y} are exchanged: are the columns swapped?"
        yield Finding("warning", "swapped", frame.x, message, {"ratio": ratio})
    for name in (frame.x, frame.y):  # a position that jumps between two rows and stays there
        good = np.flatnonzero(np.isfinite(log.outputs[name]))
        steps = np.abs(np.diff(log.outputs[name][good]))
        if steps.size < LEAST_POSITIONS or not (largest := float(steps.max())) > JUMP * float(np.quantile(steps, 0.99)):
            continue
        k = int(np.argmax(steps))
        before, after = (
            np.median(log.outputs[name][good[rows]]) for rows in (slice(max(0, k - 4), k + 1), slice(k + 1, k + 6))
        )
        if abs(after - before) > 0.5 * largest:
            message = (
                f"jumps by {amount(largest, log.units[name])} in the row at t = "
                f"{float(log.time[good[k + 1]]):.6g} s, far more than in other rows: was the sensor set anew, or "
                "are two logs joined?"
            )
            yield Finding("warning", "jumps", name, message, {"size": largest})
