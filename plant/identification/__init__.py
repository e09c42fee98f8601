"""Identification of a power-train on a testing bench from five tests, simulated or measured, and of a craft's logs."""

from __future__ import annotations

from cosim.files.artefact import Artefact

PROTOCOL = "a protocol of a testing bench"
ARTEFACTS = (
    Artefact(
        PROTOCOL,
        "`cosim identify {file}` evaluates it",
        keys=(frozenset({"cells", "tests"}), frozenset({"rest"}), frozenset({"distance"})),
        without=frozenset({"logs"}),
        schema="plant.identification.protocol:ProtocolFile",
        schema_name="protocol",
        title="cosim protocol of a testing bench",
        check="plant.identification.workflow:check_protocol",
    ),
    Artefact(
        "a result of `cosim identify`",
        "read it with a script; the model file in its folder is for `cosim build --model` and studies",
        keys=(frozenset({"schema_version", "estimates"}),),
        verb="cosim identify",
        marks=("identify.json",),
        files=("identify.json", "powertrain.yaml", "model.yaml", "report.html"),
        folder="the folder of an identification",
        folder_step="use its model file with `cosim build --model`",
    ),
)
