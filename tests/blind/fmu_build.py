"""FMUs of own C for the blind suite and for tests of bad input: compiled and stripped here, at run time.

    build(Path("drive.fmu"), "drive")                                          FMI 2.0, model exchange
    build(Path("tanks.fmu"), "tanks", version=3, ways=("co_simulation",))      FMI 3.0, co-simulation
    build(Path("bad.fmu"), "drive", ways=WAYS, fault="idle_reset")             both ways in a file, misbehaving

`PLANTS` declares the sound FMUs: drive, dc_motor, tanks, heated_box, pendulum, coupled, cylinder. Sources are in
`fmus/`, a file of equations each and a runtime for all. `FAULTS` declares the ways to misbehave; every plant can have
each of them.

Parameters are fixed: they are accepted before and in initialization mode, later they are an error. States are start
values (`initial` exact). A step of co-simulation has any length and is divided into Runge-Kutta steps of at most
`Plant.inner` seconds. FMU states can be saved and serialized. There are no events and no directional derivatives.

    python -m tests.blind.fmu_build FOLDER      all sound FMUs, both versions, both ways
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import fmpy

HEADERS = Path(fmpy.__file__).with_name("c-code")
SOURCES = Path(__file__).with_name("fmus")
WAYS = ("model_exchange", "co_simulation")
FLAGS = "-shared -fPIC -std=gnu99 -O2 -w -s -fvisibility=hidden"
INPUT, STATE, RATE, READING, PARAMETER, TIME = 0, 100, 200, 300, 400, 999  # first value references
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
    """Name, start value, unit and description of a variable."""

    name: str
    start: float
    unit: str
    description: str = ""


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


def _rows(*texts: str) -> tuple[Variable, ...]:
    cells = [text.split(maxsplit=3) for text in texts]
    return tuple(Variable(name, float(start), unit, description) for name, start, unit, description in cells)


PLANTS: dict[str, Plant] = {  # each variable: name, start value, unit, description
    "drive": Plant(
        "Motor and load on an elastic shaft",
        _rows(
            "torque 0.0 N.m air gap torque",
        ),
        _rows(
            "motor.phi 0.0 rad angle of the motor",
            "motor.w 0.0 rad/s speed of the motor",
            "load.phi 0.0 rad angle of the load",
            "load.w 0.0 rad/s speed of the load",
        ),
        (
            "motor.phi",
            "motor.w",
            "load.phi",
        ),
        _rows(
            "motor.J 0.01 kg.m2 inertia of the motor",
            "load.J 0.03 kg.m2 inertia of the load",
            "shaft.c 40.0 N.m/rad stiffness of the shaft",
            "shaft.d 0.1 N.m.s/rad damping of the shaft",
            "motor.b 0.02 N.m.s/rad bearing of the motor",
        ),
        1e-3,
    ),
    "dc_motor": Plant(
        "DC motor with load torque",
        _rows(
            "voltage 0.0 V terminal voltage",
            "load_torque 0.0 N.m torque that brakes",
        ),
        _rows(
            "current 0.0 A armature current",
            "angle 0.0 rad angle of the shaft",
            "speed 0.0 rad/s speed of the shaft",
        ),
        (
            "current",
            "angle",
            "speed",
        ),
        _rows(
            "resistance 1.2 ohm of the winding",
            "inductance 6e-3 H of the winding",
            "constant 0.05 N.m/A torque constant",
            "inertia 2e-4 kg.m2 moment of inertia",
            "damping 1e-4 N.m.s/rad viscous friction",
        ),
        1e-3,
    ),
    "tanks": Plant(
        "Two tanks joined by a pipe",
        _rows(
            "pump_left 5.0 V voltage of the left pump",
            "pump_right 5.0 V voltage of the right pump",
        ),
        _rows(
            "left.h 0.3 m level in the left tank",
            "right.h 0.25 m level in the right tank",
        ),
        _rows("gauge_left 0.3 m level that is shown", "gauge_right 0.25 m level that is shown"),
        _rows(
            "left.area 0.02 m2 cross section",
            "right.area 0.02 m2 cross section",
            "pipe.k 1.2e-4 m2.5/s flow through the pipe at 1 m",
            "outlet.k 1.2e-4 m2.5/s flow out of the right tank at 1 m",
            "gain_left 6e-6 m3/(s.V) flow of the left pump",
            "gain_right 6e-6 m3/(s.V) flow of the right pump",
        ),
        0.5,
    ),
    "heated_box": Plant(
        "Heated box",
        _rows(
            "heater 0.0 1 share of the power",
            "T_room 295.0 K temperature of the room",
        ),
        _rows(
            "T_heater 295.0 K temperature of the heater",
            "T_air 295.0 K temperature of the air",
        ),
        (
            "T_heater",
            "T_air",
        ),
        _rows(
            "power 100.0 W power of the heater",
            "C_heater 120.0 J/K heat capacity of the heater",
            "C_air 300.0 J/K heat capacity of the air and the walls",
            "G_heater 3.0 W/K conductance from heater to air",
            "G_wall 1.5 W/K conductance to the room",
        ),
        0.5,
    ),
    "pendulum": Plant(
        "Cart on a spring with a hanging pendulum",
        _rows(
            "force 0.0 N force on the cart",
        ),
        _rows(
            "x 0.0 m position of the cart",
            "v 0.0 m/s velocity of the cart",
            "phi 0.0 rad angle of the pendulum, 0 when hanging",
            "w 0.0 rad/s rate of the pendulum",
        ),
        (
            "x",
            "v",
            "phi",
            "w",
        ),
        _rows(
            "cart 1.0 kg mass of the cart",
            "bob 0.25 kg mass of the bob",
            "length 0.5 m from hinge to bob",
            "spring 3.0 N/m stiffness that centres the cart",
            "rub 0.8 N.s/m viscous friction of the cart",
            "hinge 5e-3 N.m.s/rad viscous friction of the hinge",
        ),
        4e-3,
    ),
    "coupled": Plant(
        "Two pendulums joined by a torsion spring",
        _rows(
            "torque 0.0 N.m torque on the first",
        ),
        _rows(
            "phi1 0.0 rad angle of the first",
            "w1 0.0 rad/s rate of the first",
            "phi2 0.0 rad angle of the second",
            "w2 0.0 rad/s rate of the second",
        ),
        (
            "phi1",
            "phi2",
        ),
        _rows(
            "J1 0.1 kg.m2 inertia of the first",
            "J2 0.08 kg.m2 inertia of the second",
            "c1 1.0 N.m/rad torque of gravity on the first per sine of its angle",
            "c2 0.8 N.m/rad torque of gravity on the second per sine of its angle",
            "k 1.0 N.m/rad stiffness of the spring",
            "d1 0.03 N.m.s/rad viscous friction of the first",
            "d2 0.02 N.m.s/rad viscous friction of the second",
        ),
        4e-3,
    ),
    "cylinder": Plant(
        "Hydraulic cylinder with a valve",
        _rows(
            "valve 0.0 1 opening of the valve",
            "load 0.0 N force against the piston",
        ),
        _rows(
            "piston.x 0.0 m position of the piston",
            "piston.v 0.0 m/s velocity of the piston",
            "p_a 1e6 Pa pressure in chamber A",
            "p_b 1e6 Pa pressure in chamber B",
        ),
        (
            "piston.x",
            "piston.v",
            "p_a",
            "p_b",
        ),
        _rows(
            "mass 50.0 kg moved mass",
            "damping 800.0 N.s/m viscous friction",
            "spring 1.5e4 N/m stiffness of the load",
            "bulk 2e8 Pa bulk modulus of the oil",
            "valve.k 2e-7 m4/(s.N.5) flow of the open valve at 1 Pa",
            "supply 2e6 Pa supply pressure",
        ),
        5e-4,
    ),
}


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
    entries = {
        "modelDescription.xml": _description(plant, version, fault, ways).encode(),
        f"binaries/{_binary(plant, version)}": library(plant, version, fault),
    }
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in entries.items():
            archive.writestr(zipfile.ZipInfo(name, (2000, 1, 1, 0, 0, 0)), content)
    return path


def _binary(plant: str, version: int) -> str:
    """Return the path of the library of this machine below `binaries`."""
    system = {"win32": "windows"}.get(sys.platform, sys.platform)
    machine = {"AMD64": "x86_64", "arm64": "aarch64"}.get(platform.machine(), platform.machine())
    suffix = {"windows": ".dll", "darwin": ".dylib"}.get(system, ".so")
    of_two = {"linux": "linux64", "windows": "win64", "darwin": "darwin64"}[system]
    return f"{of_two if version == 2 and machine == 'x86_64' else f'{machine}-{system}'}/{plant}{suffix}"


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


def _declared(plant: Plant, fault: str) -> list[dict[str, Any]]:
    """Return the attributes of the variables in any version of FMI; `derivative` is the name of a state."""
    found: list[dict[str, Any]] = []

    def declare(name: str, reference: int, causality: str, v: Variable | None = None, **more: Any) -> None:
        told = {"description": v.description if v else f"rate of {more['derivative']}", "causality": causality}
        initial = more.pop("initial", "" if causality == "input" else "calculated")
        told |= {"variability": more.pop("variability", "continuous"), "initial": initial}
        unit = v.unit if v and fault != NO_UNITS else ""
        found.append({"name": name, "valueReference": reference, **told, "unit": unit, **more})

    for k, v in enumerate(plant.inputs):
        declare(v.name, INPUT + k, "input", v, start=v.start)
    for k, v in enumerate(plant.states):
        shown = "output" if v.name in plant.output_names else "local"
        declare(v.name, STATE + k, shown, v, start=v.start, initial="exact")
    for k, v in enumerate(plant.states):
        declare(f"der({v.name})", RATE + k, "local", derivative=v.name)
    for k, v in enumerate(plant.readings):
        declare(v.name, READING + k, "output", v)
    for k, v in enumerate(plant.parameters if fault != NO_PARAMETERS else ()):
        declare(v.name, PARAMETER + k, "parameter", v, start=v.start, initial="exact", variability="fixed")
    return found


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
    variables = _declared(plant, fault)
    number = {v["name"]: k if version == 2 else v["valueReference"] for k, v in enumerate(variables, start=1)}
    time = f'<Float64 name="time" valueReference="{TIME}" causality="independent" variability="continuous"/>'
    lines = [] if version == 2 else [time]
    for v in variables:
        told = v | ({"derivative": number[v["derivative"]]} if "derivative" in v else {})
        real = {key: told.pop(key, "") for key in ("unit", "start", "derivative")}
        if version == 2:
            lines.append(f"<ScalarVariable{_attributes(**told)}><Real{_attributes(**real)}/></ScalarVariable>")
        else:
            lines.append(f"<Float64{_attributes(**told, **real)}/>")
    outputs = [v for v in variables if v["name"] in plant.output_names]
    rates = [v for v in variables if "derivative" in v]
    unknown = [v for v in variables if "derivative" in v or (v in outputs and v["initial"] == "calculated")]
    structure = ""
    for tag, some in (("Output", outputs), ("Derivative", rates), ("InitialUnknown", unknown)):
        if version == 2:
            listed = "".join(f'<Unknown index="{number[v["name"]]}"/>' for v in some)
            structure += f"<{tag}s>{listed}</{tag}s>"
        else:
            tag = "ContinuousStateDerivative" if tag == "Derivative" else tag
            structure += "".join(f'<{tag} valueReference="{number[v["name"]]}"/>' for v in some)
    token = {"guid" if version == 2 else "instantiationToken": f"blind-{name}"}
    events = {"numberOfEventIndicators": 0} if version == 2 else {}
    head = _attributes(fmiVersion=f"{version}.0", modelName=name, **token, description=plant.title, **events)
    listed = "\n".join(lines)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription{head}>\n'
        f"{_ways(name, fault, ways, version)}\n{_units() if fault != NO_UNITS else ''}\n"
        f"<ModelVariables>\n{listed}\n</ModelVariables>\n<ModelStructure>{structure}</ModelStructure>\n"
        "</fmiModelDescription>\n"
    )


def main(arguments: Sequence[str]) -> int:
    folder = Path(arguments[0])
    folder.mkdir(parents=True, exist_ok=True)
    for plant in PLANTS:
        for version in (2, 3):
            print(build(folder / f"{plant}-fmi{version}.fmu", plant, version, ways=WAYS))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
