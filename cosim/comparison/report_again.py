"""The page of an earlier run, written again."""

from __future__ import annotations

from pathlib import Path

from cosim.base.errors import Fault, InputError
from cosim.simulation.run_files import read_ran
from cosim.storage.files import FilePath, check_writable
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import refuse_links
from cosim.storage.kinds import check_given
from cosim.storage.results import rows_in


@folder_locks()
def report_of(folder: FilePath, *, figures: bool = False) -> Path:
    """Write report.html of an earlier run again.

    Raises:
        InputError: The folder has no run, or a run without rows.
    """
    path = Path(folder)
    if not path.is_dir():
        check_given(path, "a folder that a run left")
        raise InputError([Fault(path, 0, 0, "is a file; give the folder that `cosim run` left")])
    if not (path / "manifest.json").is_file():
        again = {"refine.json": "refine", "replay.json": "replay", "comparison.json": "compare"}
        verb = next((v for name, v in again.items() if (path / name).is_file()), None)
        cure = (
            f"it is of `cosim {verb}`, which writes its page itself"
            if verb
            else "give the folder that `cosim run` left"
        )
        raise InputError([Fault(path, 0, 0, f"holds no manifest.json; {cure}")])
    ran = read_ran(path)
    if not isinstance(ran.manifest.get("scenario"), dict):
        told = "is no manifest of a run: there is no scenario in it, or it is torn; run it again"
        raise InputError([Fault(path / "manifest.json", 0, 0, told)])
    if not ran.results.time.size:
        raise InputError(
            [Fault(rows_in(path) or path, 0, 0, "has no rows: the run stopped before its first; run it again")]
        )
    refuse_links(path)
    check_writable(path, ("report.html",))
    from cosim.simulation.report import write_figures, write_report

    write_report(path / "report.html", ran.results, ran.manifest)
    if figures:
        write_figures(path / "figures", ran.results, ran.manifest)
    return path / "report.html"
