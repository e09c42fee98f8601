"""Results of a sweep as sentences."""

from __future__ import annotations

import json
import os
import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from cosim.core.text import counted, join_names, plain
from cosim.sweeps.reading import Sweep


@dataclass(frozen=True, repr=False)
class Swept:
    """Result of a sweep.

    Attributes:
        record: Content of sweep.json; of a part its own runs, with its name as `part`.
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
        lines = [headline(r), f"{r['runs'] - r['failed']} of {counted(r['runs'], 'run')} completed{rate}"]
        for c in r["criteria"]:
            low, high = (plain(100.0 * end, 3) for end in c["ci95"])
            share = f"{plain(100.0 * c['met'] / c['of'], 3)} %, 95 % interval {low} … {high} %" if c["of"] else "no run"
            lines.append(f"{c['name']}: met by {c['met']} of {c['of']} ({share})")
        return lines

    def __repr__(self) -> str:
        return "\n  ".join(self.sentences)


def headline(record: Mapping[str, Any]) -> str:
    """Return how many runs meet all criteria, and the criterion that most runs fail."""
    criteria, runs, completed = record["criteria"], record["runs"], record["runs"] - record["failed"]
    if not criteria:
        return f"{completed} of {counted(runs, 'run')} completed; the scenario sets no criteria."
    met, fewest = record["met_all"], hardest(record)["met"]
    all_of = "the criterion" if len(criteria) == 1 else "all criteria"
    if met == runs:
        return f"All {counted(runs, 'run')} meet {all_of}."
    worst = [c["name"] for c in criteria if c["met"] == fewest < c["of"]]
    failed = f"; {counted(completed - fewest, 'run')} failed {join_names(worst)}"
    most = failed if 0 < len(worst) < len(criteria) else ""
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
