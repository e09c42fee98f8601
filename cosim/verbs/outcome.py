"""Result of a run on the terminal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from cosim.base.errors import CriterionMissed
from cosim.verbs.terminal import MANNER, colour, say, say_json, say_more, show, table, warn

if TYPE_CHECKING:
    from cosim.simulation.workflow import Outcome
    from cosim.storage.results import Results

MAX_SIGNALS = 12  # signals whose values are printed


def say_outcome(
    outcome: Outcome, *, report: bool, open_: bool = False, as_json: bool = False, lines: Sequence[str] = ()
) -> None:
    """Print warnings, `lines`, criteria and files of a run; raise CriterionMissed if a criterion is not met."""
    from cosim.simulation.criteria import sentence
    from cosim.simulation.report.time_rows import time_sentence

    criteria: list[dict[str, Any]] = outcome.manifest["criteria"]
    page = outcome.folder / "report.html"
    warn(*outcome.manifest["warnings"])
    if as_json:
        say_json(_content(outcome))
    else:
        say(*lines)
        say(*(colour(criterion["met"], sentence(criterion)) for criterion in criteria))
        timings = outcome.manifest["timings"]
        speed = f"simulated in {timings['simulate']:.2f} s ({timings['real_time_factor']:.3g} × real time)"
        say_more(f"order: {', '.join(outcome.manifest['order'])}; loaded in {timings['load']:.2f} s, {speed}")
        if times := time_sentence(timings):
            say_more(times)
        say(f"results: {outcome.file}")
        if report:
            say(f"report:  {page}")
    show(page, open_=report and open_)
    if outcome.missed:
        details = ": " + "; ".join(map(sentence, outcome.missed)) if MANNER.quiet or as_json else ""
        counts = {"missed": len(outcome.missed), "count": len(criteria)}
        raise CriterionMissed("{missed} of {count} criteria missed{criteria}".format(**counts, criteria=details))


def say_partial(folder: Path) -> None:
    """Print the files of an incomplete run."""
    from cosim.storage.results import rows_in

    for title, path in (("rows so far:", rows_in(folder)), ("report:     ", folder / "report.html")):
        if path is not None and path.is_file():
            say(f"{title} {path}")


def _content(outcome: Outcome) -> dict[str, Any]:
    """Return the JSON object of a run."""
    folder, results = outcome.folder, outcome.results
    page = folder / "report.html"
    criteria, missed = outcome.manifest["criteria"], bool(outcome.missed)
    return {
        "status": "missed" if missed else outcome.manifest["status"],
        "exit_code": CriterionMissed.exit_code if missed else 0,
        "met": not missed if criteria else None,  # nothing was asked for
        "criteria": criteria,
        "warnings": outcome.manifest["warnings"],
        "rows": len(results.time),
        "end": float(results.time[-1]) if len(results.time) else None,
        "results": str(outcome.file),
        "manifest": str(folder / "manifest.json"),
        "report": str(page) if page.is_file() else None,
    }


def value_lines(results: Results) -> list[str]:
    """Return a line for each signal with first, last, smallest and largest value."""
    if not len(results.time):
        return []
    rows = []
    for name in results.columns[:MAX_SIGNALS]:
        v = results[name]
        rows.append((f"  {name}", results.units.get(name, ""), *(f"{x:.6g}" for x in (v[0], v[-1], v.min(), v.max()))))
    more = [f"  … and {len(results.columns) - MAX_SIGNALS} more signals"] if len(results.columns) > MAX_SIGNALS else []
    return [*table(("  signal", "unit", "first", "last", "least", "largest"), rows), *more]
