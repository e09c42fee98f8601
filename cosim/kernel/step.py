"""A model on the commands of a log, line for line that of fmus/native/step.c.

Plain Python on arrays, for numba to compile: read as text, and the model's constants and functions written below it.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # stand below: numbers of states, inputs, remembered values; the model's functions
    from cosim.arrays import Array

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


def rk4(t: float, h: float, x: Array, u: Array, p: Array, k: Array) -> None:
    """Advance x by h; k (5, NX) is room for four derivatives and the state at which they are taken."""
    z = k[4]
    deriv(t, x, u, p, k[0])
    for i in range(NX):
        z[i] = x[i] + 0.5 * h * k[0, i]
    deriv(t + 0.5 * h, z, u, p, k[1])
    for i in range(NX):
        z[i] = x[i] + 0.5 * h * k[1, i]
    deriv(t + 0.5 * h, z, u, p, k[2])
    for i in range(NX):
        z[i] = x[i] + h * k[2, i]
    deriv(t + h, z, u, p, k[3])
    for i in range(NX):
        x[i] += h / 6.0 * (k[0, i] + 2.0 * (k[1, i] + k[2, i]) + k[3, i])


def act(
    log_u: Array, substeps: int, k: int, s: int, delay: float, memory: Array, p: Array, u: Array, shaped: Array
) -> None:
    """What acts over substep s of the step that ends in row k: the log's command after delay and what shapes it."""
    start = k - 1 + s / substeps
    if delay > 0.0:
        held_mean(log_u, start - delay, start + 1.0 / substeps - delay, u)
    else:
        for j in range(NU):
            u[j] = log_u[k - 1, j]
    shape_all(u, memory, p, shaped)
    for j in range(NU):
        u[j] = shaped[j]
    for j in range(NM):
        memory[j] = shaped[NU + j]


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
    x, u, shaped, work = x0.copy(), np.empty(NU), np.empty(NU + NM), np.empty((5, NX))
    memory = memory0.copy()
    h = step / substeps
    delay = p[DELAY] / step if DELAY >= 0 else 0.0
    for k in range(first, len(log_u)):
        t = start + k * step
        if k > first:
            for s in range(substeps):
                act(log_u, substeps, k, s, delay, memory, p, u, shaped)
                rk4(t - step + s * h, h, x, u, p, work)
            if len(kicks) > 0:
                for i in range(NX):
                    x[i] += kicks[k, i]
        measure(t, x, log_u[max(0, k - 1)], p, outputs[k])  # the FMU's outputs are of the command held
        if not kept(k, x, memory, states, memories):
            return k
    return len(log_u)
