"""Kinds of files of this room."""

from __future__ import annotations

from cosim.files.artefact import FMU, LOG, MANIFEST, RESULTS, SCENARIO, SSP, Artefact

ARTEFACTS = (
    Artefact(
        SCENARIO,
        "`cosim run {file}` runs it",
        keys=(frozenset({"components"}), frozenset({"connections"})),
        schema="cosim.scenario.scenario:Scenario",
        schema_name="scenario",
        title="cosim scenario",
        check="cosim.simulation.trial:check_scenario",
    ),
    Artefact(
        MANIFEST,
        "`cosim run {file}` repeats its run",
        keys=tuple(frozenset({"scenario", key}) for key in ("schema_version", "cosim_version", "status")),
        verb="cosim run",
        marks=("manifest.json",),
        unfinished=("checkpoint/run.json",),
        files=("manifest.json", "report.html", "system/*", "checkpoint/*"),
        tables=("results",),
        folder="the folder of a run",
        folder_step="`cosim report {file}` writes its page again, `cosim compare {file} OTHER` compares two runs",
        check="cosim.simulation.trial:check_scenario",
        reader="cosim.simulation.run_signals:read_run",
    ),
    Artefact(
        RESULTS,
        "`cosim compare {file} OTHER` compares it with another, `cosim replay {file} --fmu FMU --column "
        "COMPONENT.INPUT=INPUT` drives an FMU with it, a --column for each name",
        beside=("results.csv", "manifest.json"),
        taken_as=LOG,
    ),
    Artefact(
        FMU,
        "`cosim info {file}` lists its variables, `cosim simulate {file}` runs it, `cosim check` checks it, "
        "a scenario names it as fmu:, `cosim replay LOG.csv --fmu` drives it",
        endings=(".fmu",),
        member="modelDescription.xml",
        check="cosim.simulation.trial:check_fmu",
    ),
    Artefact(
        SSP,
        "`cosim run {file}` runs it",
        endings=(".ssp", ".ssd"),
        member="SystemStructure.ssd",
        check="cosim.simulation.trial:check_ssp",
    ),
)
