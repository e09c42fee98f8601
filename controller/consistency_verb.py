"""`cosim consistency`: test estimators by Monte Carlo runs."""

from __future__ import annotations

from cosim.core.settings import Seed
from cosim.files.files import FilePath, write_json, write_text
from cosim.files.folders import new_run, remove_earlier
from cosim.verbs.cli import progress_bar, say, say_json, show, table

VERB, FILES = "cosim consistency", ("consistency.json", "report.html")


def command(
    *,
    runs: int = 50,
    steps: int = 500,
    seed: Seed = 1,
    out: FilePath | None = None,
    report: bool = True,
    open: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Test the estimators of the hovercraft by Monte Carlo runs.

    Compares the normalised errors (NEES) and innovations (NIS) with their 95 % regions.

    Args:
        runs: Number of Monte Carlo runs of each case, at least 2.
        steps: Number of samples of each run, at least 100.
        seed: Seed for all random numbers.
        out (--out -o PATH): Folder for the results (default: a new number in results/consistency).

    Example: cosim consistency --runs 50 --seed 1
    """
    from controller.consistency import CONSISTENT, check_size, headline, page
    from controller.consistency import consistency as over_runs

    check_size(runs, steps, seed)
    with new_run(out, "consistency", VERB, force=force) as out, progress_bar("estimating") as progress:
        rows = over_runs(runs, steps, seed, progress)
        remove_earlier(out)
        record = {"runs": runs, "steps": steps, "seed": seed, "rows": [row.as_json() for row in rows]}
        write_json(out / FILES[0], record, indent=1)
        if report:
            write_text(out / FILES[1], page(rows, steps, seed))
    show(out / "report.html", open)
    if json:
        say_json([row.as_json() for row in rows])
        return
    say(headline(rows))
    for flight, motion in {row.flight: row.motion for row in rows}.items():
        say(f"{flight}: {motion}")
    header = ("case", "flight", "of", "dof", "mean", "its region", "times above", "below", "at most", "verdict")
    head, *body = table(header, [tuple(row.as_text().values()) for row in rows])
    say(head)
    for row, line in zip(rows, body, strict=True):
        say(line, met=row.result.verdict == CONSISTENT)
    say(f"numbers: {out / 'consistency.json'}" + (f"; report: {out / 'report.html'}" if report else ""))
