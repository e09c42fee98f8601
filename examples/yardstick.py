"""Least-squares fits of short predictions, as a yardstick for the models that `cosim refine` delivers.

Nothing here is of cosim: equations are functions on arrays, RK4 integrates all windows of a log at once, and scipy
fits. Fitted and delivered parameters are measured in the same way.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import yaml
from scipy.optimize import least_squares

Array = np.ndarray
Parameters = Mapping[str, float]
PASSES = 3  # fits; each weights an output by the inverse error of the pass before
START_PASSES = 3  # Gauss-Newton steps for the state at the start of a window
STEP = 1e-6  # of a state, for the differences of these steps
LEAST_SCALE = 1e-3  # of a parameter whose start is 0
PARTS = 3  # of each log, to choose terms
CHOICE_TOLERANCE = 1e-4  # of the sum of squares, to choose terms


@dataclass(frozen=True)
class Channel:
    """An output of a rig, and how its error is printed: the unit, and the size of the unit in SI."""

    name: str
    unit: str
    size: float


@dataclass(frozen=True)
class Rig:
    """Equations of a rig and the windows over which they predict.

    Attributes:
        derivative: Derivative of the states, from parameters, states and inputs.
        states: Number of states; the outputs are the first of them.
        inputs: Columns of the inputs.
        channels: Outputs.
        horizon: Length of a prediction [s].
        every: Rows from the start of a window to that of the next.
        past: Length of the readings to which the start of a prediction is fitted [s]; 0 if all states are measured.
        substeps: Steps of RK4 per row.
        interpolated: Whether inputs change linearly between rows; otherwise they hold.
        delay: Name of the parameter that delays all inputs, "" without one.
        biases: Output → name of the parameter that its reading has in addition.
        least: Parameter → its least value.
    """

    derivative: Callable[[Parameters, tuple[Array, ...], tuple[Array, ...]], tuple[Array, ...]]
    states: int
    inputs: tuple[str, ...]
    channels: tuple[Channel, ...]
    horizon: float
    every: int
    past: float = 0.0
    substeps: int = 2
    interpolated: bool = False
    delay: str = ""
    biases: Mapping[str, str] = field(default_factory=dict)
    least: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Log:
    """Columns of a log as arrays: time, inputs and outputs, a row each; first rows of its windows, None for all."""

    time: Array
    inputs: Array
    outputs: Array
    begins: Array | None = None


def read_log(rig: Rig, path: Path) -> Log:
    """Return the columns of a log that the rig has."""
    with path.open(encoding="utf-8", newline="") as stream:
        table = list(csv.DictReader(stream))

    def columns(names: Sequence[str]) -> Array:
        return np.array([[float(row[name]) for row in table] for name in names])

    return Log(columns(["time"])[0], columns(rig.inputs), columns([c.name for c in rig.channels]))


# -- predictions --------------------------------------------------------------------------------


def _inputs_at(rig: Rig, log: Log, times: Array, delay: float) -> tuple[Array, ...]:
    if rig.interpolated:
        return tuple(np.interp(times - delay, log.time, row) for row in log.inputs)
    rows = np.clip(np.searchsorted(log.time, times - delay, side="right") - 1, 0, None)
    return tuple(row[rows] for row in log.inputs)


def _row(rig: Rig, log: Log, p: Parameters, at: Array, x: tuple[Array, ...]) -> tuple[Array, ...]:
    """Return the states a row after the rows `at`, by RK4."""
    h = (log.time[at + 1] - log.time[at]) / rig.substeps
    for part in range(rig.substeps):
        begin = log.time[at] + part * h
        # A held input has one value over a substep, that of its middle; an interpolated one changes.
        stages = (0.0, 0.5, 0.5, 1.0) if rig.interpolated else (0.5, 0.5, 0.5, 0.5)
        delay = p[rig.delay] if rig.delay else 0.0
        u = {c: _inputs_at(rig, log, begin + c * h, delay) for c in set(stages)}
        slopes: list[tuple[Array, ...]] = []
        for stage, share in zip(stages, (0.0, 0.5, 0.5, 1.0), strict=True):
            moved = tuple(a + share * h * b for a, b in zip(x, slopes[-1], strict=True)) if slopes else x
            slopes.append(rig.derivative(p, moved, u[stage]))
        x = tuple(a + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4) for a, k1, k2, k3, k4 in zip(x, *slopes, strict=True))
    return x


def _run(rig: Rig, log: Log, p: Parameters, begin: Array, rows: int, x: tuple[Array, ...]) -> Array:
    """Return the outputs at the start of each window and at the rows after it: output, row, axes of the states."""
    outputs = [x]
    for k in range(rows):
        x = _row(rig, log, p, begin + k, x)
        outputs.append(x)
    return np.array([[state[j] for state in outputs] for j in range(len(rig.channels))])


def _starts(rig: Rig, log: Log, p: Parameters, begin: Array, readings: Array) -> Array:
    """Return the states (state, set, window) that fit the readings (output, row, set, window), by least squares.

    A single row is the state.
    """
    x = np.zeros((rig.states, *readings.shape[2:]))
    x[: len(rig.channels)] = readings[:, 0]
    rows = readings.shape[1] - 1
    moves = STEP * np.eye(rig.states, 1 + rig.states, 1)[:, :, None, None]  # of no state, then of each
    for _ in range(START_PASSES if rows else 0):
        runs = _run(rig, log, p, begin, rows, tuple(x[:, None] + moves))
        slopes = np.moveaxis((runs[:, :, 1:] - runs[:, :, :1]) / STEP, (3, 4, 2), (0, 1, 2))
        jacobian = slopes.reshape(*slopes.shape[:3], -1)
        misfit = np.moveaxis(readings - runs[:, :, 0], (2, 3), (0, 1)).reshape(*slopes.shape[:2], -1, 1)
        x = x + np.moveaxis(np.linalg.solve(jacobian @ np.swapaxes(jacobian, 2, 3), jacobian @ misfit)[..., 0], 2, 0)
    return x


def _windows(rig: Rig, log: Log) -> tuple[Array, int, int]:
    """Return the first rows of the windows, and the rows of the past and of the prediction."""
    step = float(np.median(np.diff(log.time)))
    past, ahead = round(rig.past / step), round(rig.horizon / step)
    begins = np.arange(0, len(log.time) - past - ahead, rig.every) if log.begins is None else log.begins
    return begins, past, ahead


def _misses(rig: Rig, log: Log, sets: Sequence[Parameters]) -> Array:
    """Return measured − predicted: output, row of the prediction, set of parameters, window."""
    p = {name: np.array([[q[name]] for q in sets]) for name in sets[0]}
    bias = np.array([[q[rig.biases[c.name]] if c.name in rig.biases else 0.0 for q in sets] for c in rig.channels])
    begin, past, ahead = _windows(rig, log)
    measured = log.outputs[:, begin + np.arange(past + ahead + 1)[:, None]][:, :, None] - bias[:, None, :, None]
    x = _starts(rig, log, p, begin, measured[:, : past + 1])
    predicted = _run(rig, log, p, begin, past + ahead, tuple(x))
    return (measured - predicted)[:, past + 1 :]


def _rms(misses: Sequence[Array]) -> Array:
    """Return the root mean square of each output over the arrays of `_misses`."""
    return np.array(
        [np.sqrt(np.mean(np.square(np.concatenate([m.ravel() for m in c])))) for c in zip(*misses, strict=True)]
    )


def rms(rig: Rig, logs: Sequence[Log], p: Parameters) -> Array:
    """Return the root mean square error of each output over all windows of all logs."""
    return _rms([_misses(rig, log, [p]) for log in logs])


def fit(
    rig: Rig, logs: Sequence[Log], given: Parameters, free: Parameters, tolerance: float = 1e-8
) -> dict[str, float]:
    """Return the parameters of least squares; those that are not free keep their value."""
    names = list(free)
    p = {**given, **free}
    scale = np.array([max(abs(given[name]), abs(free[name]), LEAST_SCALE) for name in names])
    moves = 1e-4 * scale
    for _ in range(PASSES if len(rig.channels) > 1 else 1):
        weights = 1.0 / rms(rig, logs, p)

        def residuals(sets: Sequence[Array], weights: Array = weights) -> Array:
            q = [{**given, **dict(zip(names, values, strict=True))} for values in sets]
            parts = [np.moveaxis(_misses(rig, log, q), 2, 0) * weights[:, None, None] for log in logs]
            return np.concatenate([part.reshape(len(sets), -1) for part in parts], axis=1)

        def jacobian(values: Array) -> Array:
            moved = residuals([values, *(values + np.diag(moves))])
            return ((moved[1:] - moved[0]) / moves[:, None]).T

        least = [rig.least.get(name, -np.inf) for name in names]
        how = {"x_scale": scale, "bounds": (least, np.inf), "ftol": tolerance}
        solution = least_squares(lambda values: residuals([values])[0], [p[name] for name in names], jacobian, **how)
        p = {**given, **dict(zip(names, map(float, solution.x), strict=True))}
    return p


# -- terms chosen by parts left out -------------------------------------------------------------


def left_out(rig: Rig, logs: Sequence[Log], given: Parameters, free: Parameters) -> Array:
    """Return the RMS error of each output over parts of the logs, each left out of the fit in turn."""
    misses = []
    for k, log in enumerate(logs):
        begin, past, ahead = _windows(rig, log)
        edges = np.linspace(0, len(log.time), PARTS + 1).astype(int)
        for first, end in pairwise(edges):
            within = (begin >= first) & (begin + past + ahead < end)
            apart = (begin + past + ahead < first) | (begin >= end)
            others = [*logs[:k], replace(log, begins=begin[apart]), *logs[k + 1 :]]
            p = fit(rig, others, given, free, CHOICE_TOLERANCE)
            misses.append(_misses(rig, replace(log, begins=begin[within]), [p]))
    return _rms(misses)


def choose(rig: Rig, logs: Sequence[Log], given: Parameters, base: Parameters, terms: Parameters) -> None:
    """Print how terms are added to the base, each time the one that predicts parts left out best.

    The choice ends if no term reduces the error of the parts left out; of several outputs, the mean square of the
    errors relative to the base.
    """
    free, chosen, best = dict(base), list[str](), 1.0
    unit = left_out(rig, logs, given, base)
    while left := {name: start for name, start in terms.items() if name not in chosen}:
        fitted = fit(rig, logs, given, free)
        free = {name: fitted[name] for name in free}
        shares = {}
        for name, start in left.items():
            ratio = left_out(rig, logs, given, {**free, name: start}) / unit
            shares[name] = float(np.sqrt(np.mean(np.square(ratio))))
        ranked = sorted(shares, key=lambda name: shares[name])
        print(", ".join(f"{name} {shares[name]:.1%}" for name in ranked))
        if shares[ranked[0]] >= best:
            break
        best = shares[ranked[0]]
        chosen.append(ranked[0])
        free[ranked[0]] = terms[ranked[0]]
    print(f"chosen: {', '.join(chosen) or 'none'}")


# -- models that refine delivers ----------------------------------------------------------------


def delivered(given: Parameters, folder: Path) -> dict[str, dict[str, float]]:
    """Return the parameters of model.yaml and, if not all is claimed, of nearest.yaml of a folder of `cosim refine`.

    Raises:
        ValueError: A file has a parameter that the yardstick does not know.
    """
    grade = json.loads((folder / "refine.json").read_text(encoding="utf-8"))["grade"]
    models = {}
    for name in ("model.yaml", *(["nearest.yaml"] if grade != "claimed" else [])):
        file = yaml.safe_load((folder / name).read_text(encoding="utf-8"))
        values = {**file["parameters"], **(file.get("sensors") or {})}
        unknown = [key for key in values if key not in given]
        if unknown:
            raise ValueError(f"{folder / name} has {', '.join(unknown)}, which these equations lack")
        models[name] = {**given, **values}
    return models


# -- the table ----------------------------------------------------------------------------------


def compare(rig: Rig, given: Parameters, variants: Mapping[str, Parameters], folder: Path, refined: Path | None) -> str:
    """Return a table of root mean square errors: as given, each fit, the delivered models relative to the last fit."""
    estimation = [read_log(rig, folder / name) for name in ("e1.csv", "e2.csv")]
    sealed = [read_log(rig, folder / "v1.csv")]
    header = "".join(f"{f'{c.name} [{c.unit}]':>16}" for c in rig.channels)
    lines = [f"{f'error over {rig.horizon:g} s, sealed log':32}{header}{'ratio':>16}"]

    def row(name: str, p: Parameters, shown: Sequence[str], best: Array | None = None) -> Array:
        error = rms(rig, sealed, p)
        sizes = "".join(f"{e / c.size:16.3g}" for e, c in zip(error, rig.channels, strict=True))
        ratio = "" if best is None else ", ".join(f"{r:.2f}" for r in error / best)
        values = ", ".join(f"{key} {p[key]:.4g}" for key in shown)
        lines.append(f"{name:32}{sizes}{ratio:>16}  {values}".rstrip())
        return error

    row("as given", given, ())
    for name, free in variants.items():
        best = row(f"{name}, least squares", fit(rig, estimation, given, free), list(free))
    for name, p in delivered(given, refined).items() if refined else ():
        row(f"refine, {name}", p, [key for key in p if p[key] != given[key]], best)
    return "\n".join(lines)


def compare_logs(rig: Rig, given: Parameters, free: Parameters, folder: Path) -> str:
    """Return a table of fits to each log alone: parameters, and the errors on each log, also the sealed one."""
    logs = {name: read_log(rig, folder / name) for name in ("e1.csv", "e2.csv", "v1.csv")}
    lines = []
    for name, log in logs.items():
        p = fit(rig, [log], given, free)
        values = ", ".join(f"{key} {p[key]:.4g}" for key in free)
        for other, sealed in logs.items():
            error = rms(rig, [sealed], p)
            sizes = "".join(f"{e / c.size:16.3g}" for e, c in zip(error, rig.channels, strict=True))
            lines.append(f"{f'{name} alone, on {other}':32}{sizes}  {values}")
    return "\n".join(lines)


def main(
    description: str, rig: Rig, given: Parameters, variants: Mapping[str, Parameters], terms: Parameters | None = None
) -> int:
    """Print the table for the folder of logs in the arguments; return the exit code.

    Args:
        variants: Models to fit: name → free parameters with their starts.
        terms: Parameters and their starts from which `--choose` chooses.
    """
    parser = argparse.ArgumentParser(description=description)
    parser.add_argument("logs", type=Path, help="folder that make_logs.py wrote")
    parser.add_argument("--refined", type=Path, help="folder that `cosim refine` wrote")
    parser.add_argument("--each", action="store_true", help="fit the last model to each log alone, too")
    if terms:
        parser.add_argument("--choose", action="store_true", help="only choose terms, by parts of e1 and e2 left out")
    options = parser.parse_args()
    try:
        if terms and options.choose:
            logs = [read_log(rig, options.logs / name) for name in ("e1.csv", "e2.csv")]
            choose(rig, logs, given, next(iter(variants.values())), terms)
            return 0
        print(compare(rig, given, variants, options.logs, options.refined))
        if options.each:
            print(compare_logs(rig, given, [*variants.values()][-1], options.logs))
    except (OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return 2
    return 0
