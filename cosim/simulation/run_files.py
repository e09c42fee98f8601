"""Reading of results by a run, a replay or another tool: a folder, or a CSV file with time in the first column."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.errors import InputError
from cosim.storage.artefact import folder_kind
from cosim.storage.files import FilePath, check_writable
from cosim.storage.folders import manifest_in, newest_run, replay_record, run_name, status_in, warnings_on
from cosim.storage.kinds import LOG, check_given, refuse_folder
from cosim.storage.results import Results, read_results, rows_in
from cosim.storage.table import suffixes

WANTED = "the folder of a run or a table of its rows"


@dataclass(frozen=True)
class RecordedRun:
    """Results read from files, with their path, their name, the manifest if there is one, and warnings on it."""

    path: Path
    name: str
    results: Results
    manifest: Mapping[str, Any] = field(default_factory=dict)
    warnings: tuple[str, ...] = ()

    @property
    def criteria(self) -> list[dict[str, Any]]:
        """Return the evaluated criteria."""
        entries = self.manifest.get("criteria")
        return [c for c in entries if isinstance(c, dict)] if isinstance(entries, list) else []

    def holds(self, name: str) -> bool | None:
        """Return whether a signal holds its value between rows; None if no record says so."""
        if "discrete" not in self.manifest:
            return None
        return name in self.results.whole or name in self.results.exact or name in self.manifest["discrete"]


def read_ran(path: Path) -> RecordedRun:
    """Return results of a path; raise InputError if none, also if they are removed meanwhile."""
    try:
        path = newest_run(path)
        if not path.exists():
            raise InputError.at(path, f"no such folder or file; give {WANTED}")
        if not path.is_dir():
            check_given(path, LOG)
            return RecordedRun(path, path.stem, read_results(path))
        rows = rows_in(path)
        if rows is None:
            kind = folder_kind(path)
            if kind is None or "results" not in kind.tables:
                refuse_folder(path, WANTED)
            names = " or ".join(f"results{suffix}" for suffix in suffixes())
            raise InputError.at(path, f"holds no rows{status_in(path)}: no {names}; give {WANTED}")
        manifest = manifest_in(path)
        units: Any = manifest.get("units") or replay_record(path).get("units") or {}
        results = read_results(rows, units, manifest.get("beside", ()), words=manifest.get("texts", ()))
        return RecordedRun(path, run_name(path), results, manifest, tuple(warnings_on(path)))
    except FileNotFoundError:
        raise InputError.at(
            path, "was removed while it was read; repeat the command with the results that are left"
        ) from None


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
