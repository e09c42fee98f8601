"""FMI version and interface of the FMUs of a run, read from the FMUs themselves: the manifest holds neither."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from cosim.scenario.scenario_file import sha256
from cosim.simulation.report.recorded import Run, mapping
from cosim.storage.archive import BadArchive, description_of

CO_SIMULATION, MODEL_EXCHANGE = "co-simulation", "model exchange"
INTERFACES = {  # element of modelDescription.xml → interface; the last two are those of FMI 1.0
    "CoSimulation": CO_SIMULATION,
    "ModelExchange": MODEL_EXCHANGE,
    "CoSimulation_StandAlone": CO_SIMULATION,
    "CoSimulation_Tool": CO_SIMULATION,
}
CHOSEN = {"co-simulation": CO_SIMULATION, "model-exchange": MODEL_EXCHANGE}  # key of a component → interface
VARIABLES = "ModelVariables"  # element after which FMI 2.0 and 3.0 have no interfaces


def fmi_kinds(run: Run) -> dict[str, str]:
    """Return component → version and interface of the executed FMU, e.g. `FMI 2.0, co-simulation`.

    Components with a missing or changed FMU are omitted.
    """
    kinds = {}
    for name, fmu in mapping(run.manifest.get("fmus")).items():
        chosen = mapping(mapping(run.scenario.get("components")).get(name)).get("interface")
        if text := _kind(mapping(fmu), CHOSEN.get(str(chosen), "")):
            kinds[str(name)] = text
    return kinds


def _kind(fmu: Mapping[str, Any], chosen: str) -> str:
    """Return version and interface of an FMU, "" if unknown."""
    path = Path(str(fmu.get("path") or ""))
    try:
        if not path.is_file() or sha256(path) != fmu.get("sha256"):
            return ""
        version, interfaces = _read_kind(description_of(path))
    except (OSError, ValueError, BadArchive, ET.ParseError):
        return ""
    used = chosen or (CO_SIMULATION if CO_SIMULATION in interfaces else MODEL_EXCHANGE)
    return f"FMI {version}, {used}" if version else ""


def _read_kind(description: bytes) -> tuple[str, set[str]]:
    """Return version and interfaces in a model description."""
    version, interfaces = "", set[str]()
    for _, element in ET.iterparse(BytesIO(description), events=("start",)):
        version = version or element.get("fmiVersion", "")
        if element.tag in INTERFACES:
            interfaces.add(INTERFACES[element.tag])
        if element.tag == VARIABLES and not version.startswith("1"):
            break
    return version, interfaces
