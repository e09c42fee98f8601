"""How much noise the sensors have, as the logs show it: what the model says of them may be of another sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cosim.arrays import Array
from cosim.logs.noise import noise_level, surprise, white_noise
from cosim.refinement.noise_model import Noise
from cosim.refinement.problem import Problem, own_run
from cosim.text import plain
from plant.model import Model

OFF = 1.5  # times, from which the noise in the logs is another than the model's; it is known to a tenth
REST = 1.2  # times its noise, up to which the spread of a channel is no motion
SMOOTH = 0.3  # of a channel's level, that the model's own motion may make of it from row to row


def sensor_noise(problem: Problem) -> dict[str, float]:
    """Output → standard deviation of its noise in the logs [its unit], of the outputs in which it is identifiable.

    The level is that of what four neighbours do not say of a reading, so of white noise and of fast motion alike. The
    model's own run says how much is motion; an output in which that is much, as of a sensor slower than what it
    measures, is left out.
    """
    levels = {}
    runs = [own_run(problem, index).outputs for index in range(len(problem.logs))]
    for j, name in enumerate(problem.layout.outputs):
        columns = [log.y[:, j] for log in problem.logs]
        alike = [np.where(np.isfinite(y), run[:, j], np.nan) for y, run in zip(columns, runs, strict=True)]
        measured, motion = (white_noise(np.concatenate([surprise(y) for y in each])) for each in (columns, alike))
        if motion < SMOOTH * measured:
            levels[name] = math.sqrt(measured**2 - motion**2)
    return levels


def noise_warnings(problem: Problem, found: Noise, model: Model) -> tuple[str, ...]:
    """Where the logs have another noise than is stated, or none is stated; to be read beside a verdict."""
    stated, levels = np.sqrt(problem.r).tolist(), np.exp(0.5 * found.sensors).tolist()
    known = dict(zip(problem.layout.outputs, stated, strict=True))
    estimated = dict(zip(problem.layout.outputs, levels, strict=True))
    free = {n for n, moved in zip(problem.layout.outputs, problem.adjusted, strict=True) if moved}
    units = {q.name: q.unit for q in model.outputs}
    off = {
        n: level
        for n, level in estimated.items()
        if n in free and n in model.sensor_variance and not known[n] / OFF <= level <= OFF * known[n]
    }
    warnings = []
    if off:
        warnings.append(
            f"the noise in the logs is not the model's ({_beside(off, known, units)}); "
            f"that of the logs is used, as {_line(off)} in the study would say"
        )
    if unknown := {n: estimated[n] for n in estimated if n in free and n not in model.sensor_variance}:
        names = " and ".join(unknown)
        warnings.append(
            f"how much noise {names} has, the model does not say (sensor_variance); "
            f"the logs say {_line(unknown)}, unless the study says another"
        )
    return tuple(warnings)


def _beside(levels: Mapping[str, float], known: Mapping[str, float], units: Mapping[str, str]) -> str:
    return "; ".join(f"{n} {plain(v, 2)}, not {plain(known[n], 2)} {units[n]}" for n, v in levels.items())


def _line(levels: Mapping[str, float]) -> str:
    return f"`noise: {{{', '.join(f'{name}: {level:.2g}' for name, level in levels.items())}}}`"


def at_rest(problem: Problem) -> bool:
    """Whether in none of the logs anything moves: neither an input nor, beyond its noise, an output."""
    return all(
        not np.ptp(log.u, axis=0).any() and all(_noise_alone(column[np.isfinite(column)]) for column in log.y.T)
        for log in problem.logs
    )


def _noise_alone(values: Array) -> bool:
    return values.size == 0 or float(np.std(values)) <= REST * noise_level(values)
