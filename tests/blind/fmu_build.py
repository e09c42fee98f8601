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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path

import fmpy

HEADERS = Path(fmpy.__file__).with_name("c-code")
SOURCES = Path(__file__).with_name("fmus")
WAYS = ("model_exchange", "co_simulation")
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


V = Variable
PLANTS: dict[str, Plant] = {
    "drive": Plant(
        "Motor and load on an elastic shaft",
        (V("torque", 0.0, "N.m", "air gap torque"),),
        (
            V("motor.phi", 0.0, "rad", "angle of the motor"),
            V("motor.w", 0.0, "rad/s", "speed of the motor"),
            V("load.phi", 0.0, "rad", "angle of the load"),
            V("load.w", 0.0, "rad/s", "speed of the load"),
        ),
        ("motor.phi", "motor.w", "load.phi"),
        (
            V("motor.J", 0.01, "kg.m2", "inertia of the motor"),
            V("load.J", 0.03, "kg.m2", "inertia of the load"),
            V("shaft.c", 40.0, "N.m/rad", "stiffness of the shaft"),
            V("shaft.d", 0.1, "N.m.s/rad", "damping of the shaft"),
            V("motor.b", 0.02, "N.m.s/rad", "bearing of the motor"),
        ),
        1e-3,
    ),
    "dc_motor": Plant(
        "DC motor with load torque",
        (V("voltage", 0.0, "V", "terminal voltage"), V("load_torque", 0.0, "N.m", "torque that brakes")),
        (
            V("current", 0.0, "A", "armature current"),
            V("angle", 0.0, "rad", "angle of the shaft"),
            V("speed", 0.0, "rad/s", "speed of the shaft"),
        ),
        ("current", "angle", "speed"),
        (
            V("resistance", 1.2, "ohm", "of the winding"),
            V("inductance", 6e-3, "H", "of the winding"),
            V("constant", 0.05, "N.m/A", "torque constant"),
            V("inertia", 2e-4, "kg.m2", "moment of inertia"),
            V("damping", 1e-4, "N.m.s/rad", "viscous friction"),
        ),
        1e-3,
    ),
    "tanks": Plant(
        "Two tanks joined by a pipe",
        (V("pump_left", 5.0, "V", "voltage of the left pump"), V("pump_right", 5.0, "V", "voltage of the right pump")),
        (V("left.h", 0.3, "m", "level in the left tank"), V("right.h", 0.25, "m", "level in the right tank")),
        (V("gauge_left", 0.3, "m", "level that is shown"), V("gauge_right", 0.25, "m", "level that is shown")),
        (
            V("left.area", 0.02, "m2", "cross section"),
            V("right.area", 0.02, "m2", "cross section"),
            V("pipe.k", 1.2e-4, "m2.5/s", "flow through the pipe at 1 m"),
            V("outlet.k", 1.2e-4, "m2.5/s", "flow out of the right tank at 1 m"),
            V("gain_left", 6e-6, "m3/(s.V)", "flow of the left pump"),
            V("gain_right", 6e-6, "m3/(s.V)", "flow of the right pump"),
        ),
        0.5,
    ),
    "heated_box": Plant(
        "Heated box",
        (V("heater", 0.0, "1", "share of the power"), V("T_room", 295.0, "K", "temperature of the room")),
        (V("T_heater", 295.0, "K", "temperature of the heater"), V("T_air", 295.0, "K", "temperature of the air")),
        ("T_heater", "T_air"),
        (
            V("power", 100.0, "W", "power of the heater"),
            V("C_heater", 120.0, "J/K", "heat capacity of the heater"),
            V("C_air", 300.0, "J/K", "heat capacity of the air and the walls"),
            V("G_heater", 3.0, "W/K", "conductance from heater to air"),
            V("G_wall", 1.5, "W/K", "conductance to the room"),
        ),
        0.5,
    ),
    "pendulum": Plant(
        "Cart on a spring with a hanging pendulum",
        (V("force", 0.0, "N", "force on the cart"),),
        (
            V("x", 0.0, "m", "position of the cart"),
            V("v", 0.0, "m/s", "velocity of the cart"),
            V("phi", 0.0, "rad", "angle of the pendulum, 0 when hanging"),
            V("w", 0.0, "rad/s", "rate of the pendulum"),
        ),
        ("x", "v", "phi", "w"),
        (
            V("cart", 1.0, "kg", "mass of the cart"),
            V("bob", 0.25, "kg", "mass of the bob"),
            V("length", 0.5, "m", "from hinge to bob"),
            V("spring", 3.0, "N/m", "stiffness that centres the cart"),
            V("rub", 0.8, "N.s/m", "viscous friction of the cart"),
            V("hinge", 5e-3, "N.m.s/rad", "viscous friction of the hinge"),
        ),
        4e-3,
    ),
    "coupled": Plant(
        "Two pendulums joined by a torsion spring",
        (V("torque", 0.0, "N.m", "torque on the first"),),
        (
            V("phi1", 0.0, "rad", "angle of the first"),
            V("w1", 0.0, "rad/s", "rate of the first"),
            V("phi2", 0.0, "rad", "angle of the second"),
            V("w2", 0.0, "rad/s", "rate of the second"),
        ),
        ("phi1", "phi2"),
        (
            V("J1", 0.1, "kg.m2", "inertia of the first"),
            V("J2", 0.08, "kg.m2", "inertia of the second"),
            V("c1", 1.0, "N.m/rad", "torque of gravity on the first per sine of its angle"),
            V("c2", 0.8, "N.m/rad", "torque of gravity on the second per sine of its angle"),
            V("k", 1.0, "N.m/rad", "stiffness of the spring"),
            V("d1", 0.03, "N.m.s/rad", "viscous friction of the first"),
            V("d2", 0.02, "N.m.s/rad", "viscous friction of the second"),
        ),
        4e-3,
    ),
    "cylinder": Plant(
        "Hydraulic cylinder with a valve",
        (V("valve", 0.0, "1", "opening of the valve"), V("load", 0.0, "N", "force against the piston")),
        (
            V("piston.x", 0.0, "m", "position of the piston"),
            V("piston.v", 0.0, "m/s", "velocity of the piston"),
            V("p_a", 1e6, "Pa", "pressure in chamber A"),
            V("p_b", 1e6, "Pa", "pressure in chamber B"),
        ),
        ("piston.x", "piston.v", "p_a", "p_b"),
        (
            V("mass", 50.0, "kg", "moved mass"),
            V("damping", 800.0, "N.s/m", "viscous friction"),
            V("spring", 1.5e4, "N/m", "stiffness of the load"),
            V("bulk", 2e8, "Pa", "bulk modulus of the oil"),
            V("valve.k", 2e-7, "m4/(s.N.5)", "flow of the open valve at 1 Pa"),
            V("supply", 2e6, "Pa", "supply pressure"),
        ),
        5e-4,
    ),
}


@dataclass(frozen=True)
class Fault:
    """What an FMU does wrong: macros of the runtime, and changes of the description."""

    what: str
    macros: Mapping[str, str] = field(default_factory=dict)
    parameters: bool = True  # declared
    units: bool = True  # declared
    fixed_step: float = 0.0  # [s], declared


FAULTS: dict[str, Fault] = {
    "": Fault("nothing"),
    "forgets_parameters": Fault("entering initialization mode restores the default parameters", {"FORGETS": "1"}),
    "idle_reset": Fault("reset returns OK and changes neither states nor parameters", {"IDLE_RESET": "1"}),
    "leaks": Fault("every instance keeps 4 MB for ever", {"LEAKS": "(4 << 20)"}),
    "counts": Fault(
        "the last rate depends, by 1 %, on how often rates were asked since the library was loaded", {"COUNTS": "0.01"}
    ),
    "clock": Fault("as counts, but counting begins at the time of day", {"COUNTS": "0.01", "CLOCK": "1"}),
    "working_directory": Fault("rates depend, by up to 5 %, on the working directory", {"FOLDER": "0.05"}),
    "step_events": Fault("each completed integrator step asks for an event", {"EVENTS": "1"}),
    "time_events": Fault("a time event each millisecond", {"TICKS": "1e-3"}),
    "own_step": Fault(
        "steps of whole 0.05 s, one at least, whatever is asked; said so", {"OWN_STEP": "0.05"}, fixed_step=0.05
    ),
    "hidden_own_step": Fault("as own_step, but the description allows any step", {"OWN_STEP": "0.05"}),
    "no_parameters": Fault("no parameter is declared", parameters=False),
    "no_units": Fault("no unit is declared", units=False),
    "crashes": Fault(
        "abort() while the first parameter is above 1.05 times its start value", {"CRASHES": "FIRST * 1.05"}
    ),
    "hangs": Fault("hangs while the first parameter is above 1.05 times its start value", {"HANGS": "FIRST * 1.05"}),
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
    declared, wrong = PLANTS[plant], FAULTS[fault]
    write = _fmi2 if version == 2 else _fmi3
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        entries = {
            "modelDescription.xml": write(plant, declared, wrong, ways).encode(),
            f"binaries/{_binary(plant, version)}": library(plant, version, fault),
        }
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
    macros = [f"-D{name}={value}" for name, value in FAULTS[fault].macros.items()]
    command = [
        *shlex.split(os.environ.get("CC") or "cc"),
        "-shared",
        "-fPIC",
        "-std=gnu99",
        "-O2",
        "-w",
        "-s",
        "-fvisibility=hidden",
        f"-DFMI={version}",
        *macros,
    ]
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


@dataclass(frozen=True)
class _Declared:
    """A variable of the description, of any version of FMI."""

    name: str
    reference: int
    causality: str
    unit: str
    description: str
    start: float | None = None
    derivative: str = ""  # name of the state
    initial: str = ""
    variability: str = "continuous"


def _variables(plant: Plant, wrong: Fault) -> list[_Declared]:
    declared = [
        _Declared(v.name, INPUT + k, "input", v.unit, v.description, v.start) for k, v in enumerate(plant.inputs)
    ]
    for k, v in enumerate(plant.states):
        causality = "output" if v.name in plant.output_names else "local"
        declared.append(_Declared(v.name, STATE + k, causality, v.unit, v.description, v.start, initial="exact"))
    for k, v in enumerate(plant.states):
        declared.append(_Declared(f"der({v.name})", RATE + k, "local", "", f"rate of {v.name}", derivative=v.name))
    for k, v in enumerate(plant.readings):
        declared.append(_Declared(v.name, READING + k, "output", v.unit, v.description))
    if wrong.parameters:
        for k, v in enumerate(plant.parameters):
            kind = {"initial": "exact", "variability": "fixed"}
            declared.append(_Declared(v.name, PARAMETER + k, "parameter", v.unit, v.description, v.start, **kind))
    return declared


def _attributes(**given: object) -> str:
    return "".join(f' {name}="{value}"' for name, value in given.items() if value not in ("", None))


def _ways(plant: str, wrong: Fault, ways: Sequence[str], version: int) -> str:
    """Return the elements of the offered ways."""
    state, own = ("FMUstate", "") if version == 2 else ("FMUState", wrong.fixed_step or "")
    can = {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    steps = "false" if wrong.fixed_step else "true"
    elements = {
        "model_exchange": f"<ModelExchange{_attributes(modelIdentifier=plant, **can)}/>",
        "co_simulation": "<CoSimulation"
        + _attributes(
            modelIdentifier=plant, canHandleVariableCommunicationStepSize=steps, fixedInternalStepSize=own, **can
        )
        + "/>",
    }
    return "".join(elements[way] for way in WAYS if way in ways)


def _units(wrong: Fault) -> str:
    if not wrong.units:
        return ""
    units = []
    for name, exponents in UNITS.items():
        base = _attributes(**dict(word.split("=") for word in exponents.split()))
        units.append(f'<Unit name="{name}">{f"<BaseUnit{base}/>" if base or name == "1" else ""}</Unit>')
    return f"<UnitDefinitions>{''.join(units)}</UnitDefinitions>"


def _fmi2(name: str, plant: Plant, wrong: Fault, ways: Sequence[str]) -> str:
    variables = _variables(plant, wrong)
    index = {v.name: k for k, v in enumerate(variables, start=1)}
    lines = []
    for v in variables:
        head = _attributes(
            name=v.name, valueReference=v.reference, description=v.description, causality=v.causality,
            variability=v.variability, initial=v.initial or ("calculated" if v.causality != "input" else ""),
        )  # fmt: skip
        unit = v.unit if wrong.units else ""
        real = _attributes(unit=unit, start=v.start, derivative=index[v.derivative] if v.derivative else "")
        lines.append(f"<ScalarVariable{head}><Real{real}/></ScalarVariable>")
    outputs, rates, unknown = _structure(plant, variables)
    listed = {
        tag: "".join(f'<Unknown index="{index[v.name]}"/>' for v in some)
        for tag, some in (("Outputs", outputs), ("Derivatives", rates), ("InitialUnknowns", unknown))
    }
    structure = "".join(f"<{tag}>{text}</{tag}>" for tag, text in listed.items())
    head = _attributes(fmiVersion="2.0", modelName=name, guid=f"blind-{name}", description=plant.title)
    return _document(
        f'{head} numberOfEventIndicators="0"', _ways(name, wrong, ways, 2), _units(wrong), lines, structure
    )


def _fmi3(name: str, plant: Plant, wrong: Fault, ways: Sequence[str]) -> str:
    variables = _variables(plant, wrong)
    reference = {v.name: v.reference for v in variables}
    lines = [f'<Float64 name="time" valueReference="{TIME}" causality="independent" variability="continuous"/>']
    for v in variables:
        lines.append(
            "<Float64"
            + _attributes(
                name=v.name, valueReference=v.reference, description=v.description, causality=v.causality,
                variability=v.variability, initial=v.initial or ("calculated" if v.causality != "input" else ""),
                unit=v.unit if wrong.units else "", start=v.start, derivative=reference.get(v.derivative, ""),
            )
            + "/>"
        )  # fmt: skip
    outputs, rates, unknown = _structure(plant, variables)
    structure = "".join(
        f'<{tag} valueReference="{v.reference}"/>'
        for tag, some in (("Output", outputs), ("ContinuousStateDerivative", rates), ("InitialUnknown", unknown))
        for v in some
    )
    head = _attributes(fmiVersion="3.0", modelName=name, instantiationToken=f"blind-{name}", description=plant.title)
    return _document(head, _ways(name, wrong, ways, 3), _units(wrong), lines, structure)


def _structure(
    plant: Plant, variables: Sequence[_Declared]
) -> tuple[list[_Declared], list[_Declared], list[_Declared]]:
    """Return outputs, derivatives and initial unknowns."""
    outputs = [v for v in variables if v.name in plant.output_names]
    rates = [v for v in variables if v.derivative]
    return outputs, rates, [v for v in variables if v.derivative or (v in outputs and not v.initial)]


def _document(head: str, ways: str, units: str, variables: Sequence[str], structure: str) -> str:
    listed = "\n".join(variables)
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<fmiModelDescription{head}>\n{ways}\n{units}\n'
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
