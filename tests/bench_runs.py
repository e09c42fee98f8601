"""Protocols of a bench played by plain functions, many runs at once: the same numbers as by the bench's FMU, sooner."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cosim.core.errors import refuse
from cosim.model import Stepper
from cosim.model.namespaces import arrays
from plant.bench import CHANNELS, Bench
from plant.identification.checks import planned_faults
from plant.identification.protocol import Protocol
from plant.identification.protocol import read_protocol as read_file
from plant.identification.recordings import Recording

Play = Callable[[Sequence[Recording]], list[Recording]]


def read_protocol(path: Path) -> Protocol:
    """Read a protocol and check its phases."""
    protocol = read_file(path)
    refuse(planned_faults(protocol))
    return protocol


def play_plain(bench: Bench) -> Play:
    """Return a simulator of runs by plain equations, with equal commands in parallel."""

    def play(runs: Sequence[Recording]) -> list[Recording]:
        groups: dict[tuple[object, ...], list[int]] = {}
        for k, run in enumerate(runs):
            key = (run.duty.tobytes(), run.servo_duty.tobytes(), run.height.tobytes(), run.low_pass)
            groups.setdefault(key, []).append(k)
        recordings: dict[int, Recording] = {}
        for group in groups.values():
            recordings |= zip(group, _play_lanes(bench, [runs[k] for k in group]), strict=True)
        return [recordings[k] for k in range(len(runs))]

    return play


def _play_lanes(bench: Bench, runs: Sequence[Recording]) -> list[Recording]:
    m, first = arrays(), runs[0]
    values = {"thrust_factor": np.array([r.thrust for r in runs]), "filter_time": first.low_pass}
    stepper = Stepper(bench.with_values(values), m)
    noise = np.stack([r.noise for r in runs], axis=2)  # cell, row, lane
    loads = tuple(np.array([r.loads[k] for r in runs]) for k in range(3))
    moment, volts = stepper.start(float(first.time[0])), np.empty((first.time.size, 3, len(runs)))
    step = float(np.median(np.diff(first.time)))
    for k in range(first.time.size):
        before = max(k - 1, 0)
        command = (
            float(first.duty[before]),
            float(first.servo_duty[before]),
            float(first.height[k]),
            *loads,
            *noise[:, k],
        )
        if k:
            moment = stepper.step(moment, command, step)
        volts[k] = stepper.output(moment.t, moment.state, command)[:3]
    return [
        replace(run, volts=dict(zip(CHANNELS, np.ascontiguousarray(volts[:, :, j].T), strict=True)))
        for j, run in enumerate(runs)
    ]
