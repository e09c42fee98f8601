"""FMUs of C for algebraic loops and step control, with one of the laws of coupled.c; compiled once a session."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from tests.compiled import library, pack, rewritten
from tests.corpus.inputs import FMU_SOURCES

LINEAR, LOOP_A, LOOP_B, SQUARE, CHASSIS, WHEEL = range(6)
INPUTS, OUTPUTS = (1, 1, 2, 1, 1, 1), (1, 2, 1, 1, 2, 2)
TRUCK = {  # a quarter of a truck over a bump of 0.1 m and 0.1 s; chassis, wheel
    CHASSIS: {"p0": 400.0},
    WHEEL: {"p0": 40.0, "p1": 150e3, "p2": 15e3, "p3": 1e3, "p4": 0.1, "p5": 0.1},
}


def truck(folder: Path, **options: bool) -> tuple[dict[str, Any], list[str]]:
    """Write the FMUs of a quarter truck; return its components and connections."""
    laws = {"chassis": CHASSIS, "wheel": WHEEL}
    for name, law in laws.items():
        coupled_fmu(folder / f"{name}.fmu", law, **options)
    components = {name: {"fmu": f"{name}.fmu", "start": TRUCK[law]} for name, law in laws.items()}
    return components, ["chassis.y0 → wheel.u0", "wheel.y0 → chassis.u0"]


def without_dependencies(path: Path) -> Path:
    """Remove the declared dependencies of an FMU."""
    return rewritten(path, path, lambda name, data: re.sub(rb' dependencies="[^"]*"', b"", data))


def coupled_fmu(
    path: Path,
    law: int,
    *,
    declares: bool = True,
    slopes: bool = False,
    saves: bool = True,
    exchange: bool = False,
    variable_step: bool = True,
) -> Path:
    """Build an FMU; unless its law is that of a chassis, its first output depends on all inputs."""
    inputs, outputs = INPUTS[law], OUTPUTS[law]

    def scalar(name: str, reference: int, attributes: str, real: str = "") -> str:
        head = f'<ScalarVariable name="{name}" valueReference="{reference}" {attributes}>'
        return f"{head}<Real {real}/></ScalarVariable>\n"

    fixed = 'causality="parameter" variability="fixed"'
    variables = "".join(scalar(f"u{k}", k, 'causality="input"', 'start="0"') for k in range(inputs))
    variables += "".join(scalar(f"y{k}", 3 + k, 'causality="output"') for k in range(outputs))
    variables += "".join(scalar(f"p{k}", 6 + k, fixed, 'start="0"') for k in range(6))
    variables += scalar("late", 12, fixed, 'start="0"')
    variables += scalar("tries", 13, 'causality="local"') + scalar("steps", 14, 'causality="local"')
    variables += "".join(scalar(f"x{k}", 15 + k, 'causality="local" variability="continuous"') for k in range(4))
    ends = " ".join(str(k + 1) for k in range(inputs))
    dependencies = [ends if k == 0 and law != CHASSIS else "" for k in range(outputs)]
    unknowns = "".join(
        f'<Unknown index="{inputs + k + 1}"' + (f' dependencies="{text}"/>' if declares else "/>")
        for k, text in enumerate(dependencies)
    )
    flags = f'canGetAndSetFMUstate="{str(saves).lower()}" providesDirectionalDerivative="{str(slopes).lower()}"'
    steps = f'canHandleVariableCommunicationStepSize="{str(variable_step).lower()}"'
    part = f'<ModelExchange modelIdentifier="coupled" {flags}/>'
    if not exchange:
        part = f'<CoSimulation modelIdentifier="coupled" {steps} {flags}/>'
    text = (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<fmiModelDescription fmiVersion="2.0" modelName="coupled{law}" guid="g" numberOfEventIndicators="0">\n'
        f"{part}\n"
        f"<ModelVariables>\n{variables}</ModelVariables>\n<ModelStructure><Outputs>{unknowns}</Outputs></ModelStructure>\n"
        "</fmiModelDescription>\n"
    )
    return pack(path, text, library(FMU_SOURCES / "coupled.c", f"-DLAW={law}"))
