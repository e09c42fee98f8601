"""Evidence for an effect: the log-likelihood [nats] lost by the true model without the effect.

The estimate is linear and Gaussian, and uses nothing of the project. An extended Kalman filter about the true run knows
the true sensor noise and the size and correlation time of the disturbance. It returns the change of the innovations
without the effect. Base parameters (within their tolerances) and the study's further effects may imitate a part of this
change. Half the square of the rest is the cost.
"""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tests.blind.field_rig import Array, Arrays, Rig, Run, flat, runge_kutta

Values = dict[str, float]


def costs(
    rig: Rig,
    base: Values,
    truth: Mapping[str, Values],
    runs: Sequence[Run],
    variances: Sequence[Array],
    push_deviations: Sequence[float],
) -> dict[str, float]:
    """Return effect → nats lost without it, after a refit of base parameters and further effects.

    Args:
        rig: the plant.
        base: its true base parameters.
        truth: its effects.
        runs: the logs.
        variances: of the cells of each log, infinite without measurement.
        push_deviations: standard deviations of the disturbance.
    """
    p, known = rig.numbers(base, truth), len(rig.sheet)
    cases = [p | flat({name: rig.every_entry[name].left_out(values)}) for name, values in truth.items()]
    # base parameters with a prior of half the tolerance, and parameters of the effects, a little off
    cases += [p | {name: p[name] + 0.25 * share * abs(value)} for name, (value, share) in rig.sheet.items()]
    nudges = [(name, parameter) for name, values in truth.items() for parameter in values]
    cases += [p | {f"{name}.{parameter}": _nudged(rig, name, parameter, truth)} for name, parameter in nudges]
    columns = _innovations(rig, p, cases, (runs, variances, np.array(push_deviations)))
    changes = columns[:, len(truth) :].copy()
    changes[:, :known] *= 2.0  # of one standard deviation
    found = {}
    for k, name in enumerate(truth):
        own = [known + n for n, (other, _) in enumerate(nudges) if other == name]
        found[name] = 0.5 * _remaining(columns[:, k], np.delete(changes, own, axis=1), known)
    return found


def _nudged(rig: Rig, name: str, parameter: str, truth: Mapping[str, Values]) -> float:
    """Return a parameter moved by 5 % of its distance from neutral, or of its value for a shape."""
    entry, value = rig.every_entry[name], truth[name][parameter]
    return value + (0.05 * (value if parameter in entry.shape or entry.inverse else value - entry.neutral) or 1e-9)


def _remaining(what: Array, free: Array, with_prior: int) -> float:
    """Return the squared distance of `what` from the best combination of `free`.

    The first `with_prior` coefficients have a standard normal prior, which adds their squares.
    """
    prior = np.eye(with_prior, free.shape[1])
    scale = np.sqrt(np.sum(free**2, axis=0)) + 1e-300
    rows, target = np.vstack([free, prior]) / scale, np.append(what, np.zeros(with_prior))
    best = np.linalg.lstsq(rows, target)[0]
    return float(np.sum((target - rows @ best) ** 2))


def _innovations(rig: Rig, p: Values, cases: Sequence[Values], given: tuple[Any, Any, Array]) -> Array:
    """Return the whitened innovations of the true run under models with other parameters, a column per model.

    An extended Kalman filter with the gains of the true model, whose innovations are 0, runs on all logs and for all
    cases at once. Arrays are (…, logs, columns). The columns are the true run, the cases, and the true run with each
    state a little above and below, for the Jacobians. Additional states are the pushes, and earlier readings of a late
    sensor (registers, newest first).
    """
    (runs, variances, deviations), outputs = given, len(rig.outputs)
    logs, count, width = len(runs), len(runs[0].times), 1 + len(cases)
    names = {name.partition(".")[0] for case in (p, *cases) for name in case}
    scales = rig.scales(names)
    n, moved = scales.size, scales.size + len(rig.pushes)
    everyone = [p, *cases, *[p] * (2 * moved)]
    numbers = _columns(rig, everyone)
    rate, look = rig.bind(Arrays, numbers)
    actings = _actings(rig, everyone, runs)
    sensor, late_output = rig.late()
    late = list(rig.outputs).index(late_output) if late_output else 0
    latency = np.array([case.get(f"{sensor}.value", 0.0) for case in everyone[:width]]) / rig.step  # in rows
    registers = math.ceil(float(latency.max())) + 1 if latency.max() > 0.0 else 0
    size, seen = moved + registers, np.empty(0)
    steps = np.concatenate([1e-5 * scales, 1e-3 * np.maximum(deviations, 1e-12)])
    x = np.stack([rig.first_state(names, run) for run in runs], axis=1)[:, :, None] * np.ones(len(everyone))
    x = np.concatenate([x, np.zeros((len(rig.pushes), *x.shape[1:]))])
    keep = math.exp(-rig.step / rig.correlation_time)
    cov = np.zeros((logs, size, size))
    cov[:] = np.diag(np.concatenate([(0.3 * scales) ** 2, deviations**2, np.full(registers, 1e-12)]))
    noise = np.diag([*[0.0] * n, *(1.0 - keep**2) * deviations**2, *[0.0] * registers])
    variance = np.stack(list(variances), axis=1)  # (rows, logs, outputs)
    variance = np.where(np.isfinite(variance), variance, 1e12 * np.array(list(rig.outputs.values())) ** 2)
    transition = np.zeros((logs, size, size))
    transition[:, range(n, moved), range(n, moved)] = keep
    times = np.stack([run.times for run in runs], axis=-1)
    white = np.empty((count, logs, outputs, len(cases)))
    for k in range(count):
        x[:, :, width:] = x[:, :, :1]
        for i in range(moved):
            x[i, :, width + 2 * i] += steps[i]
            x[i, :, width + 2 * i + 1] -= steps[i]
        right = look(times[k][:, None], x[:n], x[n:])
        sensed = [rig.sensed(numbers, o, v) for o, v in zip(rig.outputs, right, strict=True)]
        y = np.stack([np.broadcast_to(v, x.shape[1:]) for v in sensed])
        h = np.zeros((logs, outputs, size))
        h[:, :, :moved] = _slopes(y, width, steps)
        y = y[:, :, :width].copy()
        newest, slope = y[late].copy(), h[:, late].copy()
        if registers:
            seen = seen if seen.size else np.repeat(newest[None], registers, axis=0)
            y[late], h[:, late] = _looked_back(np.concatenate([newest[None], seen]), slope, latency, moved)
        cross = cov @ h.transpose(0, 2, 1)
        spread = h @ cross + variance[k][:, :, None] * np.eye(outputs)
        gain = np.linalg.solve(spread, cross.transpose(0, 2, 1)).transpose(0, 2, 1)
        gap = (y[:, :, :1] - y[:, :, 1:]).transpose(1, 0, 2)  # (logs, outputs, cases)
        white[k] = np.linalg.solve(np.linalg.cholesky(spread), gap)
        if k + 1 == count:
            break
        change = (gain @ gap).transpose(1, 0, 2)
        x[:, :, 1:width] += change[:moved]
        cov = cov - gain @ cross.transpose(0, 2, 1)
        cov = 0.5 * (cov + cov.transpose(0, 2, 1))
        if registers:
            seen[:, :, 1:] += change[moved:]
            newest[:, 1:] += np.einsum("li,ilc->lc", slope[:, :moved], change[:moved])
            seen = np.concatenate([newest[None], seen[:-1]])
            transition[:, moved, :] = slope
            transition[:, range(moved + 1, size), range(moved, size - 1)] = 1.0
        x[:n] = _stepped(rate, rig.substeps, (times[k], times[k + 1] - times[k]), (x[:n], x[n:]), actings[k])
        transition[:, :n, :moved] = _slopes(x[:n], width, steps)
        x[n:] *= keep
        cov = transition @ cov @ transition.transpose(0, 2, 1) + noise
    return white.reshape(-1, len(cases))


def _slopes(values: Array, width: int, steps: Array) -> Array:
    """Return the Jacobian of values by the states and pushes, shape (logs, values, states)."""
    return ((values[:, :, width::2] - values[:, :, width + 1 :: 2]) / (2.0 * steps)).transpose(1, 0, 2)


def _columns(rig: Rig, everyone: Sequence[Values]) -> dict[str, Any]:
    """Return the parameters of all columns; a case without an effect has it at neutral."""
    numbers: dict[str, Any] = {}
    for key in sorted({key for case in everyone for key in case}):
        name, _, parameter = key.partition(".")
        having = next(case[key] for case in everyone if key in case)
        neutral = rig.every_entry[name].left_out({parameter: having})[parameter] if parameter else having
        values = np.array([case.get(key, neutral) for case in everyone])
        numbers[key] = values[None, :] if np.ptp(values) else float(values[0])
    return numbers


def _actings(rig: Rig, everyone: Sequence[Values], runs: Sequence[Run]) -> Array:
    """Return the acting commands (after delay, play and such), shape (rows, parts, inputs, logs, columns)."""
    made: dict[tuple[float, ...], Array] = {}
    keys = [tuple(float(case.get(name, 0.0)) for name in rig.shaping) for case in everyone]
    for key, case in zip(keys, everyone, strict=True):
        if key not in made:
            made[key] = np.stack([rig.acting(case, run, rig.substeps) for run in runs], axis=-1)
    return np.stack([made[key] for key in keys], axis=-1)


def _looked_back(history: Array, slope: Array, latency: Array, own: int) -> tuple[Array, Array]:
    """Return the late reading of each column, interpolated between past rows, and the true run's row of H."""
    whole = np.minimum(latency.astype(int), history.shape[0] - 2)
    part = latency - whole
    columns = np.arange(latency.size)
    before, after = history[whole, :, columns].T, history[whole + 1, :, columns].T
    row = np.zeros_like(slope)
    for place, weight in ((whole[0], 1.0 - part[0]), (whole[0] + 1, part[0])):
        if place:
            row[:, own + place - 1] += weight
        else:
            row += weight * slope
    return (1.0 - part) * before + part * after, row


def _stepped(rate: Any, parts: int, time: tuple[Any, Any], now: tuple[Any, Any], acting: Array) -> Array:
    """Return the states after a row, by Runge-Kutta in `parts`; `time`: begin and step, `now`: states and pushes."""
    (t, step), (x, d) = time, now
    h = (step / parts)[:, None]
    for part, u in enumerate(acting):
        begin = (t + part * step / parts)[:, None]

        def slopes(at: Any, state: Array, u: Array = u) -> Array:
            return np.stack([np.broadcast_to(v, state.shape[1:]) for v in rate(at, state, u, d)])

        x = runge_kutta(slopes, begin, x, h)
    return x
