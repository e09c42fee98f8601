"""Commands `identify` and `consistency`, which the worked example adds to cosim."""

from __future__ import annotations

from pathlib import Path

from cosim.core.settings import Seed
from cosim.files.files import FilePath, write_json, write_text
from cosim.files.folders import new_run, remove_earlier
from cosim.verbs.cli import files_in, progress_bar, say, say_json, show, table, warn


def identify_command(
    protocol: Path,
    *,
    out: FilePath | None = None,
    seed: Seed | None = None,
    report: bool = True,
    open: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Identify a power-train, or noise and friction of a craft.

    The protocol names a bench or its recordings, or logs of a craft.
    Writes identify.json, powertrain.yaml or model.yaml, and report.html.

    Args:
        protocol: A protocol: tests on a bench or recordings of them, or logs of a craft.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the protocol).
        seed: Seed for the noise of a simulated bench (default: the seed of the protocol).

    Example: cosim identify examples/bench/protocol.yaml
    """
    from plant.identification.workflow import identify as identify_bench

    with progress_bar() as progress:
        outcome = identify_bench(protocol, out, progress, report=report, seed=seed, force=force)
    place = outcome.model_file.parent
    warn(*outcome.warnings)
    say(*outcome.sentences, outcome.closing)
    if report:
        say(f"report: {place / 'report.html'}")
    if json:
        texts = {"sentences": list(outcome.sentences), "closing": outcome.closing, "warnings": outcome.warnings}
        say_json({**texts, **files_in(place, "identify.json", "powertrain.yaml", "model.yaml")})
    show(place / "report.html", open)


def consistency_command(
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
    with new_run(out, "consistency", "cosim consistency", force=force) as out, progress_bar("estimating") as progress:
        rows = over_runs(runs, steps, seed, progress)
        remove_earlier(out)
        record = {"runs": runs, "steps": steps, "seed": seed, "rows": [row.as_json() for row in rows]}
        write_json(out / "consistency.json", record, indent=1)
        if report:
            write_text(out / "report.html", page(rows, steps, seed))
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
