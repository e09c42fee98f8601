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
from plant.identification.cells import calibrate
from plant.identification.checks import planned_faults
from plant.identification.estimates import Result
from plant.identification.protocol import Protocol
from plant.identification.protocol import read_protocol as read_file
from plant.identification.recordings import Recording, load_runs, runs_of
from plant.identification.workflow import analyse

LANES = 1000  # simultaneous runs
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
            for first in range(0, len(group), LANES):
                chosen = group[first : first + LANES]
                for k, recording in zip(chosen, _play_lanes(bench, [runs[k] for k in chosen]), strict=True):
                    recordings[k] = recording
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


def simulate_seeds(protocol: Protocol, play: Play, seeds: Sequence[int]) -> list[list[Result]]:
    """Return whole protocols, one per seed, from plain functions without figures; equal runs share a simulation."""
    names = [name for name, _ in protocol.file.tests.named_tests()]
    loads = _play_groups(play, [load_runs(protocol, seed) for seed in seeds])
    tests = _play_groups(play, [{name: runs_of(protocol, name, seed) for name in names} for seed in seeds])
    outcomes = []
    for hung, recordings in zip(loads, tests, strict=True):
        cells = calibrate(protocol, hung)
        outcomes.append(analyse(protocol, cells, recordings))
    return outcomes


def _play_groups(play: Play, groups: Sequence[dict[str, list[Recording]]]) -> list[dict[str, list[Recording]]]:
    """Return the recordings of each group by name; equal names of all groups are simulated together."""
    recordings: list[dict[str, list[Recording]]] = [{} for _ in groups]
    for name in groups[0]:
        batch = iter(play([run for group in groups for run in group[name]]))
        for group, own in zip(groups, recordings, strict=True):
            own[name] = [next(batch) for _ in group[name]]
    return recordings
