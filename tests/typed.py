"""FMUs of C that pass every type through, compiled once a session."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

from tests.corpus.inputs import FMU_SOURCES
from tests.deeds import compiled

FOLDERS = {2: "linux64", 3: "x86_64-linux"}
TYPED2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="typed" guid="g" generationTool="tests" numberOfEventIndicators="1">
  <ModelExchange modelIdentifier="typed"/>
  <CoSimulation modelIdentifier="typed" canHandleVariableCommunicationStepSize="true"/>
  <UnitDefinitions>
    <Unit name="rpm"><BaseUnit s="-1" rad="1" factor="0.10471975511965977"/></Unit>
    <Unit name="rad/s"><BaseUnit s="-1" rad="1"/></Unit>
    <Unit name="m"><BaseUnit m="1"/></Unit>
  </UnitDefinitions>
  <TypeDefinitions><SimpleType name="Gear"><Enumeration>
    <Item name="first" value="1"/><Item name="second" value="2"/></Enumeration></SimpleType></TypeDefinitions>
  <DefaultExperiment tolerance="0.003"/>
  <ModelVariables>
    <ScalarVariable name="r_in" valueReference="0" causality="input"><Real start="0" unit="IN"/></ScalarVariable>
    <ScalarVariable name="r_out" valueReference="1" causality="output"><Real unit="OUT"/></ScalarVariable>
    <ScalarVariable name="late" valueReference="2" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="told" valueReference="3" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="gain" valueReference="4" causality="parameter" variability="tunable">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="h" valueReference="5" causality="output" initial="exact">
      <Real start="1" unit="m"/></ScalarVariable>
    <ScalarVariable name="v" valueReference="6" causality="local" initial="exact"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="der(h)" valueReference="7" causality="local"><Real derivative="6"/></ScalarVariable>
    <ScalarVariable name="der(v)" valueReference="8" causality="local"><Real derivative="7"/></ScalarVariable>
    <ScalarVariable name="warn_at" valueReference="9" causality="parameter" variability="fixed">
      <Real start="1e9"/></ScalarVariable>
    <ScalarVariable name="end_at" valueReference="10" causality="parameter" variability="fixed">
      <Real start="1e9"/></ScalarVariable>
    <ScalarVariable name="i_in" valueReference="0" causality="input" variability="discrete">
      <Integer start="0"/></ScalarVariable>
    <ScalarVariable name="i_out" valueReference="1" causality="output" variability="discrete">
      <Integer/></ScalarVariable>
    <ScalarVariable name="e_in" valueReference="2" causality="input" variability="discrete">
      <Enumeration declaredType="Gear" start="1"/></ScalarVariable>
    <ScalarVariable name="e_out" valueReference="3" causality="output" variability="discrete">
      <Enumeration declaredType="Gear"/></ScalarVariable>
    <ScalarVariable name="b_in" valueReference="0" causality="input" variability="discrete">
      <Boolean start="false"/></ScalarVariable>
    <ScalarVariable name="b_out" valueReference="1" causality="output" variability="discrete">
      <Boolean/></ScalarVariable>
    <ScalarVariable name="s_in" valueReference="0" causality="input" variability="discrete">
      <String start=""/></ScalarVariable>
    <ScalarVariable name="s_out" valueReference="1" causality="output" variability="discrete"><String/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="2" dependencies="1"/><Unknown index="3" dependencies=""/>
      <Unknown index="4" dependencies=""/>
      <Unknown index="6" dependencies=""/><Unknown index="13" dependencies="12"/><Unknown index="15" dependencies="14"/>
      <Unknown index="17" dependencies="16"/><Unknown index="19" dependencies="18"/></Outputs>
    <Derivatives><Unknown index="8"/><Unknown index="9"/></Derivatives>
  </ModelStructure>
</fmiModelDescription>
"""
TYPED3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="typed" instantiationToken="g" generationTool="tests">
  <CoSimulation modelIdentifier="typed" canHandleVariableCommunicationStepSize="true"/>
  <ModelVariables>
    <Float64 name="a" valueReference="1" causality="input" start="1 2 3 4">
      <Dimension start="2"/><Dimension start="2"/></Float64>
    <Float64 name="twice" valueReference="2" causality="output"><Dimension start="2"/><Dimension start="2"/></Float64>
    <Int64 name="n" valueReference="3" causality="input" start="0"/>
    <Int64 name="next" valueReference="4" causality="output"/>
    <UInt8 name="byte" valueReference="5" causality="input" start="0"/>
    <UInt8 name="byte_out" valueReference="6" causality="output"/>
    <String name="s" valueReference="7" causality="input"><Start value=""/></String>
    <String name="s_out" valueReference="8" causality="output"/>
    <Binary name="raw" valueReference="9" causality="input"><Start value=""/></Binary>
    <Binary name="raw_out" valueReference="10" causality="output"/>
    <Float32 name="f" valueReference="11" causality="input" start="0"/>
    <Float32 name="square" valueReference="12" causality="output"/>
  </ModelVariables>
  <ModelStructure>
    <Output valueReference="2" dependencies=""/><Output valueReference="4" dependencies=""/>
    <Output valueReference="6" dependencies=""/><Output valueReference="8" dependencies=""/>
    <Output valueReference="10" dependencies=""/>
  </ModelStructure>
</fmiModelDescription>
"""


def typed_fmu(
    folder: Path, version: int = 2, name: str = "typed", *, units: tuple[str, str] = ("", ""), **replaced: str
) -> Path:
    """The FMU; `units` of r_in and r_out, and further texts of the description replaced."""
    text = TYPED2 if version == 2 else TYPED3
    for mark, unit in zip(("IN", "OUT"), units, strict=True):
        text = text.replace(f' unit="{mark}"', f' unit="{unit}"' if unit else "")
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / f"{name}.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        library = compiled(FMU_SOURCES / f"typed{version}.c", "-O1")
        archive.write(library, f"binaries/{FOLDERS[version]}/typed.so")
    return path


def numbers_fmu(folder: Path) -> Path:
    """Return an FMU of FMI 3.0 without variables outside the row of doubles."""
    dropped = [line + "\n" for line in TYPED3.splitlines() if re.search("Int64|String|Binary", line)]
    dropped += [f'<Output valueReference="{k}" dependencies=""/>' for k in (4, 8, 10)]
    replaced: dict[str, Any] = dict.fromkeys(dropped, "")
    return typed_fmu(folder, 3, **replaced)
