"""Consistency of a planar motion: a body mostly moves where it points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cosim.logs import messages
from cosim.logs.finding import Finding
from cosim.logs.log import Log
from cosim.model.planar import PlanarFrame

TURNED = 9.0  # ratio of sideways motion to that of the mirror image from which an axis is reversed
LEAST = 20  # positions
SPACING = 0.2  # [s] between positions


def axis_findings(log: Log, frame: PlanarFrame) -> Iterator[Finding]:
    """Yield a warning for a reversed axis, if only the mirror image moves along its heading."""
    if not {frame.x, frame.y, frame.heading} <= log.outputs.keys():
        return
    x, y, heading = (log.outputs[name] for name in (frame.x, frame.y, frame.heading))
    good = np.flatnonzero(np.isfinite(x + y + heading))[:: max(1, round(SPACING / log.step))]
    if good.size < LEAST:
        return
    dx, dy, pointing = np.diff(x[good]), np.diff(y[good]), 0.5 * (heading[good][1:] + heading[good][:-1])
    ways = {sign: float(np.sum((dx * np.sin(pointing) - sign * dy * np.cos(pointing)) ** 2)) for sign in (1.0, -1.0)}
    if ways[1.0] > TURNED * ways[-1.0]:
        message = messages.REVERSED_AXIS(y=frame.y, heading=frame.heading)
        yield Finding("warning", "mirrored", frame.y, message, {"ratio": ways[1.0] / ways[-1.0]})
