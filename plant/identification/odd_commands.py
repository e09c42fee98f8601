"""Commands that differ between repetitions although the cells read the same: a shifted or scaled column."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cosim.base.arrays import Array, Flags
from cosim.base.messages import Message
from plant.identification import messages
from plant.identification.estimates import Measurement
from plant.identification.frequency import group_by_frequency
from plant.identification.protocol import CHANNELS, MIN_REPETITIONS, HeightTest, SineTest
from plant.identification.recordings import Recording

COMMANDS = ("duty", "servo_duty")
FALSE_SHIFT = 0.01  # false alarm probability in a test whose commands really differ; with equal ones there is none


def odd_commands(m: Measurement) -> list[Message]:
    """Return warnings about recordings whose commands differ from the other repetitions, but not their voltages.

    Two hypotheses are compared for each recording and command: its voltages are those of the other repetitions, or
    those plus the answers to the different command. The scatter between the repetitions gives both a likelihood.
    """
    if isinstance(m.test, HeightTest):  # repetitions are found by their duty
        return []
    groups = group_by_frequency(m.recordings, m.test).values() if isinstance(m.test, SineTest) else [m.recordings]
    found = []
    for group in groups:
        if len(group) >= MIN_REPETITIONS:
            found += [message for command in COMMANDS for message in _odd_in_group(m, group, command)]
    return found


def _odd_in_group(m: Measurement, group: Sequence[Recording], command: str) -> Iterator[Message]:
    """Yield a warning for each repetition with a deviating command; none if half of them deviate."""
    rests, windows = [r.rows(m.test.rest) for r in group], [_window(m, r) for r in group]
    values = [getattr(r, command) for r in group]
    at_rest, inside = (_offsets(values, rows) for rows in (rests, windows))
    if not inside.any():
        return
    ratios = []
    for c in CHANNELS:
        volts = [r.volts[c] - r.volts[c][rest].mean() for r, rest in zip(group, rests, strict=True)]
        means = np.array([v[w].mean() for v, w in zip(volts, windows, strict=True)])
        gain = _gain(values, volts, [rest | w for rest, w in zip(rests, windows, strict=True)])
        ratios.append(_log_likelihood_ratios(means, gain * inside))
    odd = np.flatnonzero(np.sum(ratios, axis=0) > math.log(np.count_nonzero(inside) / FALSE_SHIFT))
    if 2 * odd.size < len(group):
        for k in odd.tolist():
            cell = list(CHANNELS)[int(np.argmax([ratio[k] for ratio in ratios]))]
            fields = {"column": command, "difference": inside[k], "rest": at_rest[k], "cell": cell}
            yield messages.ODD_COMMAND(recording=group[k].label, **fields)


def _window(m: Measurement, r: Recording) -> Flags:
    if isinstance(m.test, SineTest):
        return np.asarray(r.time >= m.test.lead + m.test.skip)
    return r.rows(m.test.window)


def _offsets(values: Sequence[Array], rows: Sequence[Flags]) -> Array:
    """Return each recording's mean relative to their median."""
    means = np.array([v[k].mean() for v, k in zip(values, rows, strict=True)])
    return np.asarray(means - np.median(means))


def _gain(commands: Sequence[Array], volts: Sequence[Array], rows: Sequence[Flags]) -> float:
    """Return the slope of the voltage over the command, with an offset for each recording."""
    top = bottom = 0.0
    for u, v, k in zip(commands, volts, rows, strict=True):
        free = u[k] - u[k].mean()
        top, bottom = top + float(free @ v[k]), bottom + float(free @ free)
    return top / bottom if bottom > 0.0 else 0.0


def _log_likelihood_ratios(means: Array, answers: Array) -> Array:
    """Return for each recording the log likelihood ratio of the others' mean to that mean plus an answer.

    Both are Student's t distributions with the scatter of the others.
    """
    freedom, ratios = means.size - 2, np.zeros(means.size)
    for k, answer in enumerate(answers):
        others = np.delete(means, k)
        scatter = float(others.std(ddof=1)) * math.sqrt(1.0 + 1.0 / others.size)
        if scatter > 0.0:
            same = float(means[k] - others.mean()) / scatter
            changed = same - answer / scatter
            ratios[k] = 0.5 * (freedom + 1) * math.log((1.0 + changed**2 / freedom) / (1.0 + same**2 / freedom))
    return ratios
