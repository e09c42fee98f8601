"""Extended Kalman filter over a log, line for line that of filter.c.

Plain Python on arrays, for numba to compile: read as text behind step.py, and the model's constants and functions
written below both.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:  # stand above and below: step.py; numbers of outputs and stochastic states; the model's functions
    from cosim.base.arrays import Array, Rows
    from cosim.kernel.step import DELAY, NM, NU, NX, act, held, kept, measure, rk4

    NY = NS = 0
    STOCHASTIC = np.zeros(0, np.intp)

    def jacobian(t: float, x: Array, u: Array, p: Array, out: Array) -> None:
        """A, of the stochastic states, row by row."""

    def measure_jacobian(t: float, x: Array, u: Array, p: Array, out: Array) -> None:
        """C, by the stochastic states, row by row."""


def multiply(a: Array, b: Array, out: Array, transpose_b: bool) -> None:
    """Product of square matrices of order NS."""
    for i in range(NS):
        for j in range(NS):
            total = 0.0
            for k in range(NS):
                total += a[i, k] * (b[j, k] if transpose_b else b[k, j])
            out[i, j] = total


def transition(h: float, A: Array, Phi: Array) -> None:
    """Phi = I + hA + (hA)²/2 + (hA)³/6."""
    term, after = np.zeros((NS, NS)), np.empty((NS, NS))
    for i in range(NS):
        for j in range(NS):
            Phi[i, j] = term[i, j] = 1.0 if i == j else 0.0
    for order in range(1, 4):
        multiply(term, A, after, False)
        for i in range(NS):
            for j in range(NS):
                term[i, j] = after[i, j] * h / order
                Phi[i, j] += term[i, j]


def transition_over(substeps: int, h: float, A: Array, Phi: Array) -> None:
    """Over a whole step: the series is good for a substep, its power for the step."""
    once, after = np.empty((NS, NS)), np.empty((NS, NS))
    transition(h, A, once)
    copy(once, Phi)
    for _ in range(1, substeps):
        multiply(once, Phi, after, False)
        copy(after, Phi)


def copy(a: Array, out: Array) -> None:
    """Copy a matrix."""
    for i in range(a.shape[0]):
        for j in range(a.shape[1]):
            out[i, j] = a[i, j]


def predict(
    before: float,
    step: float,
    substeps: int,
    x: Array,
    u: Array,
    p: Array,
    q: Array,
    P: Array,
    work: Array,
) -> None:
    """P = Φ P Φ' + Q·step, along the state at the start of the step; work (3, NS, NS)."""
    A, Phi, M = work[0], work[1], work[2]
    jacobian(before, x, u, p, A.reshape(NS * NS))
    transition_over(substeps, step / substeps, A, Phi)
    multiply(Phi, P, M, False)
    multiply(M, Phi, P, True)
    for i in range(NS):
        P[i, i] += q[i] * step


def update(
    measured: Array, y: Array, C: Array, r: Array, P: Array, moved: Array, errors: Array, variances: Array
) -> None:
    """Take the measurements of a row one at a time; moved is what they move the state by."""
    PC = np.empty(NS)
    for i in range(NS):
        moved[i] = 0.0
    for j in range(NY):
        errors[j] = variances[j] = np.nan
        if math.isnan(measured[j]):
            continue
        s, e = r[j], measured[j] - y[j]
        for i in range(NS):
            PC[i] = 0.0
            for m in range(NS):
                PC[i] += P[i, m] * C[j, m]
        for i in range(NS):
            s += C[j, i] * PC[i]
            e -= C[j, i] * moved[i]
        errors[j], variances[j] = e, s
        for i in range(NS):
            moved[i] += PC[i] * e / s
            for m in range(NS):
                P[i, m] -= PC[i] * PC[m] / s


def filter(
    step: float,
    start: float,
    substeps: int,
    settle: int,
    ramps: Rows,
    late: Array,
    log_u: Array,
    log_y: Array,
    p: Array,
    x0: Array,
    P0: Array,
    q: Array,
    r: Array,
    errors: Array,
    variances: Array,
    states: Array,
    memories: Array,
) -> int:
    """Filter a log: errors and variances (rows, NY) of each measurement before it is taken; states (rows, NX) after.

    r (rows, NY): variance of the noise of each measurement
    late (rows, NY; or without rows): part of a row by which each is older than its row
    """
    x, acting, shaped, y, work = x0.copy(), np.empty((3, NU)), np.empty(NU + NM), np.empty(NY), np.empty((5, NX))
    command, before_step, delayed = np.empty(NU), np.empty(NY), len(late) > 0
    P, square, C, moved = P0.copy(), np.empty((3, NS, NS)), np.empty((NY, NS)), np.empty(NS)
    memory = np.zeros(NM)
    h = step / substeps
    delay = p[DELAY] / step if DELAY >= 0 else 0.0
    for k in range(len(log_u)):
        t = start + k * step
        if k > 0:
            before = t - step
            if delayed:
                held(log_u, ramps, k, command)  # what acted since: an output that takes a command did not jump
                measure(before, x, command, p, before_step)
            for s in range(substeps):
                act(log_u, ramps, substeps, k, s, delay, memory, p, acting, shaped)
                if s == 0 and k <= settle:
                    P[:] = P0  # lags still forget their start
                elif s == 0:
                    predict(before, step, substeps, x, acting[0], p, q, P, square)
                rk4(before + s * h, h, x, acting, p, work)
        held(log_u, ramps, k, command)
        measure(t, x, command, p, y)
        if delayed and k > 0:
            for j in range(NY):
                y[j] -= late[k, j] * (y[j] - before_step[j])
        measure_jacobian(t, x, command, p, C.reshape(NY * NS))
        update(log_y[k], y, C, r[k], P, moved, errors[k], variances[k])
        for i in range(NS):
            x[STOCHASTIC[i]] += moved[i]
        if not kept(k, x, memory, states, memories):
            return k
    return len(log_u)
