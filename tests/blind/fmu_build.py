"""FMUs of own C for the blind suite and for tests of bad input: compiled and stripped here, at run time.

    build(Path("drive.fmu"), "drive")                                          FMI 2.0, model exchange
    build(Path("tanks.fmu"), "tanks", version=3, ways=("co_simulation",))      FMI 3.0, co-simulation
    build(Path("bad.fmu"), "drive", ways=WAYS, fault="idle_reset")             both ways in a file, misbehaving

`PLANTS` has the sound FMUs. Sources are in `fmus/`: for each plant a file with a table of its variables and with its
equations, and a runtime for all. `FAULTS` declares the ways to misbehave; every plant can have each of them.

Parameters are fixed: they are accepted before and in initialization mode, later they are an error. States are start
values (`initial` exact). A step of co-simulation has any length and is divided into Runge-Kutta steps of at most
`Plant.inner` seconds. FMU states can be saved and serialized. There are no events and no directional derivatives.
"""

import os
import re
import shlex
import shutil
import subprocess
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import fmpy

HEADERS = Path(fmpy.__file__).with_name("c-code")
SOURCES = Path(__file__).with_name("fmus")
WAYS = ("model_exchange", "co_simulation")
FLAGS = "-shared -fPIC -std=gnu99 -O2 -w -s -fvisibility=hidden"
INPUT, STATE, RATE, READING, PARAMETER, TIME = 0, 100, 200, 300, 400, 999  # first value references
REAL = ("unit", "start", "derivative")  # attributes of the type
UNITS = {  # name → exponents of SI base units
    "A": "A=1", "V": "kg=1 m=2 s=-3 A=-1", "ohm": "kg=1 m=2 s=-3 A=-2", "H": "kg=1 m=2 s=-2 A=-2",
    "N": "kg=1 m=1 s=-2", "N.m": "kg=1 m=2 s=-2", "N.m/A": "kg=1 m=2 s=-2 A=-1", "N/m": "kg=1 s=-2",
    "N.s/m": "kg=1 s=-1", "N.m/rad": "kg=1 m=2 s=-2 rad=-1", "N.m.s/rad": "kg=1 m=2 s=-1 rad=-1",
    "kg": "kg=1", "kg.m2": "kg=1 m=2", "m": "m=1", "m/s": "m=1 s=-1", "m2": "m=2", "m2.5/s": "s=-1", "m3/(s.V)": "",
    "rad": "rad=1", "rad/s": "rad=1 s=-1", "Pa": "kg=1 m=-1 s=-2", "m4/(s.N.5)": "", "K": "K=1", "W": "kg=1 m=2 s=-3",
    "W/K": "kg=1 m=2 s=-3 K=-1", "J/K": "kg=1 m=2 s=-2 K=-1", "1": "",
}  # fmt: skip


@dataclass(frozen=True)
class Variable:
    """Name, start value, unit, description and, of a parameter, stated tolerance of a variable."""

    name: str
    start: float
    unit: str
    description: str = ""
    tolerance: float = 0.0


@dataclass(frozen=True)
class Plant:
    """Variables of an FMU, in the order of its C source.

    outputs: names of states that are outputs, or new variables, which the source computes
    inner:   largest Runge-Kutta step in co-simulation [s]
    """

    title: str
    inputs: tuple[Variable, ...]
    states: tuple[Variable, ...]
    outputs: tuple[str | Variable, ...]
    parameters: tuple[Variable, ...]
    inner: float

    @property
    def readings(self) -> tuple[Variable, ...]:
        """Return the outputs that are not states."""
        return tuple(output for output in self.outputs if isinstance(output, Variable))

    @property
    def output_names(self) -> tuple[str, ...]:
        """Return the names of the outputs."""
        return tuple(output if isinstance(output, str) else output.name for output in self.outputs)


def _read(name: str) -> Plant:
    """Return the variables of a plant from the table in its C source, in `layout.h` and in its order."""
    rows: dict[str, list[str]] = {}
    for kind, text in re.findall(r"^ \* (\w+): (.*)$", (SOURCES / f"{name}.c").read_text(), re.MULTILINE):
        rows.setdefault(kind, []).append(text)

    def variables(kind: str) -> tuple[Variable, ...]:
        cells = [text.split(maxsplit=3) for text in rows.get(kind, ())]
        return tuple(Variable(name, float(start), unit, description) for name, start, unit, description in cells)

    def parameter(v: Variable) -> Variable:
        tolerance, description = v.description.split(maxsplit=1)
        return replace(v, description=description, tolerance=float(tolerance))

    outputs = (*" ".join(rows.get("shown", ())).split(), *variables("output"))
    parts = variables("input"), variables("state"), outputs, tuple(map(parameter, variables("parameter")))
    return Plant(rows["title"][0], *parts, float(rows["inner"][0]))


NAMES = ("drive", "dc_motor", "tanks", "heated_box", "pendulum", "coupled", "cylinder")
PLANTS = {name: _read(name) for name in NAMES}

NO_PARAMETERS, NO_UNITS, OWN_STEP = "no_parameters", "no_units", "own_step"
FAULTS: dict[str, dict[str, str]] = {  # macros of the runtime; the description is wrong of those without any
    "": {},
    "forgets_parameters": {"FORGETS": "1"},  # entering initialization mode restores the default parameters
    "idle_reset": {"IDLE_RESET": "1"},  # reset returns OK and changes neither states nor parameters
    "leaks": {"LEAKS": "(4 << 20)"},  # every instance keeps 4 MB for ever
    # the last rate depends, by 1 %, on how often rates were asked since the library was loaded
    "counts": {"COUNTS": "0.01"},
    "clock": {"COUNTS": "0.01", "CLOCK": "1"},  # as counts, but counting begins at the time of day
    "working_directory": {"FOLDER": "0.05"},  # rates depend, by up to 5 %, on the working directory
    "step_events": {"EVENTS": "1"},  # each completed integrator step asks for an event
    "time_events": {"TICKS": "1e-3"},  # a time event each millisecond
    OWN_STEP: {"OWN_STEP": "0.05"},  # steps of whole 0.05 s, one at least, whatever is asked; said so
    "hidden_own_step": {"OWN_STEP": "0.05"},  # as own_step, but the description allows any step
    NO_PARAMETERS: {},  # no parameter is declared
    NO_UNITS: {},  # no unit is declared
    "crashes": {"CRASHES": "FIRST * 1.05"},  # abort() while the first parameter is above 1.05 times its start value
    "hangs": {"HANGS": "FIRST * 1.05"},  # likewise
}


def build(
    path: Path, plant: str, version: int = 2, *, ways: Sequence[str] = ("model_exchange",), fault: str = ""
) -> Path:
    """Write the FMU of a plant and return its path; NoCompiler without a C compiler.

    Args:
        plant: a key of `PLANTS`.
        version: of FMI, 2 or 3.
        ways: from `WAYS`.
        fault: a key of `FAULTS`.
    """
    folder = fmpy.platform if version == 2 else fmpy.platform_tuple
    entries = {
        "modelDescription.xml": _description(plant, version, fault, ways).encode(),
        f"binaries/{folder}/{plant}{fmpy.sharedLibraryExtension}": library(plant, version, fault),
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0)), content)
    return path


def build_slave(path: Path, plant: str) -> Path:
    """Write the FMU of a plant by pythonfmu, from `fmus/PLANT_slave.py`, and return its path."""
    from pythonfmu.builder import FmuBuilder

    with tempfile.TemporaryDirectory() as folder:
        made = FmuBuilder.build_FMU(SOURCES / f"{plant}_slave.py", dest=folder)
        return Path(shutil.move(made, path))


@cache
def library(plant: str, version: int, fault: str = "") -> bytes:
    """Compile and strip the library of a plant once per process, and return its content."""
    macros = [f"-D{name}={value}" for name, value in FAULTS[fault].items()]
    command = [*shlex.split(os.environ.get("CC") or "cc"), *FLAGS.split(), f"-DFMI={version}", *macros]
    with tempfile.TemporaryDirectory(prefix="blind-fmu-") as name:
        folder = Path(name)
        (folder / "layout.h").write_text(_layout(PLANTS[plant]))
        made = folder / f"{plant}.so"
        command += [f'-DPLANT="{SOURCES / f"{plant}.c"}"', f"-I{folder}", f"-I{HEADERS}"]
        subprocess.run([*command, "-o", str(made), str(SOURCES / "runtime.c"), "-lm"], check=True)
        return made.read_bytes()


def _layout(plant: Plant) -> str:
    """Return the header with numbers and start values."""
    counts = {"NU": plant.inputs, "NX": plant.states, "NY": plant.readings, "NP": plant.parameters}
    starts = {"INPUTS": plant.inputs, "STATES": plant.states, "PARAMETERS": plant.parameters}
    lines = [f"enum {{ {name} = {len(variables)} }};" for name, variables in counts.items()]
    lines += [f"#define {n} {{{', '.join(repr(v.start) for v in variables)}}}" for n, variables in starts.items()]
    return "\n".join([*lines, f"#define INNER {plant.inner!r}", f"#define FIRST {plant.parameters[0].start!r}", ""])


# -- model descriptions ------------------------------------------------------------------------------------


def _declared(plant: Plant, version: int, fault: str) -> list[dict[str, Any]]:
    """Return the attributes of the variables; `derivative` is the number of a state."""
    rates = [Variable(f"der({v.name})", 0.0, "", f"rate of {v.name}") for v in plant.states]
    state = STATE if version > 2 else 1 + len(plant.inputs)
    return [
        {
            "name": v.name,
            "valueReference": first + k,
            "description": v.description,
            "causality": causality or ("output" if v.name in plant.output_names else "local"),
            "variability": "fixed" if first == PARAMETER else "continuous",
            "initial": initial,
            "unit": "" if fault == NO_UNITS else v.unit,
            "start": "" if initial == "calculated" else v.start,
            "derivative": state + k if first == RATE else "",
        }
        for first, variables, causality, initial in (
            (INPUT, plant.inputs, "input", ""),
            (STATE, plant.states, "", "exact"),
            (RATE, rates, "local", "calculated"),
            (READING, plant.readings, "output", "calculated"),
            (PARAMETER, () if fault == NO_PARAMETERS else plant.parameters, "parameter", "exact"),
        )
        for k, v in enumerate(variables)
    ]


def _attributes(**given: object) -> str:
    return "".join(f' {name}="{value}"' for name, value in given.items() if value not in ("", None))


def _ways(plant: str, fault: str, ways: Sequence[str], version: int) -> str:
    """Return the elements of the offered ways."""
    state, own = ("FMUstate", "") if version == 2 else ("FMUState", "0.05" if fault == OWN_STEP else "")
    can = {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    steps = {"canHandleVariableCommunicationStepSize": str(fault != OWN_STEP).lower(), "fixedInternalStepSize": own}
    elements = {
        "model_exchange": f"<ModelExchange{_attributes(modelIdentifier=plant, **can)}/>",
        "co_simulation": f"<CoSimulation{_attributes(modelIdentifier=plant, **steps, **can)}/>",
    }
    return "".join(elements[way] for way in WAYS if way in ways)


def _units() -> str:
    units = []
    for name, exponents in UNITS.items():
        base = _attributes(**dict(word.split("=") for word in exponents.split()))
        units.append(f'<Unit name="{name}">{f"<BaseUnit{base}/>" if base or name == "1" else ""}</Unit>')
    return f"<UnitDefinitions>{''.join(units)}</UnitDefinitions>"


def _description(name: str, version: int, fault: str, ways: Sequence[str]) -> str:
    plant = PLANTS[name]
    variables = _declared(plant, version, fault)
    time = f'<Float64 name="time" valueReference="{TIME}" causality="independent" variability="continuous"/>'
    lines = [] if version == 2 else [time]
    structure = {"Output": "", "Derivative" if version == 2 else "ContinuousStateDerivative": "", "InitialUnknown": ""}
    for number, v in enumerate(variables, start=1):
        real = _attributes(**{key: v[key] for key in REAL})
        told = _attributes(**{key: value for key, value in v.items() if key not in REAL})
        lines.append(
            f"<ScalarVariable{told}><Real{real}/></ScalarVariable>" if version == 2 else f"<Float64{told}{real}/>"
        )
        is_output, is_unknown = v["name"] in plant.output_names, v["initial"] == "calculated"
        for tag, belongs in zip(structure, (is_output, v["derivative"] != "", is_unknown), strict=True):
            own = f'<Unknown index="{number}"/>' if version == 2 else f'<{tag} valueReference="{v["valueReference"]}"/>'
            structure[tag] += own * belongs
    unknowns = "".join(f"<{tag}s>{some}</{tag}s>" if version == 2 else some for tag, some in structure.items())
    token = {"guid" if version == 2 else "instantiationToken": f"blind-{name}"}
    events = {"numberOfEventIndicators": 0} if version == 2 else {}
    head = _attributes(fmiVersion=f"{version}.0", modelName=name, **token, description=plant.title, **events)
    listed = "\n".join(lines)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription{head}>\n'
        f"{_ways(name, fault, ways, version)}\n{_units() if fault != NO_UNITS else ''}\n"
        f"<ModelVariables>\n{listed}\n</ModelVariables>\n<ModelStructure>{unknowns}</ModelStructure>\n"
        "</fmiModelDescription>\n"
    )
