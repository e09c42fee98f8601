"""Least-squares fits of the three machines, with scipy alone: `python examples/machines/least_squares.py LOGS`.

Each model runs free over a whole log. Parameters are fitted to e1 and e2, together with the state at the start of
each; of the sealed log only this state, to its first rows. Printed are root mean square errors and parameters.
"""

import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

Array = np.ndarray
FIRST = 20  # rows to which the state at the start of the sealed log is fitted
STEPS = 4  # of a row
NUDGE = 1e-5
WATER = 4186.0  # heat capacity [J/(kg K)]


def lamp(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Heat capacity of the plate alone; heat in proportion to the drive."""
    gain, time = p
    return [(gain * u - (x[0] - 25.0)) / time]


def lamp_two(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Plate, a second storage behind a conductance, a filament that heats with a lag; heat by a power of the drive."""
    gain, time, exchange, behind, power, lag = p
    flow = (x[0] - x[1]) / exchange
    return [(x[2] - (x[0] - 25.0)) / time - flow, flow / behind, (gain * u**power - x[2]) / lag]


def tanks(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Two tanks without overflow."""
    upper, lower = np.sqrt(np.maximum(x, 0.0))
    return [p[0] * u - p[1] * upper, p[2] * upper - p[3] * lower]


def tanks_full(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Two tanks in series. A part of what the upper tank spills reaches the lower one, which overflows at 10 V."""
    full, share = p[4:]
    upper, lower = tanks(p, x, u)
    over = np.where(x[0] >= full, np.maximum(upper, 0.0), 0.0)
    lower = lower + share * over
    return [upper - over, np.where(x[1] >= 10.0, np.minimum(lower, 0.0), lower)]


def exchanger(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Well mixed water."""
    capacity, conductance = 1e3 * p
    return [(WATER * u * (25.0 - x[0]) + conductance * (110.0 - x[0])) / capacity]


def exchanger_lag(p: Array, x: Array, u: float) -> Sequence[Array]:
    """Well mixed water with a conductance by a power of the flow, and a sensor with a lag."""
    capacity, conductance, power, steam, lag = p
    passed = 1e3 * conductance * (u / 0.3) ** power * (steam - x[0])
    return [(WATER * u * (25.0 - x[0]) + passed) / (1e3 * capacity), (x[0] - x[1]) / lag]


Model = tuple[str, Callable[[Array, Array, float], Sequence[Array]], list[float], list[float], int]
MODELS: dict[str, list[Model]] = {  # name, equations, parameters, state, place of the reading
    "lamp": [
        ("base", lamp, [18.5, 60.0], [130.0], 0),
        ("two storages, lag, power", lamp_two, [18.0, 60.0, 50.0, 3.0, 1.0, 5.0], [130.0, 130.0, 100.0], 0),
    ],
    "tanks": [
        ("base", tanks, [0.06, 0.075, 0.075, 0.075], [5.0, 5.0], 1),
        ("overflow", tanks_full, [0.06, 0.075, 0.075, 0.075, 9.0, 0.5], [5.0, 5.0], 1),
    ],
    "exchanger": [
        ("base", exchanger, [20.0, 8.0], [98.0], 0),
        ("power of the flow, lag", exchanger_lag, [80.0, 8.5, 0.5, 110.0, 5.0], [98.0, 98.0], 1),
    ],
}


def run(model: Model, p: Array, x: Array, log: Array) -> Array:
    """Return the readings of each row and set of parameters, by Runge-Kutta steps with the input held."""
    slope, rows = model[1], []
    h = (log[1, 0] - log[0, 0]) / STEPS
    for u in log[:, 1]:
        rows.append(x[model[4]])
        for _ in range(STEPS):
            a = np.array(slope(p, x, u))
            b = np.array(slope(p, x + h / 2 * a, u))
            c = np.array(slope(p, x + h / 2 * b, u))
            x = x + h / 6 * (a + 2 * b + 2 * c + np.array(slope(p, x + h * c, u)))
    return np.array(rows)


def fit(model: Model, logs: Sequence[Array], given: Sequence[float], known: Array | None = None) -> tuple[Array, Array]:
    """Return the numbers of least squares, and measured − model; with known parameters, of the starts alone."""
    states, scale = len(model[3]), np.abs(given)

    def misses(sets: Array) -> Array:
        p = sets[: len(sets) - states * len(logs)] if known is None else np.repeat(known[:, None], sets.shape[1], 1)
        starts = np.split(sets[len(sets) - states * len(logs) :], len(logs))
        return np.concatenate([log[:, 2:] - run(model, p, x, log) for log, x in zip(logs, starts, strict=True)])

    def jacobian(q: Array) -> Array:
        moved = misses(np.column_stack([q, q[:, None] + NUDGE * np.diag(scale)]))
        return (moved[:, 1:] - moved[:, :1]) / (NUDGE * scale)

    found = least_squares(lambda q: misses(q[:, None])[:, 0], given, jacobian, x_scale=scale, bounds=(1e-6, np.inf))
    return found.x, found.fun


def main() -> int:
    """Print the table."""
    for machine, models in MODELS.items():
        place = Path(sys.argv[1]) / machine
        e1, e2, v1 = (np.loadtxt(place / f"{n}.csv", delimiter=",", skiprows=1) for n in ("e1", "e2", "v1"))
        for model in models:
            _, _, given, state, _ = model
            numbers, left = fit(model, [e1, e2], [*given, *state, *state])
            rows = []
            for p in (np.array(given), numbers[: len(given)]):
                start, _ = fit(model, [v1[:FIRST]], state, p)
                rows.append(v1[:, 2] - run(model, p, start, v1))
            before, after, learnt = (np.sqrt(np.mean(np.square(e))) for e in (*rows, left))
            values = ", ".join(f"{value:.4g}" for value in numbers[: len(given)])
            print(f"{machine:10} {model[0]:26} {learnt:6.3f}, sealed {before:6.3f} → {after:6.3f}  {values}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
