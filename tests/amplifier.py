"""FMUs y = gain·u whose gain comes from code that is found by its name: a library, a symbol, a Python module."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import pytest

from cosim.fmi.native.compiler import compiler
from tests.cart import built
from tests.compiled import pack

SOURCE = Path(__file__).with_name("amplifier.c")
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="amplifier" guid="amplifier">
  <CoSimulation modelIdentifier="amplifier" canHandleVariableCommunicationStepSize="true"/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="1"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="1" causality="output"><Real/></ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2" dependencies="1"/></Outputs>
    <InitialUnknowns><Unknown index="2" dependencies="1"/></InitialUnknowns></ModelStructure>
</fmiModelDescription>
"""
SLAVE = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real
{head}

class {name}(Fmi2Slave):
    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        self.u, self.y = 1.0, {gain}
        self.register_variable(Real("u", causality=Fmi2Causality.input))
        self.register_variable(Real("y", causality=Fmi2Causality.output))

    def do_step(self, current_time, step_size):
        self.y = {gain} * self.u
        return True
"""


def compiled(folder: Path, name: str, *sources: Path | str, flags: tuple[str, ...] = ()) -> Path:
    """Return a shared library; skip the test without a compiler."""
    command = compiler()
    if command is None or not sys.platform.startswith("linux"):
        pytest.skip("no C compiler for Linux")
    made = folder / name
    subprocess.run([*command, "-O0", "-w", "-shared", "-fPIC", "-o", made, *sources, *flags], check=True)
    return made


def with_library(
    path: Path, gain: float, *, name: str = "libgain.so", soname: str = "libgain.so", function: str = "amplified"
) -> Path:
    """The gain is in a library beside that of the FMU."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "gain.c").write_text(f"double {function}(double u) {{ return {gain} * u; }}\n")
        helper = compiled(folder, name, folder / "gain.c", flags=(f"-Wl,-soname,{soname}",))
        flags = (f"-L{folder}", f"-l:{name}", "-Wl,-rpath,$ORIGIN", f'-DOWN_NAME="{function}"')
        main = compiled(folder, "amplifier.so", SOURCE, flags=flags)
        # the loader looks for the file by the name that the library has in the process
        return pack(path, DESCRIPTION, main, {f"binaries/linux64/{soname}": helper.read_bytes()})


def as_library(path: Path, gain: float) -> Path:
    """The library of the FMU has the gain, and the name by which that of `with_library` is known."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "gain.c").write_text(f"double amplified(double u) {{ return {gain} * u; }}\n")
        flags = ("-Wl,-soname,libgain.so", '-DOWN_NAME="amplified"')
        return pack(path, DESCRIPTION, compiled(folder, "amplifier.so", SOURCE, folder / "gain.c", flags=flags))


def without_library(path: Path) -> Path:
    """The library that it needs is not in the FMU."""
    with tempfile.TemporaryDirectory() as place, zipfile.ZipFile(with_library(Path(place) / "whole.fmu", 1.0)) as whole:
        main = Path(place) / "amplifier.so"
        main.write_bytes(whole.read("binaries/linux64/amplifier.so"))
        return pack(path, DESCRIPTION, main)


def with_symbol(path: Path, gain: float) -> Path:
    """The gain is in a variable of a template of C++, which exists once in a process."""
    with tempfile.TemporaryDirectory() as place:
        folder, source = Path(place), Path(place) / "amplifier.cpp"
        head = f"template <typename T> T &held() {{ static T value = {gain}; return value; }}\n#define INLINE_GAIN\n"
        source.write_text(head + SOURCE.read_text())
        return pack(path, DESCRIPTION, compiled(folder, "amplifier.so", "-x", "c++", source))


def with_function(path: Path, name: str, gain: float, more: str = "") -> Path:
    """The gain is in a function of the FMU with a name that the process may have too."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "own.c").write_text(f"double {name}(double u) {{ return {gain} * u; }}\n{more}\n")
        flags = ("-fno-builtin", f'-DOWN_NAME="{name}"')
        return pack(path, DESCRIPTION, compiled(folder, "amplifier.so", SOURCE, folder / "own.c", flags=flags))


def with_module(path: Path, gain: float, *, name: str = "Amp", module: str = "helper") -> Path:
    """The gain is in a Python module beside the slave's."""
    return _slave(path, name, f"from {module} import GAIN", "GAIN", {f"{module}.py": f"GAIN = {gain}\n"})


def with_data(path: Path, gain: float) -> Path:
    """The gain is in a file that a Python module reads."""
    head = "from pathlib import Path\nGAIN = float(Path(__file__).with_name('gain.txt').read_text())"
    return _slave(path, "Amp", head, "GAIN", {"gain.txt": f"{gain}\n"})


def with_class(path: Path, gain: float) -> Path:
    """The gain is in the slave itself."""
    return _slave(path, "Amp", "", str(gain), {})


def _slave(path: Path, name: str, head: str, gain: str, files: dict[str, str]) -> Path:
    path.parent.mkdir(exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        for file, text in files.items():
            (folder / file).write_text(text)
        script = folder / f"{name.lower()}.py"
        script.write_text(SLAVE.format(head=head, name=name, gain=gain))
        return built(script, path, project_files=[folder / file for file in files])
