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

SOURCE = Path(__file__).with_name("deeds.c")
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
    """Return the library compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or PLATFORM is None:
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix="deeds-")) / f"deeds{PLATFORM[1]}"
    flags = ["-O0", "-w", "-shared", "-fPIC"]
    # without -lm: some exporters leave libm to the host
    subprocess.run([*command, *flags, "-o", str(made), str(SOURCE), "-ldl"], check=True)
    return made


def description(signals: int) -> str:
    """With `signals` inputs and outputs; only outputs from the second on follow inputs, later."""
    lines, outputs = [], []
    for k in range(signals):
        lines.append(f'    <ScalarVariable name="u{k}" valueReference="{k}" causality="input"><Real start="0"/>')
        lines.append("    </ScalarVariable>")
    for k in range(signals):
        lines.append(f'    <ScalarVariable name="y{k}" valueReference="{10 + k}" causality="output"><Real/>')
        lines.append("    </ScalarVariable>")
        outputs.append(f'    <Unknown index="{signals + k + 1}" dependencies=""/>')
    return DESCRIPTION.format(variables="\n".join(lines), outputs="\n".join(outputs))


def deeds_fmu(path: Path, call: str = "none", deed: str = "none", at: int = 1, signals: int = 2) -> Path:
    """Return an FMU that does `deed` at the n-th `call`, or at every call for n = 0."""
    assert PLATFORM is not None
    binary = library()
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
