"""Monte Carlo test of the consistency of the base model's estimators, with a table and a page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from cosim.base.errors import Fault, InputError, refuse
from cosim.base.registry import model_entry, resolve
from cosim.base.settings import Count, Seed
from cosim.estimators.consistency import ConsistencyRow, consistency_of
from cosim.estimators.report import page
from cosim.storage.files import check_writable, write_json, write_text
from cosim.storage.folders import check_overwritable, keep_earlier

MIN_RUNS = 2
MIN_STEPS = 100  # errors count after the first second
MAX_SAMPLES = 20_000_000  # samples of all runs of a case: about 400 bytes each, 8 GB in total
RECORD, PAGE = "consistency.json", "report.html"


def consistency(
    runs: Count = 50, steps: Count = 500, seed: Seed = 1, progress: Callable[[int, int], None] | None = None
) -> Sequence[ConsistencyRow]:
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
    bounds = (("runs", runs, MIN_RUNS), ("steps", steps, MIN_STEPS), ("seed", seed, 0))
    refuse(Fault(Path(n), 0, 0, f"is {v}; give {low} or more") for n, v, low in bounds if v < low)
    check_size(runs, steps)
    squares_of, cases = resolve(model_entry().estimators), resolve(model_entry().cases)
    rows = []
    for k, case in enumerate(cases):
        try:
            squares = squares_of(case, runs, steps, np.random.default_rng([seed, k]))
        except MemoryError:
            message = f"there is not enough memory for {runs:,} runs of {steps:,} steps; give fewer"
            raise InputError.at(Path("--runs"), message, exit_code=4) from None
        for name, (values, degrees, at) in squares.items():
            result, flight = consistency_of(values, degrees, white=name != "NEES"), case.flight
            rows.append(ConsistencyRow(case.title, flight.name, flight.doc, name, result, at))
        if progress is not None:
            progress(k + 1, len(cases))
    return rows


def check_size(runs: int, steps: int) -> None:
    """Check that the samples fit into memory.

    Raises:
        InputError: The samples are too many.
    """
    if runs * steps <= MAX_SAMPLES:
        return
    size = {"runs": runs, "steps": steps, "limit": MAX_SAMPLES}
    if MIN_RUNS * steps <= MAX_SAMPLES:
        raise InputError.at(
            Path("--runs"),
            (
                "{runs:,} runs of {steps:,} steps are more than the {limit:,} samples that fit into memory; give "
                "{most:,} at most with {steps:,} steps"
            ).format(**size, most=MAX_SAMPLES // steps),
        )
    raise InputError.at(
        Path("--steps"),
        (
            "{runs:,} runs of {steps:,} steps are more than the {limit:,} samples that fit into memory; give "
            "{most:,} at most"
        ).format(**size, most=MAX_SAMPLES // MIN_RUNS),
    )


def check_folder(folder: Path, *, force: bool = False) -> None:
    """Check and create the output folder.

    Raises:
        InputError: The folder is not writable, or holds results of another command without `force`.
    """
    check_overwritable(folder, "cosim consistency", force=force)
    check_writable(folder, [RECORD, PAGE])


def write(folder: Path, rows: Sequence[ConsistencyRow], steps: int, seed: int, *, report: bool = True) -> None:
    """Write consistency.json and report.html to a folder.

    An earlier result moves to `runs`.
    """
    keep_earlier(folder, "cosim consistency")
    record = {"runs": rows[0].result.runs, "steps": steps, "seed": seed, "rows": [row.as_json() for row in rows]}
    write_json(folder / RECORD, record, indent=1)
    if report:
        write_text(folder / PAGE, page(rows, steps, seed))
