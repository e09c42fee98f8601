"""Replays of every variant on every set of logs, through a fast replayer if equal to the delivered object.

The delivered object replays a log for comparison. If the results differ, or no fast replayer exists, the delivered
object replays every log, and the record states this.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from cosim.core.errors import InputError
from cosim.core.text import plain
from cosim.estimation.problem import Problem
from cosim.estimation.subject.interface import Replayer, Subject, Workplace
from cosim.logs.log import Log
from cosim.refinement.proof.measure import ReplayedLogs, Variant, replay_logs
from cosim.refinement.record import OTHER_HORIZONS, Part, Replayed, Replays
from cosim.residuals.windows import Replay

EQUAL = 1e-9  # largest difference of fast replays from those of the delivered object, relative to max(1, largest value)
LogSets = Mapping[Part, Sequence[Log]]


def replay_variants(
    variants: Mapping[str, Variant], problem: Problem, sets: LogSets, place: Workplace
) -> tuple[Replayed, Replays]:
    """Replay every variant on every set of logs; return the replays and the FMU used."""

    def replay_all(replayer_of: Callable[[Subject], Replayer]) -> Replayed:
        done: dict[int, dict[Part, dict[float, ReplayedLogs]]] = {}
        for variant in variants.values():
            if id(variant) not in done:  # one that stands twice is replayed once
                source = variant, replayer_of(variant.subject), problem
                horizons = list(OTHER_HORIZONS.values())
                done[id(variant)] = {part: replay_logs(*source, logs, horizons) for part, logs in sets.items()}
        return {name: done[id(variant)] for name, variant in variants.items()}

    def replay_delivered() -> Replayed:
        return replay_all(lambda subject: subject.replayer(place))

    after = variants["after"]
    own = after.subject.replayer(place)
    ways, why = dict[int, Replayer](), ""
    subjects = {id(v.subject): v.subject for v in variants.values()}
    try:
        ways = {key: way for key, s in subjects.items() if (way := s.quick_replayer(place)) is not None}
    except InputError as error:
        why = error.faults[0].message
    if len(ways) < len(subjects):
        return replay_delivered(), Replays(through=own.through, why=why)
    played = replay_all(lambda subject: ways[id(subject)])
    part: Part = "validation" if "validation" in sets else "estimation"
    k, log = min(enumerate(sets[part]), key=lambda entry: entry[1].rows)
    horizon, name = after.subject.horizon, log.path.name
    replay = replay_logs(after, own, problem, [log])[horizon][0][1]
    apart = difference(played["after"][part][horizon][k][1], replay)
    if apart <= EQUAL:
        return played, Replays(through=ways[id(after.subject)].through, log=name, apart=apart)
    why = f"replays of {name} through it and through plant.fmu are {plain(apart, 2)} apart"
    finite = apart if math.isfinite(apart) else None
    return replay_delivered(), Replays(through=own.through, why=why, log=name, apart=finite)


def difference(one: Replay, other: Replay) -> float:
    """Return the largest relative difference of outputs, possibly infinite."""
    largest = 0.0
    for name, values in one.outputs.items():
        others, rows = other.outputs[name], np.isfinite(other.outputs[name])
        if not np.array_equal(rows, np.isfinite(values)):
            return float("inf")
        apart = np.max(np.abs(values[rows] - others[rows]), initial=0.0)
        largest = max(largest, float(apart) / float(np.max(np.abs(others[rows]), initial=1.0)))
    return largest
