"""How much noise the sensors have, as the logs show it: what the model says of them may be of another sensor."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cosim.arrays import Array
from cosim.logs.noise import noise_level, surprise, white_noise
from cosim.refinement.problem import Problem, own_run
from cosim.text import plain
from plant.model import Model

OFF = 1.5  # times, from which the noise in the logs is another than the model's; it is known to a tenth
TOO_QUIET = 0.1  # of the model's, below which it is no sensor's: an encoder between its steps, a filtered reading
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


def other_noise(problem: Problem, model: Model, given: Mapping[str, float]) -> tuple[dict[str, float], tuple[str, ...]]:
    """Noise of the logs where it is plainly another than the model's, to be used; and warnings of it.

    given: what the study says, which holds. Where the logs are far too quiet, the model's noise stays: it may stand for
    more than noise.
    """
    known = dict(zip(problem.layout.outputs, np.sqrt(problem.r).tolist(), strict=True))
    estimated = {name: level for name, level in sensor_noise(problem).items() if name not in given}
    off = {n: level for n, level in estimated.items() if not known[n] / OFF <= level <= OFF * known[n]}
    quiet = {n: level for n, level in off.items() if level < TOO_QUIET * known[n] and n in model.sensor_variance}
    used = {n: level for n, level in off.items() if n not in quiet and level > 0.0}
    units = {q.name: q.unit for q in model.outputs}
    warnings = []
    if used:
        warnings.append(
            f"the noise in the logs is not the model's ({_beside(used, known, units)}); "
            f"that of the logs is used, as {_line(used)} in the study would say"
        )
    if quiet:
        warnings.append(
            f"the logs show next to no noise ({_beside(quiet, known, units)}); "
            f"the model's is used, unless the study says {_line(quiet)}"
        )
    if unknown := [n for n in known if n not in model.sensor_variance and n not in given and n not in used]:
        line = f"`noise: {{{', '.join(f'{n}: …' for n in unknown)}}}`"
        warnings.append(
            f"how much noise {' and '.join(unknown)} has, neither the model says (sensor_variance) nor the logs; "
            f"1 is used, unless the study says {line}"
        )
    return used, tuple(warnings)


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
