"""Native FMUs: generated C code of a model and common C code, compiled and packed. Equal inputs give equal bytes."""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from pathlib import Path
from typing import Any

from cosim.core.drafts import draft_of
from cosim.core.units import unit_of_rate
from cosim.core.version import __version__
from cosim.fmi.annotations import TOOL
from cosim.fmi.fmu_build import Recipe, digest, write_zip
from cosim.fmi.model_description import ASSETS, Description, describe, documentation
from cosim.fmi.native.check import check
from cosim.fmi.native.compiler import commands, fmi_headers, glibc_floor, library_of
from cosim.fmi.native.printing import ModelPrinter, variable_tables
from cosim.fmi.ports import Port
from cosim.model.model import Model

LOG_CATEGORIES = {
    "logStatusWarning": "conditions outside the model's range of validity",
    "logStatusError": "reasons for rejected calls",
}


@dataclass(frozen=True)
class Native:
    """Sources and data of a native FMU.

    Value references number the ports of `about` first, then the variables in `locals`.

    Attributes:
        body: Generated C code, which follows the tables of variables in `model.c`.
        sizes: Definitions of `config.h` beside the numbers of variables; those of `SIZE_MACROS` are 0 by default.
        parts: C files included after `model.c`.
        text: Documentation in HTML.
        locals: Variables for states, then their derivatives in the same order, memory, event indicators.
        dependencies: Output or derivative → names of the inputs and states on which it depends.
    """

    name: str
    about: Description
    body: str
    sizes: Mapping[str, object]
    parts: Mapping[str, bytes]
    text: str
    locals: tuple[Port, ...] = ()
    dependencies: Mapping[str, Sequence[str]] = field(default_factory=dict)


SIZE_MACROS = ("STATES", "MEMORIES", "KINKS", "RANGES", "EFFECTS", "OWN", "EXCHANGE")
FOLDER = Path(__file__).resolve().parent
COMMON_SOURCES = ("floating.h", "near.h", "rk4.h", "stiff.h", "model.h", "instance.c", "fmi.c")
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
class NativeFmu:
    """A built native FMU, with the oldest glibc that each Linux library accepts ("" for other platforms)."""

    path: Path
    floors: Mapping[str, str]

    @property
    def sentence(self) -> str:
        """Return a sentence on the archive and its platforms."""
        places = (f"{name} (glibc {floor} or later)" if floor else name for name, floor in self.floors.items())
        return f"built {self.path} for {', '.join(places)}"


def native_model(model: Model, recipe: Recipe, name: str) -> Native:
    """Return a model as a native FMU; raise UnprintableModel if the generated code differs from the model's Python."""
    printer = ModelPrinter(model, recipe.about.ports)
    body, sizes = printer.sources()
    check(model, printer)
    variables = [Port(f"{q.name}_state", "state", 0.0, q.unit, f"state: {q.doc}") for q in printer.states]
    for q in printer.states:
        unit = unit_of_rate(q.unit)
        variables.append(Port(f"der({q.name}_state)", "derivative", 0.0, unit, f"derivative: {q.doc}"))
    for effect, q in printer.remembering:
        variables.append(Port(f"{effect.name}.{q.name}_memory", "memory", 0.0, q.unit, f"remembered: {q.doc}"))
    for k in range(int(str(sizes["KINKS"]))):
        variables.append(Port(f"event_indicator_{k + 1}", "indicator", 0.0, "", "passes through zero at a kink"))
    # output or derivative → inputs and states on which it depends, for any active effects and Boolean parameters
    sources = defaultdict[str, set[str]](set)
    inputs, states = [q.name for q in model.inputs], [f"{q.name}_state" for q in printer.states]
    for trace in printer.variants:
        symbols = zip((*trace.s.state, *trace.s.command), (*states, *inputs), strict=True)
        reach = defaultdict[Any, set[str]](set, {symbol: {name} for symbol, name in symbols})

        def sources_of(expression: Any, reach: Mapping[Any, set[str]] = reach) -> set[str]:
            return set().union(*(reach[s] for s in expression.free_symbols))

        for block in (*trace.shaping, *trace.blocks):
            for symbol, e in (*block.values.items(), *block.dormant.items()):
                reach[symbol] |= sources_of(e)
        for q, e in zip(model.outputs, trace.outputs, strict=True):
            sources[q.name] |= sources_of(e)
        acting = dict(zip(inputs, trace.shaped, strict=True))
        for state, e in zip(states, trace.derivative, strict=True):
            direct = sources_of(e)  # a command here means the command after all effects
            sources[f"der({state})"] |= direct.union(*(sources_of(acting[n]) for n in direct & acting.keys()))
    dependencies = {output: sorted(direct) for output, direct in sources.items()}
    equations = {"equations.c": part("equations.c")}
    return Native(name, recipe.about, body, sizes, equations, recipe.text, tuple(variables), dependencies)


def part(name: str) -> bytes:
    """Return the content of a C file that all models share."""
    return (FOLDER / name).read_bytes()


def build_native(native: Native, path: Path, fmi: int = 2, platforms: Sequence[str] = ()) -> NativeFmu:
    """Write a native FMU completely or not at all.

    Args:
        platforms: Names in `PLATFORMS`; by default this machine's.

    Raises:
        NoCompiler: A compiler is missing.
        CompilerFailed: Compilation failed.
    """
    identifier, layer = f"{native.name}Native", f"fmi{fmi}.c"
    targets, is2 = commands(tuple(platforms)), fmi == 2
    order = ["model.c", "instance.c", *native.parts, layer]
    head = "/* One translation unit: nothing but FMI's own functions is seen from outside. */\n"
    headers = sorted(fmi_headers().glob(f"fmi{fmi}*.h"))

    state = "FMUstate" if is2 else "FMUState"
    common = {"modelIdentifier": identifier, "needsExecutionTool": "false"}
    common |= {f"canGetAndSet{state}": "true", f"canSerialize{state}": "true"}
    if is2:
        common["canNotUseMemoryManagementFunctions"] = "true"
    interfaces = {}
    if has_states := any(v.causality == "state" for v in native.locals):
        common["providesDirectionalDerivative" if is2 else "providesDirectionalDerivatives"] = "true"
        interfaces["ModelExchange"] = common
    any_step = str(native.about.variable_step).lower()
    interfaces["CoSimulation"] = common | {"canHandleVariableCommunicationStepSize": any_step}

    def description(guid: str) -> bytes:
        head = native.about, native.name, f"{TOOL} {__version__}", guid, interfaces, LOG_CATEGORIES
        return describe(*head, fmi=fmi, locals=native.locals, dependencies=native.dependencies)

    tables, texts = variable_tables(native.about.ports)
    causalities = Counter(port.causality for port in native.about.ports)
    sizes = {"VARIABLES": len(native.about.ports), "TEXTS": texts}
    sizes |= {"INPUTS": causalities["input"], "OUTPUTS": causalities["output"], **dict.fromkeys(SIZE_MACROS, 0)}

    def config(guid: str) -> bytes:
        defined = {**sizes, **native.sizes, "MODEL_GUID": f'"{guid}"'}
        lines = "".join(f"#define {name} {value}\n" for name, value in defined.items())
        return f"/* Sizes and identity of this model. */\n{lines}".encode()

    sources = {
        "all.c": (head + "".join(f'#include "{name}"\n' for name in order)).encode(),
        "model.c": f'#include "model.h"\n\n{tables}\n{native.body}'.encode(),
        **native.parts,
        **{name: part(name) for name in (*COMMON_SOURCES, layer)},
        **{file.name: file.read_text(encoding="utf-8").encode() for file in headers},  # lines end with LF
        "config.h": config(""),
    }
    guid = f"{{{digest(sources, description(''))[:32]}}}"
    sources["config.h"] = config(guid)
    members = {f"sources/{name}": data for name, data in sources.items()}
    if fmi == 3:
        members["sources/buildDescription.xml"] = BUILD_DESCRIPTION.format(identifier=identifier).encode()
    built = escape(", ".join(p.name for p in targets))
    text = f"<p>Compiled C, which needs no Python. Libraries for {built}; compile <code>sources/</code> elsewhere.</p>"
    way = f"FMI {fmi}.0 co-simulation{' and model exchange' if has_states else ''}"
    members |= documentation(native.about, text + native.text, guid, way)
    members["model.png" if is2 else "terminalsAndIcons/icon.png"] = (ASSETS / "model.png").read_bytes()
    floors = {}
    for platform, command in targets.items():
        library = library_of(sources, "all.c", command).read_bytes()
        members[f"binaries/{platform.folder(fmi)}/{identifier}{platform.suffix}"] = library
        floors[platform.name] = glibc_floor(library)
    members["modelDescription.xml"] = description(guid)
    with draft_of(path) as target:
        write_zip(target, members)
    return NativeFmu(path, floors)
