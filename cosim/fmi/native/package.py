"""Native FMUs: a model's C within common code, compiled and packed, byte-reproducible."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cosim.base.drafts import draft_of
from cosim.base.scratch import temporary_folder
from cosim.base.version import __version__
from cosim.fmi.documentation import GUID_PLACEHOLDER, write_documentation
from cosim.fmi.fmu_build import ASSETS, Recipe, digest, write_zip
from cosim.fmi.native.check import Check
from cosim.fmi.native.compiler import commands, fmi_headers, library_of
from cosim.fmi.native.layout import VariableLayout, model_layout
from cosim.fmi.native.native_description import description2, description3
from cosim.fmi.native.platforms import PLATFORMS, Platform, glibc_floor
from cosim.fmi.native.printing import GeneratedSources, ModelPrinter
from cosim.model.model import Model

FOLDER = Path(__file__).resolve().parent
COMMON = ("floating.h", "near.h", "rk4.h", "stiff.h", "model.h", "instance.c", "fmi.c")
WAYS = {2: "FMI 2.0", 3: "FMI 3.0"}
EXPORTS = {
    2: ("fmi2Instantiate", "fmi2DoStep", "fmi2GetReal"),
    3: ("fmi3InstantiateCoSimulation", "fmi3DoStep", "fmi3GetFloat64"),
}
BUILD_DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiBuildDescription fmiVersion="3.0">
  <BuildConfiguration modelIdentifier="{identifier}">
    <SourceFileSet language="C99" compilerOptions="-ffp-contract=off">
      <SourceFile name="all.c"/>
    </SourceFileSet>
    <Library name="m" external="true"/>
  </BuildConfiguration>
</fmiBuildDescription>
"""


@dataclass(frozen=True)
class Native:
    """Everything needed for a native FMU: layout, generated code and further C.

    Attributes:
        parts: C files to follow the generated `model.c`.
    """

    name: str
    layout: VariableLayout
    printed: GeneratedSources
    parts: Mapping[str, bytes]
    text: str


@dataclass(frozen=True)
class Built:
    """A written FMU, and the oldest glibc of each Linux library in it, "" for further platforms."""

    path: Path
    floors: Mapping[str, str]


def native_model(model: Model, recipe: Recipe, name: str) -> Native:
    """Return a model for a native FMU, checked against its Python; raise UnprintableModel on failure."""
    printer = ModelPrinter(model, recipe.about.ports)
    printed = printer.sources()
    Check(model, printer).run()
    layout = model_layout(printer, recipe.about, int(str(printed.sizes["KINKS"])))
    return Native(name, layout, printed, {"equations.c": part("equations.c")}, recipe.text)


def part(name: str) -> bytes:
    """Return a C file common to all models."""
    return (FOLDER / name).read_bytes()


def build_native(native: Native, path: Path, fmi: int = 2, platforms: Sequence[str] = ()) -> Built:
    """Write a native FMU completely or not at all.

    Args:
        platforms: Names in `PLATFORMS`; by default this machine's.

    Raises:
        NoCompiler: A compiler is missing.
        CompilerFailed: Compilation failed.
    """
    identifier = f"{native.name}Native"
    targets = commands(tuple(platforms))
    sources = _sources(native, fmi)
    describe = description2 if fmi == 2 else description3

    def description(guid: str) -> bytes:
        return describe(native.layout, native.name, identifier, __version__, guid)

    guid = f"{{{digest(sources, description(''))[:32]}}}"
    sources["config.h"] = _config(native, guid)
    members = {f"sources/{name}": data for name, data in sources.items()}
    if fmi == 3:
        members["sources/buildDescription.xml"] = BUILD_DESCRIPTION.format(identifier=identifier).encode()
    members |= _documentation(native, fmi, guid, [*targets])
    if (icon := ASSETS / "model.png").exists():
        members["model.png" if fmi == 2 else "terminalsAndIcons/icon.png"] = icon.read_bytes()
    floors = {}
    for platform, command in targets.items():
        library = library_of(sources, "all.c", command, EXPORTS[fmi]).read_bytes()
        members[f"binaries/{platform.folder(fmi)}/{identifier}{platform.suffix}"] = library
        floors[platform.name] = glibc_floor(library)
    members["modelDescription.xml"] = description(guid)
    with draft_of(path) as target:
        write_zip(target, members)
    return Built(path, floors)


def _sources(native: Native, fmi: int) -> dict[str, bytes]:
    """Return all C sources, without the GUID."""
    layer = f"fmi{fmi}.c"
    headers = sorted(fmi_headers().glob(f"fmi{fmi}*.h"))
    order = ["model.c", "instance.c", *native.parts, layer]
    head = "/* One translation unit: nothing but FMI's own functions is seen from outside. */\n"
    every = head + "".join(f'#include "{name}"\n' for name in order)
    return {
        "all.c": every.encode(),
        "model.c": f'#include "model.h"\n\n{native.printed.body}'.encode(),
        **native.parts,
        **{name: part(name) for name in (*COMMON, layer)},
        **{file.name: file.read_text(encoding="utf-8").encode() for file in headers},  # lines end with LF
        "config.h": _config(native, ""),
    }


def _config(native: Native, guid: str) -> bytes:
    sizes = {**native.printed.sizes, "MODEL_GUID": f'"{guid}"'}
    lines = [f"#define {name} {value}" for name, value in sizes.items()]
    return ("/* How large this model is, and which it is. */\n" + "\n".join(lines) + "\n").encode()


def _documentation(native: Native, fmi: int, guid: str, built: Sequence[Platform]) -> dict[str, bytes]:
    platforms = ", ".join(p.name for p in built)
    others = ", ".join(p.name for p in PLATFORMS.values() if p not in built)
    ways = "co-simulation and model exchange" if native.layout.of("state") else "co-simulation"
    text = f"<p>Native: compiled C, which needs no Python. Libraries for {escape(platforms)}"
    if others:
        text += f"; none for {escape(others)}, for which the C in <code>sources/</code> is to be compiled"
    text += f".</p>{native.text}"
    with temporary_folder("build") as folder:
        licence = ASSETS / "license.txt"
        write_documentation(folder, native.layout.about, text, __version__, licence, f"{WAYS[fmi]} {ways}")
        pages = {f"documentation/{file.name}": file.read_bytes() for file in sorted(folder.iterdir())}
    index = "documentation/index.html"
    pages[index] = pages[index].replace(GUID_PLACEHOLDER.encode(), guid.encode())
    return pages
