"""Monte Carlo consistency test of the base model's estimators, with table and page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.registry import model_entry, resolve
from cosim.base.settings import Count, Seed
from cosim.estimators.consistency import Row, consistency_of
from cosim.estimators.report import page
from cosim.storage.files import check_writable, write_json, write_text
from cosim.storage.folders import check_left, keep_earlier

FEWEST = 2  # runs
SHORTEST = 100  # steps; errors count after the first second
MOST_SAMPLES = 20_000_000  # samples of all runs of a case: about 400 bytes each, 8 GB in total
RECORD, PAGE = "consistency.json", "report.html"


def consistency(
    runs: Count = 50, steps: Count = 500, seed: Seed = 1, progress: Callable[[int, int], None] | None = None
) -> Sequence[Row]:
    """Test the estimators of the base model by Monte Carlo runs.

    Args:
        runs: Number of Monte Carlo runs of each case, at least 2.
        steps: Number of samples of each run, at least 100.
        seed: Seed for all random numbers.
        progress: Function of (completed cases, all cases).

    Returns:
        One row per case and kind of squares (NEES, NIS) with mean, region and verdict.

    Raises:
        InputError: Too few or too many runs or steps, or too little memory.
    """
    least = (("runs", runs, FEWEST), ("steps", steps, SHORTEST), ("seed", seed, 0))
    refuse([Fault(Path(n), 0, 0, f"is {v}; give {low} or more") for n, v, low in least if v < low])
    check_size(runs, steps)
    squares_of = resolve(model_entry().estimators)
    cases = resolve(model_entry().cases)
    found = []
    for k, case in enumerate(cases):
        try:
            squares = squares_of(case, runs, steps, np.random.default_rng([seed, k]))
        except MemoryError:
            said = f"there is not enough memory for {_format_size(runs, steps)}; give fewer"
            raise InputError([Fault(Path("--runs"), 0, 0, said, exit_code=4)]) from None
        for name, (values, degrees, at) in squares.items():
            judged, flight = consistency_of(values, degrees, white=name != "NEES"), case.flight
            found.append(Row(case.title, flight.name, flight.doc, name, judged, at))
        if progress is not None:
            progress(k + 1, len(cases))
    return found


def check_size(runs: int, steps: int) -> None:
    """Check that the samples fit into memory.

    Raises:
        InputError: They do not.
    """
    if runs * steps <= MOST_SAMPLES:
        return
    option, other = ("--runs", steps) if 2 * steps <= MOST_SAMPLES else ("--steps", 2)
    most = f"{_format_size(runs, steps)} are more than the {MOST_SAMPLES:,} samples that fit into memory"
    cure = f"give {MOST_SAMPLES // other:,} at most" + (f" with {steps:,} steps" if option == "--runs" else "")
    raise InputError([Fault(Path(option), 0, 0, f"{most}; {cure}")])


def _format_size(runs: int, steps: int) -> str:
    return f"{runs:,} runs of {steps:,} steps"


def check_folder(folder: Path, *, force: bool = False, keep: bool = False) -> None:
    """Check and create the output folder.

    Raises:
        InputError: The folder is not writable, or holds results of another command without `force`.
    """
    check_left(folder, "cosim consistency", force=force, keep=keep)
    check_writable(folder, [RECORD, PAGE])


def write(folder: Path, rows: Sequence[Row], steps: int, seed: int, *, report: bool = True, keep: bool = False) -> None:
    """Write consistency.json and report.html to a checked folder.

    Args:
        keep: Move an earlier result to `runs`.
    """
    if keep:
        keep_earlier(folder, "cosim consistency")
    record = {"runs": rows[0].result.runs, "steps": steps, "seed": seed, "rows": [row.as_json() for row in rows]}
    write_json(folder / RECORD, record, indent=1)
    if report:
        write_text(folder / PAGE, page(rows, steps, seed))
