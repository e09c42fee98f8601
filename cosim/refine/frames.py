"""Units and signs of the channels against one another: what a mislabelled log shows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from cosim.refine.finding import Finding, Severity
from cosim.refine.log import TURN, Column, Log, rate_of
from cosim.report.text import amount, counted, plain
from plant.hovercraft import INPUTS
from plant.model import Model
from plant.namespaces import SCALAR

STILL = 1e-9  # [unit of the signal], below which its changes are rounding
DEGREES = 180.0 / math.pi
PAUSE = 0.2  # [s] without a reading
BLOCK = 0.5  # [s] over which a signal's change is held against the integral of its rate
CRAFT = frozenset(q.name for q in INPUTS)  # whose logs hold these commands, whichever FMU is driven with them


def rates_of(model: Model) -> dict[str, str]:
    """Output → the output that is its derivative: by its name, and by the equations at states about the start."""
    names = [q.name for q in model.outputs]
    pairs = {name: rate for name in names if (rate := rate_of(name, names))}
    if not pairs:
        return {}
    place, rng, seen = {name: k for k, name in enumerate(names)}, np.random.default_rng(1), 0
    for _ in range(3):
        try:
            values, slopes = _moving(model, rng)
        except (ArithmeticError, ValueError):  # no such state: a root, a logarithm
            continue
        seen += 1
        off = np.array([abs(slopes[place[n]] - values[place[r]]) for n, r in pairs.items()])
        size = np.array([abs(values[place[r]]) for r in pairs.values()])
        pairs = {n: r for (n, r), same in zip(pairs.items(), off <= 1e-3 * size, strict=True) if same}
    return pairs if seen else {}


def _moving(model: Model, rng: np.random.Generator) -> tuple[Column, Column]:
    """Outputs at a state drawn about the start, and their slopes [1/s]."""
    derivative, output = model.equations(SCALAR)
    start, held = np.array(model.start(), dtype=np.float64), np.array(model.start_command(), dtype=np.float64)
    x, u = (v + 0.1 * (1.0 + np.abs(v)) * rng.standard_normal(v.size) for v in (start, held))
    command = tuple(u.tolist())
    with np.errstate(all="ignore"):
        f = np.array(derivative(0.0, tuple(x.tolist()), command))
        h = 1e-6 / (1.0 + float(np.max(np.abs(f) / (1.0 + np.abs(x)), initial=0.0)))  # [s], a small part of any change
        now, before, after = (np.array(output(0.0, tuple((x + s * h * f).tolist()), command)) for s in (0.0, -1.0, 1.0))
        return now, (after - before) / (2.0 * h)


def frames(log: Log, rates: Mapping[str, str] | None = None) -> Iterator[Finding]:
    """Degrees in place of radians, jumps of a turn, rates of the wrong sign or scale, a mirrored frame.

    rates: `rates_of` the model. Without, names alone tell what is a rate, and only those of the craft are relied on.
    """
    sure = rates is not None or log.inputs.keys() == CRAFT
    if rates is None:
        rates = {name: rate for name in log.outputs if (rate := rate_of(name, log.outputs))}
    for name, rate in rates.items():
        if name in log.outputs and rate in log.outputs:
            yield from _against_rate(log, name, rate, "fault" if sure else "warning")
    for name, values in (*log.inputs.items(), *log.outputs.items()):
        if log.units[name] == "rad":
            yield from _magnitude(log, name, values)
    for name, times in log.unwrapped.items():
        yield Finding(
            "note", "wrapped", name,
            f"has {counted(len(times), 'jump')} of a turn, first at t = {times[0]:.6g} s; undone, it is continuous",
            {"count": float(len(times)), "first": times[0]},
        )  # fmt: skip
    yield from _mirrored(log)


def _against_rate(log: Log, name: str, rate: str, severity: Severity) -> Iterator[Finding]:
    """Fit Δy = s·∫ẏ dt + b·T over blocks: s is 1 and b is 0 where units, signs and sensors agree."""
    change, integral, length = _blocks(log, log.outputs[name], log.outputs[rate])
    if change.size < 8 or np.std(integral) == 0.0 or np.std(change) <= STILL:
        return
    rho = float(np.corrcoef(change, integral)[0, 1])
    design = np.column_stack((integral, length))
    (slope, drift), *_ = np.linalg.lstsq(design, change, rcond=None)
    left = change - design @ (slope, drift)
    sigma = math.sqrt(float(left @ left) / (change.size - 2))
    error_slope, error_drift = sigma * np.sqrt(np.diag(np.linalg.inv(design.T @ design)))
    numbers = {"slope": float(slope), "correlation": rho, "drift": float(drift)}
    if abs(rho) < 0.9:
        return
    if slope < 0.0:
        yield Finding(
            severity, "sign", rate, f"has the opposite sign of d {name}/dt (slope {plain(float(slope))}); "
            "turn one of them round: the rate is positive where the signal grows", numbers,
        )  # fmt: skip
    elif any(0.7 < slope / scale < 1.4 for scale in (DEGREES, 1.0 / DEGREES)):
        degrees, other = (name, rate) if slope > 1.0 else (rate, name)
        yield Finding(
            severity, "degrees", degrees,
            f"is {plain(float(max(slope, 1 / slope)), 3)} times what {other} says: one is in degrees, the other in "
            f'radians. Give the unit in the header, "{degrees} [{"deg" if slope > 1.0 else "deg/s"}]"', numbers,
        )  # fmt: skip
    elif abs(slope - 1.0) > max(0.03, 5.0 * error_slope):
        share = plain(float(1 / slope), 3)
        yield Finding(
            "warning", "scale", rate, f"integrates to {share} times the change of {name}: a scale is off", numbers
        )
    if slope > 0.0 and abs(drift) > 5.0 * error_drift and abs(drift) > 0.003 * float(np.nanstd(log.outputs[rate])):
        bias = amount(float(-drift / slope), log.units[rate], 2)
        yield Finding("note", "drift", rate, f"is {bias} above d {name}/dt throughout: a bias of one of the sensors",
                      numbers)  # fmt: skip


def _blocks(log: Log, values: Column, rates: Column) -> tuple[Column, Column, Column]:
    """Change, integral of the rate and length of consecutive blocks, over the rows that have both."""
    good = np.flatnonzero(np.isfinite(values) & np.isfinite(rates))
    time, y, rate = log.time[good], values[good], rates[good]
    if time.size < 2:
        return np.zeros(0), np.zeros(0), np.zeros(0)
    area = np.concatenate(([0.0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(time))))
    edges = np.flatnonzero(np.diff(np.floor((time - time[0]) / BLOCK), prepend=-1.0))
    change, integral, length = np.diff(y[edges]), np.diff(area[edges]), np.diff(time[edges])
    if edges.size < 2:
        return change, integral, length
    whole = np.maximum.reduceat(np.diff(time)[: edges[-1]], edges[:-1]) < PAUSE  # over it the integral is a guess
    return change[whole], integral[whole], length[whole]


def _magnitude(log: Log, name: str, values: Column) -> Iterator[Finding]:
    """Angles too large to be radians, and jumps of a turn that were not undone."""
    good = values[np.isfinite(values)]
    size, numbers = float(np.abs(good).max()), {"largest": float(np.abs(good).max())}
    cure = f'if it is in degrees, call it "{name} [deg]"'
    if "tilt" in name and log.inputs.keys() == CRAFT and size > 0.5 * math.pi:
        yield Finding("fault", "degrees", name, f"reaches {plain(size)} rad, more than a quarter turn; {cure}", numbers)
    elif (name in log.inputs and size > TURN) or size > 20.0 * TURN:
        yield Finding("warning", "degrees", name, f"reaches {plain(size)} rad; {cure}", numbers)
    jumps = np.flatnonzero(np.abs(np.diff(good)) > math.pi)
    if jumps.size and name in log.outputs and size <= 20.0 * TURN:
        first = float(log.time[np.isfinite(values)][jumps[0] + 1])
        yield Finding(
            "warning", "jumps", name, f"jumps by more than half a turn {counted(jumps.size, 'time')}, first at "
            f"t = {first:.6g} s; an angle is continuous", {"count": float(jumps.size), "first": first},
        )  # fmt: skip


def _mirrored(log: Log) -> Iterator[Finding]:
    """A craft goes mostly where it points; where only the mirror image does, an axis is turned round."""
    if not {"x_world", "y_world", "psi"} <= log.outputs.keys():
        return
    x, y, psi = (log.outputs[name] for name in ("x_world", "y_world", "psi"))
    good = np.flatnonzero(np.isfinite(x + y + psi))[:: max(1, round(0.2 / log.step))]
    if good.size < 20:
        return
    dx, dy, heading = np.diff(x[good]), np.diff(y[good]), 0.5 * (psi[good][1:] + psi[good][:-1])
    ways = {sign: float(np.sum((dx * np.sin(heading) - sign * dy * np.cos(heading)) ** 2)) for sign in (1.0, -1.0)}
    if ways[1.0] > 9.0 * ways[-1.0]:
        yield Finding(
            "warning", "mirrored", "y_world", "the craft moves sideways unless y_world, or psi, is turned round: world "
            "Y points left and psi is positive to the left", {"ratio": ways[1.0] / ways[-1.0]},
        )  # fmt: skip
