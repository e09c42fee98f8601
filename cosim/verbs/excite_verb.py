"""`cosim excite`: design the input that separates rival hypotheses."""

from __future__ import annotations

import shlex
from typing import Any

from cosim.files.folders import name_of, new_run
from cosim.verbs.cli import files_in, progress_bar, say, say_json, show, warn


def command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Design the input that separates rival hypotheses best.

    Writes excitation.csv, excitation.yaml, a scenario that plays the input, and report.html.

    Args:
        text (MODEL): A registered model such as base, a model.yaml, FILE.py:CLASS, an FMU, or a refine.json or its
            folder.
        folder (--out -o PATH): Folder for the results (default: a new number in results/MODEL-excitation).
        against (--against NAME): Effect, sensor error or parameter that is a rival hypothesis.
        limits (--limit NAME=VALUE): Largest distance of an input or output from its start value, for example
            angle=8deg.
        ranges (--range NAME=MIN..MAX): Range of an input, within the bounds of the model.
        measured (NAME): Output that will be logged.
        duration (TIME): Duration of the experiment, for example 90 or 2min (default: 40 s, longer for a slow model).

    Example: cosim excite results/refine --limit angle=8deg
    """
    from cosim.experiment.excite import excite

    run = new_run(
        given["folder"], f"{name_of(given['text'])}-excitation", "cosim excite", force=given["force"], goes_on=True
    )
    with run as place, progress_bar() as progress:
        choice = excite(**{**given, "folder": place}, progress=progress)
    say(choice.headline)
    warn(*choice.warnings)
    say(*choice.sentences)
    files = {"excitation": str(place / "excitation.csv"), "scenario": str(place / "excitation.yaml")}
    say(f"excitation: {files['excitation']}, played by: cosim run {shlex.quote(files['scenario'])}")
    pages = files_in(place)
    say(*(f"report: {page}" for page in pages.values()))
    show(place / "report.html", open)
    if json:
        apart = [{"pair": list(pair), "standard_deviations": distance} for pair, distance in choice.apart.items()]
        say_json({"apart": apart, "warning": "; ".join(choice.warnings), **files, **pages})
