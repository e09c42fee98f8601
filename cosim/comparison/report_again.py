"""Rewriting of the report page of an earlier run from its files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from cosim.base.errors import InputError
from cosim.simulation.run_files import read_ran
from cosim.storage.files import FilePath, check_writable
from cosim.storage.folders import newest_run, warnings_on
from cosim.storage.kinds import check_given
from cosim.storage.results import rows_in


def report_of(folder: FilePath, *, figures: bool = False, tell: Callable[..., None] = lambda *warnings: None) -> Path:
    """Write an earlier run's report.html again.

    The page of a run whose rows were cut says so.

    Args:
        tell: Function that shows warnings on the files.

    Raises:
        InputError: The folder has no run, or a run without rows.
    """
    path = newest_run(Path(folder))
    if not path.is_dir():
        check_given(path, "a folder that a run left")
        raise InputError.at(path, "is a file; give the folder with the results of `cosim run`")
    if not (path / "manifest.json").is_file():
        verbs = {"refine.json": "refine", "fit.json": "fit", "replay.json": "replay", "comparison.json": "compare"}
        verb = next((v for name, v in verbs.items() if (path / name).is_file()), None)
        raise InputError.at(
            path,
            f"holds no manifest.json; it is of `cosim {verb}`, which writes its page itself"
            if verb
            else "has no manifest.json; give the folder with the results of `cosim run`",
        )
    run = read_ran(path)
    if not isinstance(run.manifest.get("scenario"), dict):
        raise InputError.at(
            path / "manifest.json", "is no manifest of a run: there is no scenario in it, or it is torn; run it again"
        )
    if not run.results.time.size:
        raise InputError.at(rows_in(path) or path, "has no rows: the run stopped before its first; run it again")
    check_writable(path, ("report.html",))
    from cosim.simulation.report import write_figures, write_report

    tell(*run.warnings)
    about_rows = [text for text in run.warnings if text not in warnings_on(path)]
    manifest = {**run.manifest, "warnings": [*run.manifest.get("warnings", ()), *about_rows]}
    write_report(path / "report.html", run.results, manifest)
    if figures:
        write_figures(path / "figures", run.results, manifest)
    return path / "report.html"
