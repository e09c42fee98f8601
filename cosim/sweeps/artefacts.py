"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import SWEEP, TABLE, Artefact

ARTEFACTS = (
    Artefact(
        SWEEP,
        "`cosim sweep {file}` runs it",
        keys=(frozenset({"vary"}),),
        without=frozenset({"components", "connections"}),
        schema="cosim.sweeps.sweep_file:SweepFile",
        schema_name="sweep",
        title="cosim sweep",
        check="cosim.sweeps.reading:check_sweep",
    ),
    Artefact(
        "an answer of `cosim sweep`",
        "`cosim.read` reads its folder in Python; `cosim sweep SWEEP.yaml` makes one",
        keys=(frozenset({"schema_version", "sweep", "runs"}),),
        verb="cosim sweep",
        marks=("sweep.json",),
        unfinished=("runs.sqlite",),
        files=("sweep.json", "sweep.parquet", "runs.sqlite", "report.html"),
        folder="the folder of a sweep",
        folder_step="`cosim.read` reads it in Python",
        reader="cosim.sweeps.store:read_runs",
    ),
    Artefact(
        TABLE,
        "`cosim.read` reads its folder in Python; `cosim sweep SWEEP.yaml` makes one",
        beside=("sweep.parquet", "sweep.parquet"),  # only this name; other Parquet files are logs
    ),
    Artefact(
        "a database",
        "`cosim sweep SWEEP.yaml --resume --out FOLDER` continues the sweep in its folder",
        endings=(".sqlite",),
    ),
)
