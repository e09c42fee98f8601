"""FMUs of C whose values have a meaning beyond their numbers: aliases, units, exact types, bytes of a bus."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tests.deeds import compiled

ALIASES = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="m" modelIdentifier="meaning" guid="g" numberOfContinuousStates="1"
    numberOfEventIndicators="0">
  <DefaultExperiment startTime="0" stopTime="1"/>
  <ModelVariables>
    <ScalarVariable name="x" valueReference="0" causality="output"><Real start="0" fixed="true"/></ScalarVariable>
    <ScalarVariable name="minus_x" valueReference="0" causality="output" alias="negatedAlias"><Real/></ScalarVariable>
    <ScalarVariable name="minus_u" valueReference="1" causality="input" alias="negatedAlias">
      <Real start="-3"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="2" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="minus_y" valueReference="2" causality="output" alias="negatedAlias"><Real/></ScalarVariable>
    <ScalarVariable name="i" valueReference="0" causality="output"><Integer/></ScalarVariable>
    <ScalarVariable name="minus_i" valueReference="0" causality="input" alias="negatedAlias">
      <Integer start="-7"/></ScalarVariable>
    <ScalarVariable name="b" valueReference="0" causality="output"><Boolean/></ScalarVariable>
    <ScalarVariable name="not_b" valueReference="0" causality="input" alias="negatedAlias">
      <Boolean start="false"/></ScalarVariable>
  </ModelVariables>
</fmiModelDescription>
"""
UNITS = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="g">
  <CoSimulation modelIdentifier="meaning" canHandleVariableCommunicationStepSize="true"/>
  <UnitDefinitions>DEFINITIONS</UnitDefinitions>
  <DefaultExperiment startTime="0" stopTime="2" stepSize="0.1"/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="0" unit="UNIT_IN"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="1" causality="output"><Real unit="UNIT_OUT"/></ScalarVariable>
    <ScalarVariable name="gain" valueReference="2" causality="parameter" variability="tunable">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="at" valueReference="3" causality="parameter" variability="fixed">
      <Real start="1"/></ScalarVariable>
    <ScalarVariable name="held" valueReference="4" causality="output" variability="discrete"><Real/></ScalarVariable>
    <ScalarVariable name="on" valueReference="0" causality="output" variability="discrete"><Boolean/></ScalarVariable>
    <ScalarVariable name="n" valueReference="0" causality="output" variability="discrete"><Integer/></ScalarVariable>
    <ScalarVariable name="says" valueReference="1" causality="parameter" variability="fixed">
      <Integer start="0"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="2" dependencies="1"/><Unknown index="5" dependencies=""/>
      <Unknown index="6" dependencies=""/><Unknown index="7" dependencies=""/></Outputs>
    <InitialUnknowns><Unknown index="2"/><Unknown index="5"/><Unknown index="6"/><Unknown index="7"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""
EXACT = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="m" instantiationToken="g">
  <CoSimulation modelIdentifier="meaning" canHandleVariableCommunicationStepSize="true"/>
  <UnitDefinitions><Unit name="L/100km"><BaseUnit m="2" factor="1e-8"/>
    <DisplayUnit name="mpg" inverse="true" factor="235.214583"/><DisplayUnit name="mL/km" factor="10"/></Unit>
  </UnitDefinitions>
  <DefaultExperiment startTime="0" stopTime="1" stepSize="0.1"/>
  <ModelVariables>
    <Float64 name="r" valueReference="1" causality="input" unit="L/100km" start="5"/>
    <Float64 name="r_out" valueReference="2" causality="output" unit="L/100km"/>
    <Int64 name="i" valueReference="3" causality="input" start="-9007199254740993"/>
    <Int64 name="i_out" valueReference="4" causality="output"/>
    <UInt64 name="n" valueReference="5" causality="input" start="18446744073709551615"/>
    <UInt64 name="n_out" valueReference="6" causality="output"/>
    <Boolean name="b" valueReference="7" causality="input" start="true"/>
    <Boolean name="b_out" valueReference="8" causality="output"/>
    <String name="s" valueReference="9" causality="input"><Start value="000"/></String>
    <String name="s_out" valueReference="10" causality="output"/>
    <Binary name="raw" valueReference="11" causality="input"><Start value="0a"/></Binary>
    <Binary name="raw_out" valueReference="12" causality="output"/>
  </ModelVariables>
  <ModelStructure>OUTPUTS</ModelStructure>
</fmiModelDescription>
"""
NODE = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="node" instantiationToken="">
  <CoSimulation modelIdentifier="meaning" canHandleVariableCommunicationStepSize="true" hasEventMode="true"/>
  <DefaultExperiment startTime="0" stepSize="0.1"/>
  <ModelVariables>
    <Binary name="rx" valueReference="1" causality="input" variability="discrete" clocks="3"><Start value=""/></Binary>
    <Binary name="tx" valueReference="2" causality="output" variability="discrete" clocks="4"/>
    <Clock name="rx_clock" valueReference="3" causality="input" intervalVariability="triggered"/>
    <Clock name="tx_clock" valueReference="4" causality="output" intervalVariability="triggered"/>
    <Int32 name="arrived" valueReference="5" causality="output"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="2"/><Output valueReference="4"/><Output valueReference="5"/></ModelStructure>
</fmiModelDescription>
"""


def _fmu(path: Path, kind: int, description: str) -> Path:
    library = compiled(Path(__file__).with_name("meaning.c"), "-O1", f"-DFMI={kind}")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library, f"binaries/{'x86_64-linux' if kind > 2 else 'linux64'}/meaning.so")
    return path


def alias_fmu(path: Path) -> Path:
    """Return an FMU of FMI 1.0 for model exchange with negated aliases: y = 2u, dx/dt = u - x."""
    return _fmu(path, 1, ALIASES)


def unit_fmu(path: Path, units: tuple[str, str] = ("", ""), definitions: str = "", **replaced: str) -> Path:
    """Return an FMU with y = gain·u in given units, and outputs that switch at multiples of `at` [s]."""
    text = UNITS.replace("DEFINITIONS", definitions).replace("<UnitDefinitions></UnitDefinitions>", "")
    for mark, unit in zip(("UNIT_IN", "UNIT_OUT"), units, strict=True):
        text = text.replace(f' unit="{mark}"', f' unit="{unit}"' if unit else "")
    for old, new in replaced.items():
        assert old in text
        text = text.replace(old, new)
    return _fmu(path, 2, text)


def exact_fmu(path: Path) -> Path:
    """Return an FMU of FMI 3.0 that passes every type through, and whose inputs cannot be read."""
    outputs = "".join(f'<Output valueReference="{k}" dependencies="{k - 1}"/>' for k in range(2, 13, 2))
    return _fmu(path, 3, EXACT.replace("OUTPUTS", outputs))


def node_fmu(path: Path) -> Path:
    """Return a node of a bus as of LS-BUS: clocked binary data, to be set and read only at ticks."""
    return _fmu(path, 4, NODE)
