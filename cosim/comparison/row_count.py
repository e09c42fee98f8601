"""`cosim rows`: count the rows of a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

from cosim.simulation.run_files import read_ran
from cosim.storage.files import FilePath, atomic_write, check_writable, named_path
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_left, folder_named, keep_earlier

RECORD = "rows.json"


@dataclass(frozen=True)
class RowCount:
    """Number of rows of a run, and the run that they are of."""

    run: str
    rows: int


@folder_locks()
def rows(run: FilePath, out: FilePath | None = None, *, force: bool = False) -> RowCount:
    """Count the rows of a run, the folder of one or a CSV; rows.json is written to `out`, results/NAME-rows without."""
    ran = read_ran(Path(run))
    place = folder_named(ran.name, "rows") if out is None else named_path(out)
    check_left(place, "cosim rows", str(run), force=force, keep=out is None)
    check_writable(place, (RECORD,))
    count = RowCount(str(run), len(ran.results.time))
    if out is None:
        keep_earlier(place, "cosim rows")
    with atomic_write(place / RECORD) as stream:
        json.dump({"schema_version": 1, "run": count.run, "row_count": count.rows}, stream)
    return count


def read_rows(folder: Path) -> RowCount:
    """Return what `cosim rows` wrote to a folder."""
    content = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    return RowCount(content["run"], content["row_count"])
