"""Reading of results by a run, a replay or another tool: a folder, or a CSV file with time in the first column."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.core.errors import InputError
from cosim.files.artefact import LOG, folder_kind
from cosim.files.folders import manifest_in, newest_run, replay_record, run_name, status_in, warnings_on
from cosim.files.kinds import check_given, refuse_folder
from cosim.files.results import Results, read_results, rows_in
from cosim.files.table import suffixes

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
