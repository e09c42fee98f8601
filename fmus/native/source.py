"""A native FMU without inputs: signals that step and ramp in time, printed as C and compiled.

The signals are printed as tables above `source.c`, which is FMI 2.0 around them.
"""

from __future__ import annotations

import hashlib
import platform
import re
import subprocess
import tempfile
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from fmus import __version__
from fmus.files import draft_of
from fmus.native.compiler import compiler
from fmus.units import parse, unit_definitions

EPOCH = (1980, 1, 1, 0, 0, 0)
SHELL = Path(__file__).with_name("source.c")
OPTIONS = ("-O2", "-std=c99", "-shared", "-fPIC", "-fvisibility=hidden", "-ffp-contract=off")
ALWAYS = -1e300  # [s]
PLATFORMS = {
    ("Linux", "x86_64"): ("linux64", ".so"),
    ("Linux", "aarch64"): ("aarch64-linux", ".so"),
    ("Darwin", "x86_64"): ("darwin64", ".dylib"),
    ("Darwin", "arm64"): ("darwin64", ".dylib"),
}


class NoCompiler(RuntimeError):
    """Why a source cannot be compiled."""


@dataclass(frozen=True)
class Change:
    """From a time `at` [s] on: from one value to another at `rate` a second, at once where that is 0."""

    at: float
    begin: float
    to: float
    rate: float = 0.0


@dataclass(frozen=True)
class TimeSignal:
    """An output as a function of time: what it is at first, and its changes in order of time."""

    unit: str
    begin: float
    changes: Sequence[Change]

    @property
    def pieces(self) -> tuple[Change, ...]:
        """With what it is at first as the first of its changes."""
        return (Change(ALWAYS, self.begin, self.begin), *self.changes)


def build_source(name: str, signals: Mapping[str, TimeSignal], path: Path) -> Path:
    """Write the FMU, whole or not at all; NoCompiler where it cannot be compiled here."""
    command, place = compiler(), PLATFORMS.get((platform.system(), platform.machine()))
    if command is None or place is None:
        what = (
            "no C compiler was found" if place is not None else f"{platform.system()} {platform.machine()} is not known"
        )
        raise NoCompiler(f"{what}; install one, or name it by CC")
    identifier = f"source_{re.sub(r'[^A-Za-z0-9_]', '_', name)}"
    body = tables(signals)
    shell = SHELL.read_text(encoding="utf-8")
    guid = hashlib.sha256((identifier + "".join(f"{n} {s.unit}\n" for n, s in signals.items()) + body + shell).encode())
    text = f'#define GUID "{{{guid.hexdigest()[:32]}}}"\n{body}\n{shell}'
    with tempfile.TemporaryDirectory(prefix="cosim-source-") as made:
        source, library = Path(made) / f"{identifier}.c", Path(made) / f"{identifier}{place[1]}"
        source.write_text(text, encoding="utf-8")
        full = [*command, *OPTIONS, "-o", str(library), str(source), "-lm"]
        try:
            subprocess.run(full, check=True, capture_output=True, timeout=120)
        except (OSError, subprocess.SubprocessError) as error:
            said = (getattr(error, "stderr", b"") or b"").decode("utf-8", "replace").strip().splitlines()
            raise NoCompiler(f"{command[0]} failed: {said[-1] if said else error}") from None
        members = {
            "modelDescription.xml": _description(name, identifier, guid.hexdigest()[:32], signals),
            f"sources/{source.name}": text.encode(),
            f"binaries/{place[0]}/{library.name}": library.read_bytes(),
        }
    with draft_of(path) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as archive:
        for member, data in members.items():
            archive.writestr(zipfile.ZipInfo(member, EPOCH), data, zipfile.ZIP_DEFLATED)
    return path


def tables(signals: Mapping[str, TimeSignal]) -> str:
    """The changes of all signals, as C."""
    changes = [change for signal in signals.values() for change in signal.pieces]
    columns = {
        "AT": [c.at for c in changes],
        "FROM": [c.begin for c in changes],
        "TO": [c.to for c in changes],
        "RATE": [c.rate for c in changes],
    }
    counts = ", ".join(str(len(signal.pieces)) for signal in signals.values())
    lines = [f"#define SIGNALS {len(signals)}", f"static const int COUNT[] = {{{counts}}};"]
    for name, column in columns.items():
        lines.append(f"static const double {name}[] = {{")
        lines += ["    " + ", ".join(v.hex() for v in column[k : k + 6]) + "," for k in range(0, len(column), 6)]
        lines.append("};")
    return "\n".join(lines)


def _description(name: str, identifier: str, guid: str, signals: Mapping[str, TimeSignal]) -> bytes:
    root = Element(
        "fmiModelDescription",
        fmiVersion="2.0",
        modelName=name,
        guid=f"{{{guid}}}",
        description="Signals that step and ramp in time",
        generationTool=f"cosim {__version__}",
        variableNamingConvention="structured",
        numberOfEventIndicators="0",
    )
    way = SubElement(
        root,
        "CoSimulation",
        modelIdentifier=identifier,
        needsExecutionTool="false",
        canHandleVariableCommunicationStepSize="true",
        canGetAndSetFMUstate="true",
        canSerializeFMUstate="true",
    )
    SubElement(SubElement(way, "SourceFiles"), "File", name=f"{identifier}.c")
    units = {signal.unit for signal in signals.values() if signal.unit and parse(signal.unit) is not None}
    if units:
        root.append(unit_definitions(units))
    variables = SubElement(root, "ModelVariables")
    structure = SubElement(root, "ModelStructure")
    listed = {part: SubElement(structure, part) for part in ("Outputs", "InitialUnknowns")}
    for k, (output, signal) in enumerate(signals.items()):
        variable = SubElement(
            variables,
            "ScalarVariable",
            name=output,
            valueReference=str(k),
            causality="output",
            variability="continuous",
            initial="calculated",
            description="A function of time",
        )
        SubElement(variable, "Real", {"unit": signal.unit} if signal.unit in units else {})
        for part in listed.values():
            SubElement(part, "Unknown", index=str(k + 1), dependencies="")
    indent(root)
    return bytes(tostring(root, encoding="UTF-8", xml_declaration=True))
