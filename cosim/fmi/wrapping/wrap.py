"""Refined FMUs: the unchanged original binary, and a small library that forwards every call and adds terms."""

from __future__ import annotations

import math
import re
import shutil
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from math import prod
from pathlib import Path, PurePosixPath
from typing import Any, NamedTuple
from xml.etree import ElementTree

from cosim.core.drafts import draft_of
from cosim.core.units import unit_definitions
from cosim.files.archive import DESCRIPTION, description_of
from cosim.fmi.description import read_description, scalars, states_of, takes_any_step
from cosim.fmi.fmi_types import DOUBLE_TYPES
from cosim.fmi.fmu_build import archive_member, digest
from cosim.fmi.model_description import set_unit_and_limits
from cosim.fmi.native.compiler import (
    PLATFORMS,
    CompilerFailed,
    NoCompiler,
    commands,
    fmi_headers,
    library_of,
    this_platform,
)
from cosim.fmi.native.printing import number, quote, table
from cosim.terms.code import TermCode

TYPEDEF = re.compile(r"typedef\s+([^;()]*?)\b(fmi[23]\w+)TYPE\s*\(([^;]*?)\)\s*;", re.DOTALL)
COMMENT = re.compile(r"/\*.*?\*/", re.DOTALL)
C_PARAMETER = re.compile(r"(?P<type>.*?[\s*])?(?P<name>\w+)\s*(?P<array>\[\])?", re.DOTALL)
# FMI functions that are hand-written in C, without prefix; the others are forwarded
HANDWRITTEN_FUNCTION = re.compile(
    r"^(?:DERIVATIVE\(|(?!static|typedef)[\w ]+[ *](?:fmi\d|FMI\())(\w+)\)?[(\n]", re.MULTILINE
)
# functions that do not need current inputs, so pending inputs are not sent before them
UNRELATED = ("Set", "Cancel", "Terminate", "EnterConfigurationMode", "ExitConfigurationMode")
GENERATED_COMMENT = "/* Generated from FMI's headers. */"


# -- C code that forwards FMI functions, from FMI's own headers ---------------------------------------


def function_table(header: str) -> str:
    """Return C code: a struct `Functions` of function pointers, and a table `SYMBOLS` of names and offsets."""
    names = [name for _, name, _ in TYPEDEF.findall(COMMENT.sub("", header))]
    table = [f"    {name}TYPE *{name[4:]};" for name in names]
    symbols = [f'    {{"{name}", offsetof(Functions, {name[4:]})}},' for name in names]
    head = [GENERATED_COMMENT, "typedef struct {", *table, "} Functions;", ""]
    head += ["static const struct {", "    const char *name;", "    size_t place;", "} SYMBOLS[] = {"]
    return "\n".join([*head, *symbols, "};", ""])


def forwarding_code(header: str, wrapper: str) -> str:
    """Return C code of all forwarded functions, which are all that the wrapper does not define.

    Pending inputs are sent to the original before a value is read from it.
    """
    functions, written = [GENERATED_COMMENT], {name.lower() for name in HANDWRITTEN_FUNCTION.findall(wrapper)}
    for result, name, text in TYPEDEF.findall(COMMENT.sub("", header)):
        plain = name[4:]
        if plain.lower() in written:
            continue
        parameters: list[str] = []
        for part in map(str.strip, text.split(",")):
            match = C_PARAMETER.fullmatch(part)
            if match is None or part == "void":
                continue
            is_named = match["type"] is not None and match["type"].strip() not in ("", "const")
            kind = match["type"] if is_named else f"{match['type'] or ''}{match['name']}"
            parameters.append(f"{' '.join(kind.split())} a{len(parameters)}{match['array'] or ''}")
        arguments = "".join(f", a{k}" for k in range(1, len(parameters)))
        call = f"FORWARD_SETTLED({plain}, (w->component{arguments}))"
        if plain.startswith(UNRELATED):
            call = f"FORWARD({plain}{arguments})"
        functions.append(f"{result.strip()} {name}({', '.join(parameters)})\n{{\n    {call};\n}}\n")
    return "\n".join(functions)


# -- the model description: that of the original with the parameters of the terms ---------------------

INTERFACE_TAGS = ("ModelExchange", "CoSimulation", "ScheduledExecution")
SLOPES = ("providesDirectionalDerivative", "providesDirectionalDerivatives", "providesAdjointDerivatives")
INPUT_SLOPES = ("canInterpolateInputs", "recommendedIntermediateInputSmoothness")
OUTPUT_SLOPES = ("maxOutputDerivativeOrder",)
STEP_FLAGS = {2: ("completedIntegratorStepNotNeeded", "false"), 3: ("needsCompletedIntegratorStep", "true")}


class CannotWrap(ValueError):
    """Terms or an output cannot be added to an FMU."""


class Indicator(NamedTuple):
    """The Boolean output `valid` of a wrapped FMU, which is true within the region of the logs.

    Attributes:
        source: C text with the macros `HAS_REGION` (0: `valid` is always false) and `LEAST_SAMPLE` (least time between
            the ends of a sample [s]), and `is_inside(begin, end, span, judged)`: whether a sample with these signals
            at its ends, `span` seconds apart, lies within the region. `judged`: a `Judged` kept between calls.
        signals: Names of the signals, continuous real inputs and outputs.
        rates: Signals whose values at the end of a sample matter.
    """

    source: str
    signals: tuple[str, ...]
    rates: tuple[str, ...]


VALID = "valid"
NO_REGION = """#define HAS_REGION 0
#define LEAST_SAMPLE 0.0
typedef int Judged;
#define is_inside(begin, end, span, judged) 0
"""
NO_INDICATOR = Indicator(NO_REGION, (), ())


def xml_of(root: Any) -> bytes:
    """Return the XML file of a root element of lxml."""
    from lxml import etree

    text: bytes = etree.tostring(root.getroottree(), encoding="UTF-8", xml_declaration=True)
    return text + b"\n"


def parsed(text: bytes) -> Any:
    """Return the root element of a model description, with its comments and annotations."""
    from lxml import etree

    return etree.fromstring(text, etree.XMLParser(resolve_entities=False, no_network=True))


def set_starts(root: Any, values: Mapping[str, float], file: str) -> None:
    """Set the start values of variables in a model description.

    Raises:
        CannotWrap: A variable has no start value in the file.
    """
    nodes = {node.get("name"): node for node in root.find("ModelVariables")}
    for name, value in values.items():
        node = nodes[name] if root.get("fmiVersion").startswith("3") else nodes[name].find("Real")
        if node.get("start") is None:
            raise CannotWrap(f"{name} of {file} has no start value; only existing start values can be changed")
        node.set("start", repr(float(value)))


def describe_wrapped(
    text: bytes, file: str, kept: Iterable[str], terms: TermCode, values: Mapping[str, float], first: int
) -> Any:
    """Return the root element of a wrapped FMU's model description. GUID or token is still the original one.

    Interfaces and capabilities that the wrapper does not support are removed. Comments and annotations stay.

    Args:
        kept: Interfaces in which the terms act.
        first: Value reference of the first parameter of the terms.
    """
    from lxml import etree

    root = parsed(text)
    fmi, parameters = int(root.get("fmiVersion")[0]), terms.parameters
    lost: list[str] = []
    if any(values.get(p.name, p.default) != p.neutral for p in parameters if p.neutral is not None):
        lost += SLOPES
    if "shape_all" in terms.hooks or "port_inputs" in terms.hooks or terms.delay:
        lost += INPUT_SLOPES
    if "readings" in terms.hooks:
        lost += OUTPUT_SLOPES
    interfaces = []
    for interface in [node for node in root if node.tag in INTERFACE_TAGS]:
        if interface.tag not in kept:
            root.remove(interface)
            continue
        interfaces.append(interface)
        etree.strip_elements(interface, "SourceFiles")  # of the original, not of the new library
        for name in lost:
            interface.attrib.pop(name, None)
        if interface.tag == "ModelExchange" and (terms.memory or terms.delay):
            interface.set(*STEP_FLAGS[fmi])  # the host must report each step of its solver
    variables, structure = root.find("ModelVariables"), root.find("ModelStructure")
    if structure is not None and ("port_inputs" in terms.hooks or "added_rates" in terms.hooks):
        # Forces change the dependencies of derivatives, and of outputs that depend on inputs. Without declared
        # dependencies, an unknown depends on everything. FMI 2.0 numbers a variable by its position, FMI 3.0 by its
        # value reference.
        declared = [node for node in variables if isinstance(node.tag, str)]
        numbers = {n.get("name"): str(k) if fmi == 2 else n.get("valueReference") for k, n in enumerate(declared, 1)}
        changed = {numbers[name] for name in terms.inputs}
        for unknown in structure.iter():
            dependencies = unknown.get("dependencies")
            is_rate = unknown.tag == "ContinuousStateDerivative" or unknown.getparent().tag == "Derivatives"
            if dependencies is not None and (is_rate or changed & set(dependencies.split())):
                for name in ("dependencies", "dependenciesKind"):
                    unknown.attrib.pop(name, None)
    set_starts(root, {name: values[name] for name in values.keys() - {p.name for p in parameters}}, file)
    units, group = {p.unit for p in parameters if p.unit}, root.find("UnitDefinitions")
    if group is None and units:
        interfaces[-1].addnext(group := etree.Element("UnitDefinitions"))
    for unit in unit_definitions(units - {unit.get("name") for unit in group}) if units else ():
        group.append(etree.fromstring(ElementTree.tostring(unit)))
    for k, p in enumerate(parameters):
        head = {"name": p.name, "valueReference": str(first + k), "description": p.doc, "causality": "parameter"}
        head |= {"variability": "fixed", "initial": "exact"}
        node = etree.SubElement(variables, "ScalarVariable" if fmi == 2 else "Float64", head)
        node = etree.SubElement(node, "Real") if fmi == 2 else node
        set_unit_and_limits(node, p.unit, p.bounds)
        node.set("start", repr(float(values.get(p.name, p.default))))
    return root


# -- the archive ----------------------------------------------------------------------------------------

FOLDER = Path(__file__).resolve().parent
ORIGINAL = "resources/original/"  # the whole original inside the wrapped FMU
WRAPPER = "resources/wrapper/"  # the C code of the wrapper
# members that are also in their own place
COPIED_MEMBERS = ("documentation/", "terminalsAndIcons/", "extra/", "model.png")
HOOK_MACROS = {"SHAPES": "shape_all", "PORTS": "port_inputs", "RATES": "added_rates", "READS": "readings"}


def wrap(
    original: Path,
    terms: TermCode,
    values: Mapping[str, float],
    out: Path,
    *,
    substep: float | None = None,
    indicator: Indicator | None = None,
) -> dict[str, str]:
    """Write an FMU that contains the original and adds terms, completely or not at all.

    The new FMU supports those platforms of the original for which a compiler exists. For this machine, the local
    compiler is used.

    Args:
        values: Start values of parameters of the terms, and of real variables of the original.
        substep: Longest substep [s] of co-simulation, during which forces and shaped inputs are constant, for an
            original that accepts any step; by default the communication step. In model exchange, terms with memory need
            a substep.
        indicator: Code of the output `valid`; None adds no such output.

    Returns:
        Platform folder of the original → reason why the wrapper has no library for it.

    Raises:
        FmuError: The original is invalid.
        CannotWrap: The terms do not fit the original.
        NoCompiler: There is no compiler for any platform of the original.
        CompilerFailed: Compilation failed.
    """
    about = read_description(original)
    if about.fmiVersion[0] not in "23":
        raise CannotWrap(f"{original.name} is FMI {about.fmiVersion}; only FMI 2.0 and 3.0 can be wrapped")
    fmi = int(about.fmiVersion[0])
    interfaces = _interfaces(original.name, about, terms)
    first = max((int(v.valueReference) for v in about.modelVariables), default=-1) + 1
    root = describe_wrapped(description_of(original), original.name, interfaces, terms, values, first)
    if indicator is not None:
        _declare_valid(root, original.name, about, indicator, first + len(terms.parameters))
    config = _config(about, terms, values, interfaces, first=first, substep=substep or 0.0, indicator=indicator)
    headers = {p.name: p.read_text(encoding="utf-8") for p in sorted(fmi_headers().glob(f"fmi{fmi}*.h"))}
    types = headers[f"fmi{fmi}FunctionTypes.h"]
    files = "loading.c", "history.c", "wrapper.c", f"wrapper{fmi}.c"
    own = {name: (FOLDER / name).read_text(encoding="utf-8") for name in files}
    order = ["config.h", f"fmi{fmi}Functions.h", "functions.h", "loading.c", "terms.c", "region.c"]
    order += [f"wrapper{fmi}.c", "forward.c"]
    texts = {
        "all.c": "#define _GNU_SOURCE\n" + "".join(f'#include "{name}"\n' for name in order),
        "functions.h": function_table(types),
        "forward.c": forwarding_code(types, own["wrapper.c"] + own[f"wrapper{fmi}.c"]),
        "terms.c": f"/* Terms added to the original. */\n#include <math.h>\n\n{terms.source}\n",
        "region.c": (indicator or NO_INDICATOR).source,
        **headers,
        **own,
    }
    sources = {name: text.encode() for name, text in texts.items()}
    with zipfile.ZipFile(original) as old:
        content = repr(sorted((m.filename, m.CRC, m.file_size) for m in old.infolist()))
        hashed = digest({**sources, "config.h": config.encode()}, xml_of(root) + content.encode())
        token_name, token = "guid" if fmi == 2 else "instantiationToken", f"{{{hashed[:32]}}}"
        config += f"#define OWN_TOKEN {quote(token)}\n#define ORIGINAL_TOKEN {quote(root.get(token_name, ''))}\n"
        root.set(token_name, token)
        members, left_out = _libraries(original.name, old.namelist(), interfaces, sources, config, fmi)
        members[DESCRIPTION] = xml_of(root)
        members |= {f"{WRAPPER}{name}": data for name, data in sources.items()}
        with draft_of(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as new:
            for name in sorted(members):
                new.writestr(archive_member(name), members[name])
            for member in old.infolist():
                _copy(old, member, new, ORIGINAL + member.filename)
                if member.filename.startswith(COPIED_MEMBERS):
                    _copy(old, member, new, member.filename)
    return left_out


def _interfaces(file: str, about: Any, terms: TermCode) -> dict[str, str]:
    """Return interface → modelIdentifier for all interfaces in which the terms act.

    Raise CannotWrap if there is none.
    """
    exchange, steps, names = about.modelExchange, about.coSimulation, {v.name for v in about.modelVariables}
    if taken := [p.name for p in terms.parameters if p.name in names]:
        raise CannotWrap(f'{file} already has a variable "{taken[0]}"; give the parameter of the term another name')
    if terms.directions and exchange.canBeInstantiatedOnlyOncePerProcess:
        raise CannotWrap(f"the terms need a second instance of {file}, which allows only one instance per process")
    found, reads_states = {}, "port_inputs" in terms.hooks or "added_rates" in terms.hooks
    if exchange is not None and (not reads_states or [*terms.states] == [*scalars(states_of(about))]):
        found["ModelExchange"] = str(exchange.modelIdentifier)
    if steps is not None and "added_rates" not in terms.hooks:
        found["CoSimulation"] = str(steps.modelIdentifier)
    if not found:
        states = ", ".join(terms.states)
        raise CannotWrap(
            f"the terms act on derivatives of {states}, but {file} has no model exchange with these states"
        )
    return found


def _declare_valid(root: Any, file: str, about: Any, indicator: Indicator, reference: int) -> None:
    """Add the output `valid`. It depends on what the outputs at the end of a sample depend on.

    Raises:
        CannotWrap: The FMU cannot have this output.
    """
    from lxml import etree

    scalar = {v.name for v in about.modelVariables if v.type in DOUBLE_TYPES and not v.shape}
    if any(v.name == VALID for v in about.modelVariables):
        raise CannotWrap(f'{file} already has a variable "{VALID}"; rename that variable in the tool that made the FMU')
    if unsuitable := [name for name in indicator.signals if name not in scalar]:
        raise CannotWrap(
            f"{unsuitable[0]} is no scalar real variable of {file}, which the output `{VALID}` needs. `cosim run` "
            "computes the validity of a run also without this output"
        )
    fmi, variables, structure = int(root.get("fmiVersion")[0]), root.find("ModelVariables"), root.find("ModelStructure")
    for exchange in root.findall("ModelExchange"):
        exchange.set(*STEP_FLAGS[fmi])  # a sample ends at a step of the host's solver
    head = {"name": VALID, "valueReference": str(reference), "causality": "output", "variability": "discrete"}
    head |= {"initial": "exact", "description": "true while inputs, outputs and rates are in the region of the logs"}
    node = etree.SubElement(variables, "ScalarVariable" if fmi == 2 else "Boolean", head)
    is_valid = "true" if indicator.signals else "false"
    (etree.SubElement(node, "Boolean") if fmi == 2 else node).set("start", is_valid)
    declared = [node for node in variables if isinstance(node.tag, str)]
    numbers = {n.get("name"): str(k) if fmi == 2 else n.get("valueReference") for k, n in enumerate(declared, 1)}
    group, tag, key = structure, "Output", "valueReference"
    if fmi == 2:
        group, tag, key = structure.find("Outputs"), "Unknown", "index"
        if group is None:
            structure.insert(0, group := etree.Element("Outputs"))
    outputs = group.findall(tag)
    known = {output.get(key): output.get("dependencies") for output in outputs}
    found = [known.get(numbers[name]) for name in indicator.rates]
    entry = etree.Element(tag, {key: numbers[VALID]})
    if None not in found:
        dependencies = {int(number) for text in found for number in str(text).split()}
        entry.set("dependencies", " ".join(map(str, sorted(dependencies))))
    group.insert(group.index(outputs[-1]) + 1 if outputs else 0, entry)


def _config(
    about: Any,
    terms: TermCode,
    values: Mapping[str, float],
    interfaces: Iterable[str],
    *,
    first: int,
    substep: float,
    indicator: Indicator | None,
) -> str:
    """Return config.h (sizes and tables of variables); tokens and the path of the original library are added later."""
    variables, parameters = {v.name: v for v in about.modelVariables}, terms.parameters

    def references(names: Iterable[str]) -> list[int]:
        return [int(variables[name].valueReference) for name in names]

    signals = indicator.signals if indicator else ()
    names, dampings = [p.name for p in parameters], [d.parameter for d in terms.directions]
    own = {name: float(variables[name].start or 0.0) for name in dampings}
    own |= {name: float(value) for name, value in values.items() if name not in names}
    rates = [unknown.variable for unknown in about.derivatives] if "ModelExchange" in interfaces else []
    roles = {
        "input": references(terms.inputs),
        "output": references(terms.outputs),
        "rate": [] if any(v.shape for v in rates) else [int(v.valueReference) for v in rates],
        "own": references(own),
    }
    # indices, among inputs, outputs, derivatives and own values, of variables that are not only forwarded; sizes
    places: dict[int, dict[str, int]] = {}
    for role, found in roles.items():
        for k, reference in enumerate(found):
            places.setdefault(reference, {})[role] = k
    for v in about.modelVariables:
        if v.shape and v.type in (*DOUBLE_TYPES, "Boolean"):
            places.setdefault(int(v.valueReference), {})["size"] = prod(v.shape)
    absent = {"input": -1, "output": -1, "rate": -1, "own": -1, "size": 1}
    rows = [f"{{{r}u, {', '.join(map(str, (absent | there).values()))}}}" for r, there in sorted(places.items())]
    may_pend = getattr(about.coSimulation, "canRunAsynchronuously", False)
    sizes = {
        "NU": len(terms.inputs),
        "NX": len(terms.states),
        "NY": len(terms.outputs),
        "NM": terms.memory,
        "NP": len(parameters) + 1,
        "PARAMETERS": len(parameters),
        "OWNS": len(own),
        "SPECIALS": len(places),
        "DIRECTIONS": len(dampings),
        "FIRST_PARAMETER": f"{first}u",
        "DELAY": f"({names.index(terms.delay) if terms.delay else -1})",
        "SUBSTEP": number(substep),
        "HAS_VALID": int(indicator is not None),
        "VALID_REFERENCE": f"{first + len(parameters)}u",
        "SIGNALS": len(signals),
        "ANY_STEP": int(takes_any_step(about) and not may_pend),  # a pending step continues in the background
        **{flag: int(hook in terms.hooks) for flag, hook in HOOK_MACROS.items()},
    }
    whole = {
        "INPUT_REFERENCE": roles["input"],
        "STATE_REFERENCE": references(terms.states) if "CoSimulation" in interfaces else [],
        "OUTPUT_REFERENCE": roles["output"],
        "OWN_REFERENCE": roles["own"],
        "SIGNAL_REFERENCE": references(signals),
    }
    real = {
        "INPUT_START": [variables[name].start or 0.0 for name in terms.inputs],
        "OWN_START": [*own.values()],
        "PARAMETER_START": [values.get(p.name, p.default) for p in parameters],
        "PARAMETER_NEUTRAL": [math.nan if p.neutral is None else p.neutral for p in parameters],
    }
    direction = ""
    if terms.directions:
        # per direction: index of the damping parameter among own values, change, upper limit; state, speed
        whole["DAMPING_REFERENCE"] = references(dampings)
        whole["DAMPING_OWN"] = [[*own].index(name) for name in dampings]
        whole["BRAKED"] = [d.state for d in terms.directions]
        real["DAMPING_CHANGE"] = [d.change for d in terms.directions]
        real["DAMPING_HIGH"] = [d.high for d in terms.directions]
        real["SPEED"] = [d.speed for d in terms.directions]
        direction = "#define library_direction(k, i, t, x, u, p) ((x)[NX * ((k) + 1) + (i)]) /* behind the states */\n"
    return "".join(
        [
            "/* The variables on which the terms act, and which FMU this is. */\n#include <math.h>\n",
            *(f"#define {name} {value}\n" for name, value in sizes.items()),
            *(table("unsigned int", name, (f"{reference}u" for reference in row)) for name, row in whole.items()),
            *(table("double", name, map(number, row)) for name, row in real.items()),
            table("char *const", "PARAMETER_NAME", map(quote, names)),
            "/* Places of a variable among inputs, outputs, derivatives and own values, and its elements. */\n",
            "typedef struct {\n    unsigned int reference;\n    int input, output, rate, own, size;\n} Special;\n",
            table("Special", "SPECIAL", rows),
            direction,
        ]
    )


def _libraries(
    file: str,
    names: Sequence[str],
    interfaces: Mapping[str, str],
    sources: Mapping[str, bytes],
    config: str,
    fmi: int,
) -> tuple[dict[str, bytes], dict[str, str]]:
    """Return member → content of the libraries, and original platform folder → reason for which it is left out."""
    folders: dict[str, list[str]] = {}
    for name in names:
        parts = PurePosixPath(name).parts
        if len(parts) == 3 and parts[0] == "binaries" and not name.endswith("/"):
            folders.setdefault(parts[1], []).append(parts[2])
    if not folders:
        identifiers = ", ".join(sorted({*interfaces.values()}))
        raise CannotWrap(f"{file} has no library for {identifiers}; it cannot be wrapped")
    known = {p.folder(fmi): p for p in PLATFORMS.values()}
    members: dict[str, bytes] = {}
    left_out: dict[str, str] = {}
    for folder, files in sorted(folders.items()):
        platform = known.get(folder)
        if platform is None:
            left_out[folder] = f"{folder} is not a supported platform"
            continue
        libraries = [each for each in files if each.endswith(platform.suffix)]
        own = {i + platform.suffix for i in interfaces.values()}
        if len(libraries) != 1 and (missing := sorted(own - {*libraries})):
            left_out[folder] = f"{folder} has no library {missing[0]}"
            continue
        is_here, made = platform == this_platform(), dict[str, bytes]()
        try:
            (command,) = commands(() if is_here else (platform.name,)).values()
            for library in own:
                # A single library may have a file name other than its modelIdentifier.
                at = f"binaries/{folder}/{library if library in libraries else libraries[0]}"
                files_of_c = {**sources, "config.h": f"{config}#define ORIGINAL {quote(at)}\n".encode()}
                more = ("-lm", "-ldl") if platform.suffix == ".so" else ("-lm",)
                path = library_of(files_of_c, "all.c", command, libraries=more)
                made[f"binaries/{folder}/{library}"] = path.read_bytes()
            members |= made
        except (NoCompiler, CompilerFailed) as error:
            if is_here and isinstance(error, CompilerFailed):
                raise
            left_out[folder] = str(error)
    if not members:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise NoCompiler(
            f"{file} needs a small library around its own, but none of its platforms can be compiled for: {reasons}"
        )
    return members, left_out


def _copy(old: zipfile.ZipFile, member: zipfile.ZipInfo, new: zipfile.ZipFile, place: str) -> None:
    """Copy a member, of any size, with its date."""
    info = zipfile.ZipInfo(place, member.date_time)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, member.external_attr
    if member.is_dir():
        new.writestr(info, b"")
        return
    with old.open(member) as source, new.open(info, "w", force_zip64=member.file_size > 2**31) as target:
        shutil.copyfileobj(source, target)
