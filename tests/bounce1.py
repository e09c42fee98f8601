"""An FMU of C for model exchange of FMI 1.0, compiled once a session, with its source inside where it is asked for."""

from __future__ import annotations

import platform
import subprocess
import tempfile
import zipfile
from functools import cache
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler
from tests.corpus.inputs import FMU_SOURCES

SOURCE = FMU_SOURCES / "bounce1.c"
NAMES = ("kick_at", "ask_at", "end_at", "fail_at")
PARAMETERS = {"g": (3, 9.81), "e": (4, 0.7)} | {name: (5 + k, 1e9) for k, name in enumerate(NAMES)}
DISCRETE = 'causality="output" variability="discrete"'
VARIABLES = "\n".join(
    f'<ScalarVariable name="{name}" valueReference="{vr}" causality="internal" variability="parameter">'
    f'<Real start="{start:g}"/></ScalarVariable>'
    for name, (vr, start) in PARAMETERS.items()
)
DESCRIPTION = f"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="1.0" modelName="bounce" modelIdentifier="bounce1" guid="g" generationTool="tests"
  numberOfContinuousStates="2" numberOfEventIndicators="1">
  <DefaultExperiment startTime="0" stopTime="2" tolerance="1e-6"/>
  <ModelVariables>
    <ScalarVariable name="minus_h" valueReference="0" causality="internal" alias="negatedAlias"><Real/></ScalarVariable>
    <ScalarVariable name="h" valueReference="0" causality="output"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="v" valueReference="1" causality="output"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="der(h)" valueReference="1" causality="internal" alias="alias"><Real/></ScalarVariable>
    <ScalarVariable name="wind" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="steps" valueReference="9" causality="internal" variability="discrete"><Real/></ScalarVariable>
    <ScalarVariable name="events" valueReference="0" {DISCRETE}><Integer/></ScalarVariable>
    <ScalarVariable name="upwards" valueReference="0" {DISCRETE}><Boolean/></ScalarVariable>
    <ScalarVariable name="label" valueReference="0" {DISCRETE}><String/></ScalarVariable>
    {VARIABLES}
  </ModelVariables>
</fmiModelDescription>
"""


@cache
def library() -> Path:
    """Return the library compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix="bounce-")) / "bounce1.so"
    subprocess.run([*command, "-O1", "-w", "-shared", "-fPIC", "-o", str(made), str(SOURCE)], check=True)
    return made


def bounce_fmu(path: Path, *, compiled: bool = True, source: bool = False, description: str = DESCRIPTION) -> Path:
    """The FMU, with its library, its source, or both."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        if compiled:
            archive.write(library(), "binaries/linux64/bounce1.so")
        if source:
            archive.write(SOURCE, "sources/bounce1.c")
    return path
