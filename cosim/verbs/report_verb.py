"""`cosim report`: write the report of a run again."""

from __future__ import annotations

from pathlib import Path

from cosim.core.errors import InputError
from cosim.files.files import check_writable
from cosim.files.folders import newest_run, warnings_on
from cosim.files.kinds import check_given
from cosim.files.results import rows_in
from cosim.verbs.cli import say, say_json, show, warn

OTHERS = {"refine.json": "refine", "fit.json": "fit", "replay.json": "replay", "comparison.json": "compare"}


def command(folder: Path, *, figures: bool = False, open: bool = False, json: bool = False) -> None:
    """Write the report of a run again from its results.

    Args:
        folder: Folder of a run.
        figures: Write figures/*.png too.

    Example: cosim report results/one --open
    """
    from cosim.simulation.report import write_pages
    from cosim.simulation.run_files import read_ran

    path = newest_run(folder)
    if not path.is_dir():
        check_given(path, "a folder that a run left")
        raise InputError.at(path, "is a file; give the folder with the results of `cosim run`")
    if not (path / "manifest.json").is_file():
        verb = next((v for name, v in OTHERS.items() if (path / name).is_file()), None)
        own = "has no manifest.json; give the folder with the results of `cosim run`"
        other = f"holds no manifest.json; it is of `cosim {verb}`, which writes its page itself"
        raise InputError.at(path, other if verb else own)
    run = read_ran(path)
    if not isinstance(run.manifest.get("scenario"), dict):
        raise InputError.at(
            path / "manifest.json", "is no manifest of a run: there is no scenario in it, or it is torn; run it again"
        )
    if not run.results.time.size:
        raise InputError.at(rows_in(path) or path, "has no rows: the run stopped before its first; run it again")
    check_writable(path, ("report.html",))
    warn(*run.warnings)
    about_rows = [text for text in run.warnings if text not in warnings_on(path)]
    manifest = {**run.manifest, "warnings": [*run.manifest.get("warnings", ()), *about_rows]}
    write_pages(path, run.results, manifest, figures=figures)
    page = path / "report.html"
    say(f"report:  {page}")
    if json:
        say_json({"report": str(page)})
    show(page, open)
