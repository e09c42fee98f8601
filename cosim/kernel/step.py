"""A model on the commands of a log, line for line that of cosim/fmi/native/step.c.

Plain Python on arrays, for numba to compile: read as text, and the model's constants and functions written below it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # stand below: numbers of states, inputs, remembered values; the model's functions
    from cosim.base.arrays import Array, Rows

    NX = NU = NM = DELAY = 0

    def deriv(t: float, x: Array, u: Array, p: Array, out: Array) -> None:
        """Derivative of the state."""

    def measure(t: float, x: Array, u: Array, p: Array, out: Array) -> None:
        """Outputs."""

    def shape_all(u: Array, memory: Array, p: Array, out: Array) -> None:
        """Command that acts, and the memory after it."""


def held_mean(log_u: Array, t0: float, t1: float, out: Array) -> None:
    """Mean over [t0, t1] (in rows from the start) of the held commands; the first row has always been there."""
    for j in range(NU):
        out[j] = 0.0
    at = t0
    while at < t1 - 1e-12:
        row = math.floor(at + 1e-9)
        until = min(row + 1.0, t1)
        held = max(0, min(row, len(log_u) - 1))
        for j in range(NU):
            out[j] += log_u[held, j] * (until - at) / (t1 - t0)
        at = until


def on_ramps(log_u: Array, ramps: Rows, at: float, out: Array) -> None:
    """What is interpolated, at a time (in rows from the start); the others stay as they are."""
    row = math.floor(at + 1e-9)
    before, after = max(0, min(row, len(log_u) - 1)), max(0, min(row + 1, len(log_u) - 1))
    for j in range(NU):
        if ramps[j]:
            out[j] = log_u[before, j] + (at - row) * (log_u[after, j] - log_u[before, j])


def rk4(t: float, h: float, x: Array, acting: Array, p: Array, k: Array) -> None:
    """Advance x by h; commands (3, NU) act at the start, the middle and the end.

    k (5, NX) is room for four derivatives and the state at which they are taken.
    """
    z = k[4]
    deriv(t, x, acting[0], p, k[0])
    for i in range(NX):
        z[i] = x[i] + 0.5 * h * k[0, i]
    deriv(t + 0.5 * h, z, acting[1], p, k[1])
    for i in range(NX):
        z[i] = x[i] + 0.5 * h * k[1, i]
    deriv(t + 0.5 * h, z, acting[1], p, k[2])
    for i in range(NX):
        z[i] = x[i] + h * k[2, i]
    deriv(t + h, z, acting[2], p, k[3])
    for i in range(NX):
        x[i] += h / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])


def held(log_u: Array, ramps: Rows, k: int, out: Array) -> None:
    """The commands with which the FMU gives its outputs in row k: held over the step before it, or interpolated."""
    for j in range(NU):
        out[j] = log_u[max(0, k - 1), j]
    on_ramps(log_u, ramps, k, out)


def act(
    log_u: Array,
    ramps: Rows,
    substeps: int,
    k: int,
    s: int,
    delay: float,
    memory: Array,
    p: Array,
    acting: Array,
    shaped: Array,
) -> None:
    """What acts over substep s of the step that ends in row k: the log's command after delay and what shapes it.

    acting (3, NU): at its start, middle and end; what remembers takes one step, with the command in the middle.
    """
    start, width, middle = k - 1 + s / substeps, 1.0 / substeps, acting[1]
    ramp = False
    for j in range(NU):
        ramp = ramp or ramps[j] > 0
    if delay > 0.0:
        held_mean(log_u, start - delay, start + width - delay, middle)
    else:
        for j in range(NU):
            middle[j] = log_u[k - 1, j]
    for i in range(0, 3, 2):
        for j in range(NU):
            acting[i, j] = middle[j]
        if ramp:
            on_ramps(log_u, ramps, start + 0.5 * i * width - delay, acting[i])
            shape_all(acting[i], memory, p, shaped)
            for j in range(NU):
                acting[i, j] = shaped[j]
    if ramp:
        on_ramps(log_u, ramps, start + 0.5 * width - delay, middle)
    shape_all(middle, memory, p, shaped)
    for j in range(NU):
        middle[j] = shaped[j]
    for j in range(NM):
        memory[j] = shaped[NU + j]
    if not ramp:
        for i in range(0, 3, 2):
            for j in range(NU):
                acting[i, j] = middle[j]


def kept(k: int, x: Array, memory: Array, states: Array, memories: Array) -> bool:
    """Write down row k where room is given; true where the state is finite."""
    if len(states) > 0:
        for i in range(NX):
            states[k, i] = x[i]
        for i in range(NM):
            memories[k, i] = memory[i]
    finite = True
    for i in range(NX):
        finite = finite and math.isfinite(x[i])
    return finite


def simulate(
    step: float,
    start: float,
    substeps: int,
    ramps: Rows,
    log_u: Array,
    first: int,
    p: Array,
    x0: Array,
    memory0: Array,
    kicks: Array,
    outputs: Array,
    states: Array,
    memories: Array,
) -> int:
    """Run without looking at measurements: kicks (rows, NX; or none) are added to the state at each row.

    Outputs (rows, NY) are free of noise. `first` is the row of x0 and memory0: rows before it matter to a delay alone.
    """
    x, acting, shaped, work = x0.copy(), np.empty((3, NU)), np.empty(NU + NM), np.empty((5, NX))
    command = np.empty(NU)
    memory = memory0.copy()
    h = step / substeps
    delay = p[DELAY] / step if DELAY >= 0 else 0.0
    for k in range(first, len(log_u)):
        t = start + k * step
        if k > first:
            for s in range(substeps):
                act(log_u, ramps, substeps, k, s, delay, memory, p, acting, shaped)
                rk4(t - step + s * h, h, x, acting, p, work)
            if len(kicks) > 0:
                for i in range(NX):
                    x[i] += kicks[k, i]
        held(log_u, ramps, k, command)
        measure(t, x, command, p, outputs[k])
        if not kept(k, x, memory, states, memories):
            return k
    return len(log_u)
