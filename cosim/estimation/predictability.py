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
    if problem.layout.is_free_run or not problem.layout.states:
        return horizon
    step = problem.logs[0].step
    curves = [curve for index in range(len(problem.logs)) for curve in _growth_curves(problem, index, horizon)]
    rows = min(map(len, curves), default=0)
    if not rows:
        return horizon
    growth = np.maximum.accumulate(np.median([curve[:rows] for curve in curves], axis=0))
    halves = growth[np.arange(rows) // 2]
    is_far = (growth > NEAR**2) & (growth > EXPONENTIAL * halves)
    if not is_far.any():
        return horizon
    return min(horizon, max(2, int(np.argmax(growth > NEAR))) * step)


def _growth_curves(problem: Problem, index: int, horizon: float) -> list[Array]:
    """Return the growth of start errors by row of a prediction, for some starts of a log."""
    data, first = problem.data(problem.values, index), count_unscored(problem.logs[index])
    run = problem.run(problem.values, initial_fit(problem).noise, index, states=True)
    rows = len(data.u)
    length = int(min(round(min(horizon, rows * data.step) / data.step), rows - first - 1))
    spreads, added = np.std(run.states[first:], axis=0), (DISTURBANCE, CONSTANT)
    moving = [k for k, name in enumerate(problem.layout.states) if spreads[k] > 0.0 and not name.startswith(added)]
    if length < 2 or not moving or not np.isfinite(spreads).all():
        return []
    spread, curves = problem.readings[index].spread, []
    p, scale = problem.numbers(problem.of_log(problem.values, index)), np.where(spread > 0.0, spread, np.inf)
    steps = np.vstack([np.zeros(len(spreads)), np.diag(DISPLACEMENT * spreads)[moving]])
    for row in np.unique(np.linspace(first, rows - 1 - length, STARTS).astype(int)).tolist():
        start, part = problem.drop_unknown_inputs(run.states[row]), data.rows(row, row + length + 1)
        begins: list[Begin] = [(part, p, start + step, run.memory[row], None, 0) for step in steps]
        with np.errstate(over="ignore", invalid="ignore"):
            outputs = np.array([each.outputs for each in simulate_all(problem.kernel, begins)]) / scale
            apart = np.linalg.norm(outputs[1:] - outputs[0], axis=2) / DISPLACEMENT
        curves.append(np.nan_to_num(apart, nan=np.inf, posinf=np.inf).max(axis=0))
    return curves
