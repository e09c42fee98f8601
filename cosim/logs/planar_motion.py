"""Consistency of a planar motion: a body mostly moves where it points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosim.base.text import amount
from cosim.logs.finding import Finding
from cosim.logs.log import Log
from cosim.model.planar import PlanarFrame

TURNED = 9.0  # ratio of sideways motion to that of the mirror image from which an axis is reversed
LEAST = 20  # positions
SPACING = 0.2  # [s] between positions
MIN_TURN = 0.2  # [rad] standard deviation of the heading from which exchanged axes differ from motion sideways
JUMP = 10.0  # multiple of a step that 99 % of the rows do not exceed


def axis_findings(log: Log, frame: PlanarFrame) -> Iterator[Finding]:
    """Yield warnings for a reversed axis, exchanged axes and jumps; a body mostly moves along its heading."""
    if not {frame.x, frame.y, frame.heading} <= log.outputs.keys():
        return
    x, y, heading = (log.outputs[name] for name in (frame.x, frame.y, frame.heading))
    good = np.flatnonzero(np.isfinite(x + y + heading))[:: max(1, round(SPACING / log.step))]
    if good.size < LEAST:
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
    yield from _jump_findings(log, frame)


def _jump_findings(log: Log, frame: PlanarFrame) -> Iterator[Finding]:
    """Yield a warning for a position that jumps between two rows and stays there."""
    for name in (frame.x, frame.y):
        good = np.flatnonzero(np.isfinite(log.outputs[name]))
        steps = np.abs(np.diff(log.outputs[name][good]))
        if steps.size < LEAST or not (largest := float(steps.max())) > JUMP * float(np.quantile(steps, 0.99)):
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
