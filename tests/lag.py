"""A first-order lag as an FMU of C, T·dy/dt = gain·u + bias − y by Euler's rule: what SSPs of the tests are made of."""

from __future__ import annotations

import zipfile
from collections.abc import Mapping
from pathlib import Path

from tests.compiled import library, pack

DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="lag" guid="lag" generationTool="tests" numberOfEventIndicators="0">
  <CoSimulation modelIdentifier="lag" canHandleVariableCommunicationStepSize="true" canGetAndSetFMUstate="true"/>
  <UnitDefinitions>
    <Unit name="rad"><BaseUnit rad="1"/></Unit><Unit name="deg"><BaseUnit rad="1" factor="0.017453292519943295"/></Unit>
    <Unit name="s"><BaseUnit s="1"/></Unit><Unit name="m"><BaseUnit m="1"/></Unit>
  </UnitDefinitions>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="UNIT_IN"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="1" causality="output" initial="exact">
      <Real start="0" unit="UNIT_OUT"/></ScalarVariable>
    <ScalarVariable name="gain" valueReference="2" causality="parameter" variability="tunable">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="bias" valueReference="3" causality="parameter" variability="tunable">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="T" valueReference="4" causality="parameter" variability="tunable">
      <Real start="1" unit="s"/></ScalarVariable>
    <ScalarVariable name="stuck" valueReference="0" causality="parameter" variability="tunable">
      <Boolean start="false"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2" dependencies=""/></Outputs></ModelStructure>
</fmiModelDescription>
"""
HEAD = """<?xml version="1.0" encoding="UTF-8"?>
<ssd:SystemStructureDescription name="lags" version="1.0"
    xmlns:ssd="http://ssp-standard.org/SSP1/SystemStructureDescription"
    xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"
    xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
    xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping">
"""


def lag_fmu(path: Path, units: tuple[str, str] = ("", "")) -> Path:
    """Return the FMU; `units` of u and y."""
    text = DESCRIPTION
    for mark, unit in zip(("UNIT_IN", "UNIT_OUT"), units, strict=True):
        text = text.replace(f' unit="{mark}"', f' unit="{unit}"' if unit else "")
    return pack(path, text, library(Path(__file__).with_name("lag.c"), "-ffp-contract=off"))


def ssp(path: Path, system: str, files: Mapping[str, str | Path], experiment: str = "") -> Path:
    """Return an SSP from a system's XML and files, each given as text or path."""
    given = experiment or '<ssd:DefaultExperiment startTime="0" stopTime="2"/>'
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("SystemStructure.ssd", f"{HEAD}{system}\n{given}\n</ssd:SystemStructureDescription>\n")
        for name, content in files.items():
            archive.writestr(name, content.read_bytes() if isinstance(content, Path) else content)
    return path


def component(name: str, fmu: str = "lag.fmu", inside: str = "", units: tuple[str, str] = ("", "")) -> str:
    """Return the XML of a component with its connectors, units of u and y if given, and further content."""
    reals = [f'<ssc:Real unit="{unit}"/>' if unit else "<ssc:Real/>" for unit in units]
    return f"""<ssd:Component name="{name}" type="application/x-fmu-sharedlibrary" source="resources/{fmu}">
<ssd:Connectors><ssd:Connector name="u" kind="input">{reals[0]}</ssd:Connector>
<ssd:Connector name="y" kind="output">{reals[1]}</ssd:Connector></ssd:Connectors>{inside}</ssd:Component>"""


def connection(start: str, end: str, inside: str = "", **attributes: str) -> str:
    """A connection `element.connector` to another; without an element, of the system itself."""
    ends = {}
    for side, text in (("start", start), ("end", end)):
        element, _, connector = text.rpartition(".")
        ends |= {f"{side}Element": element} if element else {}
        ends[f"{side}Connector"] = connector
    written = " ".join(f'{key}="{value}"' for key, value in {**ends, **attributes}.items())
    return f"<ssd:Connection {written}>{inside}</ssd:Connection>"


def bound(values: Mapping[str, str], inside: str = "", **attributes: str) -> str:
    """Return the XML of a parameter binding, from name → XML of the value."""
    written = "".join(f' {key}="{value}"' for key, value in attributes.items())
    each = "".join(f'<ssv:Parameter name="{name}">{value}</ssv:Parameter>' for name, value in values.items())
    return f"""<ssd:ParameterBinding{written}><ssd:ParameterValues><ssv:ParameterSet version="1.0" name="start">
<ssv:Parameters>{each}</ssv:Parameters></ssv:ParameterSet></ssd:ParameterValues>{inside}</ssd:ParameterBinding>"""


def real(value: float, unit: str = "") -> str:
    return f'<ssv:Real value="{value!r}"' + (f' unit="{unit}"/>' if unit else "/>")
