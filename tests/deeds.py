"""FMUs of C that crash, hang or end their process in a call: compiled once, each with a deed of its own."""

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

PLATFORM = {"Linux": ("linux64", ".so"), "Darwin": ("darwin64", ".dylib")}.get(platform.system())
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="deeds" guid="{{deeds}}" generationTool="tests">
  <CoSimulation modelIdentifier="deeds" canHandleVariableCommunicationStepSize="true"/>
  <ModelVariables>
{variables}
  </ModelVariables>
  <ModelStructure><Outputs>
{outputs}
  </Outputs><InitialUnknowns>
{outputs}
  </InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""


@cache
def library() -> Path:
    """Return the library, for Linux and macOS; skip the test without a compiler."""
    command = compiler()
    if command is None or PLATFORM is None:
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix="deeds-")) / f"deeds{PLATFORM[1]}"
    # without -lm: some exporters leave libm to the host
    flags = ["-w", "-shared", "-fPIC", "-O0", "-o", str(made)]
    subprocess.run([*command, *flags, str(FMU_SOURCES / "deeds.c"), "-ldl"], check=True)
    return made


def description(signals: int) -> str:
    """With `signals` inputs and outputs; only outputs from the second on follow inputs, later."""
    line = '    <ScalarVariable name="{}{}" valueReference="{}" causality="{}"><Real{}/></ScalarVariable>'
    lines = [line.format("u", k, k, "input", ' start="0"') for k in range(signals)]
    lines += [line.format("y", k, 10 + k, "output", "") for k in range(signals)]
    outputs = [f'    <Unknown index="{signals + k + 1}" dependencies=""/>' for k in range(signals)]
    return DESCRIPTION.format(variables="\n".join(lines), outputs="\n".join(outputs))


def deeds_fmu(path: Path, call: str = "none", deed: str = "none", at: int = 1, signals: int = 2) -> Path:
    """Return an FMU that does `deed` at the n-th `call`, or at every call for n = 0."""
    binary = library()
    assert PLATFORM is not None
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(signals))
        archive.writestr("resources/deed.txt", f"{call} {deed} {at}\n")
        archive.write(binary, f"binaries/{PLATFORM[0]}/{binary.name}")
    return path


SCENARIO = """name: deeds
duration: {duration}
step: 0.1
components:
  good: {{fmu: good.fmu}}
  bad: {{fmu: bad.fmu}}
connections:
  - {{from: good.y1, to: bad.u1}}
  - {{from: bad.y1, to: good.u1}}
"""


def deeds_scenario(folder: Path, call: str, deed: str, at: int = 1, duration: float = 1.0, limits: str = "") -> Path:
    """Return a scenario of a correct FMU and an FMU with a deed."""
    deeds_fmu(folder / "good.fmu")
    deeds_fmu(folder / "bad.fmu", call, deed, at)
    path = folder / "deeds.yaml"
    path.write_text(SCENARIO.format(duration=duration) + (f"limits: {limits}\n" if limits else ""))
    return path
