"""`cosim compare`: the comparison and its files."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

from cosim.comparison.differences import Compared, compare_runs, is_one_run
from cosim.comparison.several import ComparedRuns, RunSource, compare_several, label_runs
from cosim.core.arrays import far_beyond
from cosim.files.files import FilePath, check_writable, write_json, write_text
from cosim.files.folders import new_run, remove_earlier

FILES = ("comparison.json", "report.html")
LONGEST_NAME, NUMBERED = 80, "run "  # characters of the name of a folder; the beginning of the name of a numbered run


@far_beyond
def compare(
    sources: Sequence[RunSource],
    folder: FilePath | None = None,
    *,
    baseline: int = 0,
    as_pair: bool = False,
    tolerance: float | None = None,
    absolute: float = 0.0,
    report: Callable[[Compared | ComparedRuns], str] | Literal[False] = False,
    write: bool = True,
    force: bool = False,
) -> tuple[Compared | ComparedRuns, Path]:
    """Compare runs with a baseline; write comparison.json and report.html.

    Args:
        baseline: Index of the baseline.
        as_pair: Whether to return the comparison of two runs as `Compared`.
        tolerance: Share of each signal's range in the baseline.
        absolute: Size in the signal's unit, added to the share.
        report: Function that returns the page of the comparison, False for none.
        write: Whether to write files.
        force: Whether `folder` may have files.

    Returns:
        The comparison and its folder, the current one without files.

    Raises:
        InputError: Runs cannot be read, or have no common signal or time.
    """
    ordered = [sources[baseline], *(source for k, source in enumerate(sources) if k != baseline)]
    shorts, paths = [source.short for source in ordered], [source.path for source in ordered]
    comparison: Compared | ComparedRuns
    if as_pair:
        runs = [source.read() for source in ordered]
        if is_one_run(*runs):
            runs = [replace(runs[0], name=shorts[0]), replace(runs[1], name="the same run")]
        elif shorts[0] == shorts[1] or shorts != [run.name for run in runs]:
            labels, _ = label_runs(runs, shorts, [source.longer or source.short for source in ordered])
            runs = [replace(run, name=label) for run, label in zip(runs, labels, strict=True)]
        comparison = compare_runs(runs[0], runs[1], tolerance, absolute)
    else:
        comparison = compare_several(sources, baseline, tolerance, absolute)
    if not write:
        return comparison, Path()
    numbers = [short.removeprefix(NUMBERED) for short in shorts]
    name = f"runs {'-'.join(numbers)}" if all(map(str.isdecimal, numbers)) else " and ".join(shorts)
    if len(name) > LONGEST_NAME:
        name = f"{shorts[0]} and {len(shorts) - 1} others"
    with new_run(folder, name, "cosim compare", force=force) as place:
        check_writable(place, FILES, paths)
        remove_earlier(place, read=paths)
        write_json(place / "comparison.json", comparison.as_json())
        if report:
            write_text(place / "report.html", report(comparison))
    return comparison, place
