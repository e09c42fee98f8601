"""Growth of small errors of the start state, and the time over which a model can predict.

On an unstable or chaotic plant, a small error of the start state grows exponentially. Predictions beyond that time
measure the start, not the model. The growth is measured on the logs: the given model is simulated from filtered states
and from states beside them. Errors count in units of each signal's standard deviation.
"""

from __future__ import annotations

import numpy as np

from cosim.core.arrays import Array
from cosim.estimation.data import count_unscored
from cosim.estimation.fit import initial_fit
from cosim.estimation.kernel.kernel import CONSTANT, DISTURBANCE, Begin, simulate_all
from cosim.estimation.problem import Problem

NEAR = 10.0  # growth of a start error within a shortened horizon; a horizon is too long if this happens twice in it
EXPONENTIAL = 5.0  # growth over the second half of a time, from which growth is exponential; quadratic growth has 4
STARTS = 8  # simulations per log and state
DISPLACEMENT = float(np.sqrt(np.finfo(float).eps))  # of a state, as a share of its standard deviation


def predictable_horizon(problem: Problem, horizon: float) -> float:
    """Return the horizon [s], shortened if start errors of the given model grow exponentially and a hundredfold.

    Within the shorter horizon, start errors grow tenfold in the median over starts and logs.
    A free run keeps its length.
    """
    layout, values, curves = problem.layout, problem.values, list[Array]()
    if layout.is_free_run or not layout.states:
        return horizon
    noise = initial_fit(problem).noise
    for index, log in enumerate(problem.logs):
        data, first, run = (
            problem.data(values, index),
            count_unscored(log),
            problem.run(values, noise, index, states=True),
        )
        length = int(min(round(min(horizon, len(data.u) * data.step) / data.step), len(data.u) - first - 1))
        spreads, added = np.std(run.states[first:], axis=0), (DISTURBANCE, CONSTANT)
        moving = [k for k, name in enumerate(layout.states) if spreads[k] > 0.0 and not name.startswith(added)]
        if length < 2 or not moving or not np.isfinite(spreads).all():
            continue
        spread, p = problem.readings[index].spread, problem.numbers(problem.of_log(values, index))
        steps = np.vstack([np.zeros(len(spreads)), np.diag(DISPLACEMENT * spreads)[moving]])
        for row in np.unique(np.linspace(first, len(data.u) - 1 - length, STARTS).astype(int)).tolist():
            start, part = problem.drop_unknown_inputs(run.states[row]), data.rows(row, row + length + 1)
            begins: list[Begin] = [(part, p, start + step, run.memory[row], None, 0) for step in steps]
            with np.errstate(over="ignore", invalid="ignore"):
                outputs = np.array([each.outputs for each in simulate_all(problem.kernel, begins)])
                outputs /= np.where(spread > 0.0, spread, np.inf)
                apart = np.linalg.norm(outputs[1:] - outputs[0], axis=2) / DISPLACEMENT
            curves.append(np.nan_to_num(apart, nan=np.inf, posinf=np.inf).max(axis=0))
    rows = min(map(len, curves), default=0)
    growth = np.maximum.accumulate(np.median([curve[:rows] for curve in curves], axis=0)) if rows else np.zeros(1)
    is_far = (growth > NEAR**2) & (growth > EXPONENTIAL * growth[np.arange(len(growth)) // 2])
    return min(horizon, max(2, int(np.argmax(growth > NEAR))) * problem.logs[0].step) if is_far.any() else horizon
