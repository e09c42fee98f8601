"""A first-order lag as an FMU of C, T·dy/dt = gain·u + bias − y by Euler's rule: what SSPs of the tests are made of."""

from __future__ import annotations

import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler

SOURCE = r"""
#include <stdlib.h>
#include <string.h>
typedef void *C; typedef unsigned VR;
enum { U, Y, GAIN, BIAS, T, REALS };
typedef struct { double r[REALS]; int b; } M;
C fmi2Instantiate(const char *n, int t, const char *g, const char *s, const void *f, int v, int l)
{ M *m = calloc(1, sizeof(M)); m->r[GAIN] = m->r[T] = 1; return strcmp(g, "lag") ? 0 : m; }
void fmi2FreeInstance(C c) { free(c); }
int fmi2SetupExperiment(C c, int d, double t, double s, int e, double p) { return 0; }
int fmi2EnterInitializationMode(C c) { return 0; }
int fmi2ExitInitializationMode(C c) { return 0; }
int fmi2Terminate(C c) { return 0; }
int fmi2Reset(C c) { return 0; }
int fmi2SetDebugLogging(C c, int o, size_t n, const char *const k[]) { return 0; }
int fmi2GetReal(C c, const VR *v, size_t n, double *x) { while (n--) x[n] = ((M *)c)->r[v[n]]; return 0; }
int fmi2SetReal(C c, const VR *v, size_t n, const double *x) { while (n--) ((M *)c)->r[v[n]] = x[n]; return 0; }
int fmi2GetBoolean(C c, const VR *v, size_t n, int *x) { while (n--) x[n] = ((M *)c)->b; return 0; }
int fmi2SetBoolean(C c, const VR *v, size_t n, const int *x) { while (n--) ((M *)c)->b = x[n]; return 0; }
int fmi2GetInteger(C c, const VR *v, size_t n, int *x) { return n ? 3 : 0; }
int fmi2SetInteger(C c, const VR *v, size_t n, const int *x) { return n ? 3 : 0; }
int fmi2GetString(C c, const VR *v, size_t n, const char **x) { return n ? 3 : 0; }
int fmi2SetString(C c, const VR *v, size_t n, const char *const *x) { return n ? 3 : 0; }
int fmi2DoStep(C c, double t, double h, int k)
{ M *m = c; double *r = m->r;
  if (!m->b) r[Y] += h / r[T] * (r[GAIN] * r[U] + r[BIAS] - r[Y]);
  return 0; }
int fmi2GetFMUstate(C c, void **s) { if (!*s) *s = malloc(sizeof(M)); memcpy(*s, c, sizeof(M)); return 0; }
int fmi2SetFMUstate(C c, void *s) { memcpy(c, s, sizeof(M)); return 0; }
int fmi2FreeFMUstate(C c, void **s) { free(*s); *s = 0; return 0; }
int fmi2SerializedFMUstateSize(C c, void *s, size_t *n) { return 3; }
int fmi2SerializeFMUstate(C c, void *s, char *b, size_t n) { return 3; }
int fmi2DeSerializeFMUstate(C c, const char *b, size_t n, void **s) { return 3; }
int fmi2GetDirectionalDerivative(C c, const VR *a, size_t n, const VR *b, size_t m, const double *s, double *x)
{ return 3; }
int fmi2SetRealInputDerivatives(C c, const VR *v, size_t n, const int *o, const double *x) { return 3; }
int fmi2GetRealOutputDerivatives(C c, const VR *v, size_t n, const int *o, double *x) { return 3; }
int fmi2CancelStep(C c) { return 3; }
int fmi2GetStatus(C c, int k, int *x) { return 2; }
int fmi2GetRealStatus(C c, int k, double *x) { return 2; }
int fmi2GetIntegerStatus(C c, int k, int *x) { return 2; }
int fmi2GetBooleanStatus(C c, int k, int *x) { return 2; }
int fmi2GetStringStatus(C c, int k, const char **x) { return 2; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
const char *fmi2GetVersion(void) { return "2.0"; }
"""
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


@cache
def library(forgets: bool = False) -> Path:
    """Return the library compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    folder = Path(tempfile.mkdtemp(prefix="lag-"))
    taken = "{ memcpy(c, s, sizeof(M)); return 0; }"
    assert taken in SOURCE
    (folder / "lag.c").write_text(SOURCE.replace(taken, "{ return 0; }") if forgets else SOURCE)
    flags = ["-O1", "-w", "-shared", "-fPIC", "-ffp-contract=off"]
    subprocess.run([*command, *flags, "-o", str(folder / "lag.so"), str(folder / "lag.c")], check=True)
    return folder / "lag.so"


def lag_fmu(path: Path, units: tuple[str, str] = ("", ""), *, forgets: bool = False) -> Path:
    """The FMU; `units` of u and y; forgets: a state given back is not taken."""
    text = DESCRIPTION
    for mark, unit in zip(("UNIT_IN", "UNIT_OUT"), units, strict=True):
        text = text.replace(f' unit="{mark}"', f' unit="{unit}"' if unit else "")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", text)
        archive.write(library(forgets), "binaries/linux64/lag.so")
    return path


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
