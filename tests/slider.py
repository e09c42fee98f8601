"""An FMU of C that slides: a mass with a force, in FMI 2.0 and 3.0; compiled once a session. Logs of known truth."""

from __future__ import annotations

import platform
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cosim.fmi.native.compiler import compiler
from tests.corpus.inputs import FMU_SOURCES
from tests.logs import write_log

FOLDERS = {2: "linux64", 3: "x86_64-linux"}
CO_SIMULATION = '<CoSimulation modelIdentifier="slider" canHandleVariableCommunicationStepSize="true"/>'
EXCHANGE = '<ModelExchange modelIdentifier="slider"/>'
PARAMETERS = {  # name → value reference, start value, further attributes
    "mass": (5, 1.0, 'unit="kg" min="0.01"'),
    "gain": (6, 2.0, ""),
    "damping": (7, 0.5, 'min="0"'),
    "offset": (8, 0.0, ""),
    "idle": (9, 3.0, ""),
    "fragile": (10, 0.0, ""),
    "velocity_start": (11, 0.0, ""),
}
TRUTH = {"mass": 1.6, "gain": 2.0, "damping": 0.8, "offset": 0.0}
Array = NDArray[np.float64]


@cache
def library() -> Path:
    """Return the library compiled for this machine; skip the test without a compiler."""
    command = compiler()
    if command is None or platform.system() != "Linux" or platform.machine() != "x86_64":
        pytest.skip("no C compiler for this platform")
    made = Path(tempfile.mkdtemp(prefix="slider-")) / "slider.so"
    source = FMU_SOURCES / "slider.c"
    subprocess.run([*command, "-O1", "-w", "-shared", "-fPIC", "-o", str(made), str(source), "-lm"], check=True)
    return made


def description(version: int, exchange: bool) -> str:
    """Return the model description."""
    way = EXCHANGE if exchange else CO_SIMULATION
    if version == 3:
        head = '<fmiModelDescription fmiVersion="3.0" modelName="slider" instantiationToken="g">'
        parameters = "".join(
            f'<Float64 name="{n}" valueReference="{k}" causality="parameter" variability="fixed" start="{v}" {more}/>'
            for n, (k, v, more) in PARAMETERS.items()
        )
        signals = (
            '<Float64 name="force" valueReference="0" causality="input" start="0" unit="N"/>'
            '<Float64 name="position" valueReference="1" causality="output" initial="exact" start="0" unit="m"/>'
            '<Float64 name="velocity" valueReference="2" causality="output" unit="m/s"/>'
            '<Float64 name="der(position)" valueReference="3" causality="local" derivative="1"/>'
            '<Float64 name="der(velocity)" valueReference="4" causality="local" derivative="2"/>'
        )
        structure = (
            '<Output valueReference="1"/><Output valueReference="2"/><ContinuousStateDerivative valueReference="3"/>'
            '<ContinuousStateDerivative valueReference="4"/><InitialUnknown valueReference="2"/>'
            '<InitialUnknown valueReference="3"/><InitialUnknown valueReference="4"/>'
        )
    else:
        head = '<fmiModelDescription fmiVersion="2.0" modelName="slider" guid="g" numberOfEventIndicators="0">'

        def scalar(name: str, reference: int, attributes: str, real: str) -> str:
            head = f'<ScalarVariable name="{name}" valueReference="{reference}" {attributes}>'
            return f"{head}<Real {real}/></ScalarVariable>"

        signals = (
            scalar("force", 0, 'causality="input"', 'start="0" unit="N"')
            + scalar("position", 1, 'causality="output" initial="exact"', 'start="0" unit="m"')
            + scalar("velocity", 2, 'causality="output"', 'unit="m/s"')
            + scalar("der(position)", 3, 'causality="local"', 'derivative="2"')
            + scalar("der(velocity)", 4, 'causality="local"', 'derivative="3"')
        )
        fixed = 'causality="parameter" variability="fixed"'
        parameters = "\n".join(scalar(n, k, fixed, f'start="{v}" {more}') for n, (k, v, more) in PARAMETERS.items())
        unknowns = '<Unknown index="3"/><Unknown index="4"/><Unknown index="5"/>'
        structure = (
            '<Outputs><Unknown index="2"/><Unknown index="3"/></Outputs><Derivatives><Unknown index="4"/>'
            f'<Unknown index="5"/></Derivatives><InitialUnknowns>{unknowns}</InitialUnknowns>'
        )
    units = "".join(f'<Unit name="{n}"><BaseUnit {b}/></Unit>' for n, b in UNITS.items())
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{head}\n{way}\n<UnitDefinitions>{units}</UnitDefinitions>\n'
        f"<ModelVariables>{signals}\n{parameters}\n</ModelVariables>\n<ModelStructure>{structure}</ModelStructure>\n"
        "</fmiModelDescription>\n"
    )


UNITS = {"N": 'kg="1" m="1" s="-2"', "m": 'm="1"', "m/s": 'm="1" s="-1"', "kg": 'kg="1"'}


def slider_fmu(path: Path, version: int = 2, *, exchange: bool = False, follow: bool = False) -> Path:
    """Build the FMU; with `follow` its library takes the start values of modelDescription.xml."""
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description(version, exchange))
        archive.write(library(), f"binaries/{FOLDERS[version]}/slider.so")
        archive.writestr("documentation/license.txt", "free")
        archive.writestr("resources/follow" if follow else "resources/none", "")
    return path


def slide(
    time: Array, truth: Mapping[str, float], start: tuple[float, float] = (0.0, 0.0), seed: int = 1
) -> dict[str, Array]:
    """Return time, force, position and velocity of the truth, by exact integration over each row."""
    rng = np.random.default_rng(seed)
    force = np.repeat(rng.uniform(-1.0, 1.0, time.size // 20 + 1), 20)[: time.size]
    d, x, v = truth["damping"], [start[0]], [start[1]]
    for k, h in enumerate(np.diff(time)):
        a = truth["gain"] / truth["mass"] * force[k] + truth["offset"]
        decay = np.exp(-d * h)
        x.append(x[-1] + a / d * h + (v[-1] - a / d) * (1.0 - decay) / d)
        v.append(a / d + (v[-1] - a / d) * decay)
    return {"time": time, "force": force, "position": np.array(x), "velocity": np.array(v)}


def slider_log(
    path: Path,
    truth: Mapping[str, float] = TRUTH,
    *,
    start: tuple[float, float] = (0.3, -0.4),
    seed: int = 1,
    seconds: float = 20.0,
    noise: tuple[float, float] = (2e-3, 1e-2),
    outputs: tuple[str, ...] = ("position", "velocity"),
) -> Path:
    """Write a log with white noise."""
    columns = slide(0.05 * np.arange(round(seconds / 0.05) + 1), truth, start, seed)
    rng = np.random.default_rng([seed, 1])
    for name, sigma in zip(("position", "velocity"), noise, strict=True):
        columns[name] = columns[name] + sigma * rng.standard_normal(columns[name].size)
    return write_log(path, {n: v for n, v in columns.items() if n in {"time", "force", *outputs}})
