"""An FMU of C for model exchange alone that decays, and does a deed on the way; compiled once a session."""

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

DEEDS = (
    "nothing", "error of step", "error of update", "error of derivative", "discarded", "no number", "chatters",
    "due at once", "always due", "no bound",
)  # fmt: skip
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="decay" guid="g" generationTool="tests" numberOfEventIndicators="1">
  <ModelExchange modelIdentifier="decay"/>
  <ModelVariables>
    <ScalarVariable name="x" valueReference="0" causality="local" initial="exact"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="der(x)" valueReference="1" causality="local"><Real derivative="1"/></ScalarVariable>
    <ScalarVariable name="u" valueReference="2" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="3" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="deed" valueReference="4" causality="parameter" variability="fixed">
      <Real start="0"/></ScalarVariable>
    <ScalarVariable name="events" valueReference="5" causality="output" variability="discrete"><Real/></ScalarVariable>
    <ScalarVariable name="y_start" valueReference="0" causality="parameter" variability="fixed">
      <Real start="1"/></ScalarVariable>
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="4"/><Unknown index="6"/></Outputs>
    <Derivatives><Unknown index="2"/></Derivatives>
    <InitialUnknowns><Unknown index="2"/><Unknown index="4"/><Unknown index="6"/></InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""


@cache
def library() -> Path:
    """Return the library compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix="decay-")) / "decay.so"
    source = FMU_SOURCES / "decay.c"
    subprocess.run([*command, "-O1", "-w", "-shared", "-fPIC", "-o", str(made), str(source), "-lm"], check=True)
    return made


def decay_fmu(path: Path) -> Path:
    """The FMU."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", DESCRIPTION)
        archive.write(library(), "binaries/linux64/decay.so")
    return path
