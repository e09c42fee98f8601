"""Results of a sweep as sentences, and differences between two ways of running."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cosim.base.arrays import Array
from cosim.base.messages import Message
from cosim.base.text import counted, join_names, plain
from cosim.sweeps import messages
from cosim.sweeps.reading import Sweep
from cosim.sweeps.run_chunks import RunResult

EQUAL = 1e-9  # largest allowed difference relative to max(1, largest value)


@dataclass(frozen=True, repr=False)
class Swept:
    """Result of a sweep.

    Attributes:
        record: Content of sweep.json.
        made: Number of runs of this call.
    """

    sweep: Sweep
    folder: Path
    record: Mapping[str, Any]
    made: int

    @property
    def sentences(self) -> list[str]:
        """Results in words, one line each."""
        r = self.record
        rate = f", {r['runs_a_second']:.3g} runs a second" if r["runs_a_second"] else ""
        completed = f"{r['runs'] - r['failed']} of {counted(r['runs'], 'run')} completed"
        lines = [headline(r), f"{completed}, {way_of(r)}{rate}"]
        lines += [f"{c['name']}: met by {c['met']} of {c['of']} ({_interval(c)})" for c in r["criteria"]]
        return [*lines, self.check]

    def __repr__(self) -> str:
        return "\n  ".join(self.sentences)

    @property
    def check(self) -> Message:
        """Result of the comparison with runs through the FMUs; a warning if they disagree or were not compared."""
        check = self.record["check"]
        if self.record["way"] == "fmus":
            return Message(check["sentence"], messages.ALL_THROUGH_FMUS.code)
        if "agrees" in check:
            agrees = check["agrees"]
        elif "apart" in check:  # a sweep of an earlier version; None is an infinite difference
            agrees = check["apart"] is not None and check["apart"] <= EQUAL
        else:
            return "this sweep does not record whether its runs were repeated through the FMUs; --force begins anew"
        return Message(check["sentence"], (messages.ARRAYS_AGREE if agrees else messages.ARRAYS_DISAGREE).code)


def headline(record: Mapping[str, Any]) -> str:
    """Return how many runs meet all criteria, and the criterion that most runs fail."""
    criteria, runs, completed = record["criteria"], record["runs"], record["runs"] - record["failed"]
    if not criteria:
        return f"{completed} of {counted(runs, 'run')} completed; the scenario sets no criteria."
    met, fewest = record.get("met_all"), hardest(record)["met"]
    if met is None:  # a sweep of an earlier version
        met = min(c["met"] for c in criteria)
    all_of = "the criterion" if len(criteria) == 1 else "all criteria"
    if met == runs:
        return f"All {counted(runs, 'run')} meet {all_of}."
    worst = [c["name"] for c in criteria if c["met"] == fewest < c["of"]]
    most = f"; fewest, {fewest}, meet {join_names(worst)}" if 0 < len(worst) < len(criteria) else ""
    return f"{met} of {counted(runs, 'run')} {'meets' if met == 1 else 'meet'} {all_of}{most}."


def hardest(record: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the criterion that the fewest runs meet."""
    criteria: list[Mapping[str, Any]] = record["criteria"]
    return min(criteria, key=lambda c: c["met"])


def repeat_command(study: Sweep, run: int) -> str:
    """Return the command that makes a run of a sweep by itself."""
    request = study.request_run(run)
    starts = [
        f"components.{component}.start.{name}={json.dumps(value)}"
        for component, values in request.starts.items()
        for name, value in values.items()
    ]
    words = ["cosim", "run", os.path.normpath(study.yaml.path.parent / study.file.scenario)]
    words += [word for text in (*study.job.overrides, *request.overrides, *starts) for word in ("--set", text)]
    return shlex.join([*words, *(["--seed", str(request.seed)] if request.seed is not None else [])])


def way_of(record: Mapping[str, Any]) -> str:
    """Return a phrase for the way of running, perhaps mixed."""
    through, runs = record["through_fmus"], record["runs"]
    if not has_array_runs(record):
        return "through the FMUs"
    together = "from the FMUs' equations"
    return together if not through else f"{runs - through} {together} and {through} through the FMUs"


def has_array_runs(record: Mapping[str, Any]) -> bool:
    """Return whether runs were computed on arrays."""
    return bool(record["way"] == "arrays" and record["through_fmus"] < record["runs"])


def way_sentence(record: Mapping[str, Any]) -> str:
    """Explain the way of running; "" if all runs went through the FMUs."""
    if not has_array_runs(record):
        return ""
    text = "For speed, the runs were computed from the FMUs' equations, many at once, without calling the FMUs."
    through = record["through_fmus"]
    rest = f" {counted(through, 'run')} could not, and went through the FMUs." if through else ""
    check = str(record["check"]["sentence"])
    return f"{text}{rest} As a check, {check}."


def _interval(criterion: Mapping[str, Any]) -> str:
    if not criterion["of"]:
        return "no run"
    part = 100.0 * criterion["met"] / criterion["of"]
    low, high = (100.0 * end for end in criterion["ci95"])
    return f"{plain(part, 3)} %, 95 % interval {plain(low, 3)} … {plain(high, 3)} %"


def criterion_names(study: Sweep) -> list[str]:
    """Return unique names of the criteria for table columns."""
    names: list[str] = []
    for kind, _, goal in study.scenario.goals:
        ends = (("after", goal.after), ("until", goal.until))
        window = "".join(f" {word} {at:g} s" for word, at in ends if at)
        name = f"{kind.replace('_', ' ')} of {goal.of}{window}"
        same = sum(n == name or n.startswith(f"{name} (") for n in names)
        names.append(f"{name} ({same + 1})" if same else name)
    return names


def largest_difference(one: RunResult, other: RunResult) -> float:
    """Return the largest difference of signals and criterion values.

    Differences are relative to max(1, largest value).
    """
    if one.status != "ok" or other.status != "ok":
        return 0.0 if (one.status == "ok") == (other.status == "ok") else float("inf")
    if one.signals.shape != other.signals.shape:
        return float("inf")
    pairs = [*zip(one.signals, other.signals, strict=True)]
    pairs += [(np.array([a]), np.array([b])) for a, b in zip(one.values, other.values, strict=True)]
    return max((_relative_difference(a, b) for a, b in pairs), default=0.0)


def _relative_difference(a: Array, b: Array) -> float:
    if not np.array_equal(np.isfinite(a), np.isfinite(b)):
        return float("inf")
    a, b = a[np.isfinite(a)], b[np.isfinite(b)]
    return float(np.max(np.abs(a - b)) / max(1.0, float(np.max(np.abs(b))))) if a.size else 0.0
