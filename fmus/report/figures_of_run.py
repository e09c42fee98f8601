"""Figures of a run: responses to reference steps, errors, effort, saturation, estimate against truth.

All use every row and SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from cosim.core.arrays import Array
from cosim.simulation import criteria
from fmus.report.roles import Craft

BAND = 0.02  # m and rad: 2 % of the thesis' unit steps
MERGE = 0.1  # s; changes of a reference closer than this are one ramp
MAX_SETTLED_DISTANCE = 0.05  # m; a craft farther from its target has not settled


@dataclass(frozen=True)
class Step:
    """One change of a reference: rows of its begin, its end and the next change."""

    begin: int
    arrived: int
    end: int

    @property
    def is_ramp(self) -> bool:
        """Return whether the change took more than one row."""
        return self.arrived > self.begin


@dataclass(frozen=True)
class Response:
    """Response of a signal to one change of its reference, in SI units."""

    variable: str
    time: float
    start: float
    target: float
    ramp: float
    settling: float
    believed: float
    overshoot: float
    rms: float
    final: float


def reference_steps(time: Array, reference: Array) -> list[Step]:
    """Return the changes of a reference.

    Row 0 counts as a change. Changes within MERGE form one ramp.
    """
    changes = [0, *(int(k) for k in np.flatnonzero(np.abs(np.diff(reference)) > 1e-12) + 1)]
    groups: list[list[int]] = [[0, 0]]
    for previous, row in pairwise(changes):
        near = row - previous <= 1 or time[row] - time[previous] <= MERGE
        if near and previous > 0:
            groups[-1][1] = row
        else:
            groups.append([row, row])
    ends = [group[0] for group in groups[1:]] + [reference.size]
    return [Step(begin, arrived, end) for (begin, arrived), end in zip(groups, ends, strict=True)]


def responses(craft: Craft, variable: str) -> list[Response]:
    """Return the responses to each change of a reference."""
    signal, reference = craft.signal(variable), craft.reference(variable)
    if signal is None or reference is None:
        return []
    good = np.isfinite(signal) & np.isfinite(reference)
    if not good.any():
        return []
    estimate = craft.estimate(f"{variable}_hat")
    rows = [line[good] for line in (craft.run.time, signal, reference)]
    estimate = None if estimate is None else estimate[good]
    steps = reference_steps(rows[0], rows[2])
    # A start on target is a response only if the reference never changes.
    if len(steps) > 1 and abs(rows[1][0] - rows[2][0]) <= BAND:
        steps = steps[1:]
    return [_response(variable, rows, estimate, step) for step in steps]


def _response(variable: str, rows: list[Array], estimate: Array | None, step: Step) -> Response:
    time, signal, reference = (line[step.begin : step.end] for line in rows)
    after, target = slice(step.arrived, step.end), float(reference[-1])
    moving = step.end - step.arrived < 2  # an unfinished ramp, or a change in the last row
    settling, believed = (
        math.nan if line is None or moving else criteria.settling_time(rows[0][after], line[after], target, BAND)
        for line in (rows[1], estimate)
    )
    before = float(rows[2][step.begin - 1]) if step.begin else float(signal[0])
    ramp = float(rows[0][step.arrived] - rows[0][step.begin]) if step.is_ramp else 0.0
    errors = criteria.rms_error(signal, reference), criteria.final_error(signal, reference)
    overshoot = criteria.overshoot(signal, target)
    return Response(variable, float(time[0]), before, target, ramp, settling, believed, overshoot, *errors)


def error_rms(signal: Array | None, target: Array | None) -> float:
    """Return the RMS error over finite rows, else NaN."""
    if signal is None or target is None:
        return math.nan
    good = np.isfinite(signal) & np.isfinite(target)
    return criteria.rms_error(signal[good], target[good]) if good.any() else math.nan


def effort(craft: Craft, side: str) -> float:
    """Return the integral of a tilt command's magnitude [rad s]."""
    command = craft.command(f"tilt_{side}")
    if command is None:
        return math.nan
    good = np.isfinite(command)
    return criteria.effort(craft.run.time[good], command[good]) if good.any() else math.nan


def saturation(craft: Craft, side: str) -> float:
    """Return the share of time at the tilt limit.

    Each command is held until the next.
    """
    command, limit, time = craft.command(f"tilt_{side}"), craft.tilt_limit, craft.run.time
    if command is None or limit is None or time.size < 2:
        return math.nan
    steps = np.diff(time)
    at_limit = np.abs(command[:-1]) >= limit * (1 - 1e-6)
    return float(steps[at_limit].sum() / steps.sum())


@dataclass(frozen=True)
class Belief:
    """Final distances of craft and estimate from the target and from each other, and final σ [m]."""

    true: float
    estimated: float
    apart: float
    sigma: float

    @property
    def wanders(self) -> bool:
        """Return whether the craft is off target, and over twice as far as its estimate."""
        return self.true > max(MAX_SETTLED_DISTANCE, 2 * self.estimated)


def belief(craft: Craft) -> Belief | None:
    """Return the median distances at the end.

    The end is the last second or the last tenth of the run, the longer of both, but after the last step.
    """
    x, x_hat, target = craft.signal("x"), craft.estimate("x_hat"), craft.reference("x")
    if x is None or x_hat is None or target is None:
        return None
    good = np.isfinite(x) & np.isfinite(x_hat) & np.isfinite(target)
    time, x, x_hat, target = craft.run.time[good], x[good], x_hat[good], target[good]
    if time.size < 3:
        return None
    arrived = reference_steps(time, target)[-1].arrived
    begin = max(float(time[arrived]), float(time[-1]) - max(1.0, 0.1 * float(time[-1] - time[0])))
    last = time >= begin
    sigma = craft.estimate("x_sigma")
    final_sigma = math.nan if sigma is None else float(sigma[good][-1])
    true, estimated, apart = (
        float(np.median(np.abs(one - other)[last])) for one, other in ((x, target), (x_hat, target), (x, x_hat))
    )
    # By the rule of the settling time, a craft with its last sample inside the band has settled.
    return Belief(min(true, float(np.abs(x - target)[-1])), estimated, apart, final_sigma)


def inside_band(craft: Craft, variable: str) -> float:
    """Return the share of rows with the truth within the estimator's ±2σ."""
    true, estimate = craft.signal(variable), craft.estimate(f"{variable}_hat")
    sigma = craft.estimate(f"{variable}_sigma")
    if true is None or estimate is None or sigma is None:
        return math.nan
    good = np.isfinite(true) & np.isfinite(estimate) & np.isfinite(sigma)
    # At the start P = 0 and the estimate is exact: rounding must not count as outside.
    return float(np.mean(np.abs(estimate - true)[good] <= 2 * sigma[good] + 1e-9)) if good.any() else math.nan
