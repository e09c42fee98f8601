"""Refined FMUs: the original binary unchanged, and a small library that forwards every call and adds terms."""

from __future__ import annotations

import math
import shutil
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from math import prod
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.core.drafts import draft_of
from cosim.files.archive import DESCRIPTION, description_of
from cosim.fmi.description import REALS, read_description, scalars, states_of, takes_any_step
from cosim.fmi.fmu_build import archive_member, digest
from cosim.fmi.native.compiler import (
    PLATFORMS,
    CompilerFailed,
    NoCompiler,
    commands,
    fmi_headers,
    glibc_floor,
    library_of,
    this_platform,
)
from cosim.fmi.native.package import EXPORTS
from cosim.fmi.native.printing import number, quote
from cosim.fmi.wrapping.forwarding import forwarding_code, function_table
from cosim.fmi.wrapping.wrapped_description import CannotWrap, describe_wrapped, xml_of
from cosim.terms.code import TermCode

FOLDER = Path(__file__).resolve().parent
ORIGINAL = "resources/original/"  # the whole original inside the wrapped FMU
WRAPPER = "resources/wrapper/"  # the C code of the wrapper
KEPT = ("documentation/", "terminalsAndIcons/", "extra/", "model.png")  # members that are also in their own place
MOST_REFERENCE = 2**31 - 1  # some hosts take value references as signed
FLAGS = {"SHAPES": "shape_all", "PORTS": "port_inputs", "RATES": "added_rates", "READS": "readings"}


@dataclass(frozen=True)
class Wrapped:
    """A written wrapped FMU.

    Attributes:
        platforms: Platforms with a library, as named in FMI 2.0, and the oldest glibc of a Linux library.
        left_out: Platform folder of the original → reason why the wrapper has none.
        withdrawn: Interfaces and capabilities of the original that the wrapper does not have.
    """

    path: Path
    platforms: Mapping[str, str]
    left_out: Mapping[str, str]
    withdrawn: tuple[str, ...]


def wrap(
    original: Path, terms: TermCode, values: Mapping[str, float], out: Path, *, substep: float | None = None
) -> Wrapped:
    """Write an FMU that holds the original and adds terms, completely or not at all.

    Its platforms are those of the original, with this machine's compiled by its own compiler.

    Args:
        values: Start values of the terms' parameters, and of real variables of the original.
        substep: Longest step [s] in co-simulation over which forces and shaped inputs are held, if the original takes
            steps of any length; by default the communication step. Model exchange needs one for terms with memory.

    Raises:
        FmuError: The original is invalid.
        CannotWrap: The terms do not fit the original.
        NoCompiler: No platform of the original can be compiled for.
        CompilerFailed: Compilation failed.
    """
    about = read_description(original)
    if about.fmiVersion[0] not in "23":
        raise CannotWrap(f"{original.name} is FMI {about.fmiVersion}; terms are added to FMI 2.0 and 3.0")
    fmi = int(about.fmiVersion[0])
    interfaces = _interfaces(original.name, about, terms, substep)
    taken = sorted({int(v.valueReference) for v in about.modelVariables})
    first, count = (taken[-1] if taken else -1) + 1, len(terms.parameters)
    if first + count > MOST_REFERENCE:
        gaps = zip([-1, *taken], taken, strict=False)
        first = next(low + 1 for low, high in gaps if high - low > count)
    config = _config(original.name, about, terms, values, interfaces, first=first, substep=substep or 0.0)
    root, withdrawn = describe_wrapped(description_of(original), original.name, interfaces, terms, values, first)
    headers = {p.name: p.read_text(encoding="utf-8") for p in sorted(fmi_headers().glob(f"fmi{fmi}*.h"))}
    types = headers[f"fmi{fmi}FunctionTypes.h"]
    order = ["config.h", f"fmi{fmi}Functions.h", "functions.h", "loading.c", "terms.c", f"wrapper{fmi}.c", "forward.c"]
    texts = {
        "all.c": "#define _GNU_SOURCE\n" + "".join(f'#include "{name}"\n' for name in order),
        "functions.h": function_table(types),
        "forward.c": forwarding_code(types, fmi),
        "terms.c": f"/* Terms added to the original. */\n#include <math.h>\n\n{terms.source}\n",
        **headers,
    }
    sources = {name: text.encode() for name, text in texts.items()}
    sources |= {n: (FOLDER / n).read_bytes() for n in ("loading.c", "history.c", "wrapper.c", f"wrapper{fmi}.c")}
    with zipfile.ZipFile(original) as old:
        content = repr(sorted((m.filename, m.CRC, m.file_size) for m in old.infolist()))
        hashed = digest({**sources, "config.h": config.encode()}, xml_of(root) + content.encode())
        token_name, token = "guid" if fmi == 2 else "instantiationToken", f"{{{hashed[:32]}}}"
        config += f"#define OWN_TOKEN {quote(token)}\n#define ORIGINAL_TOKEN {quote(root.get(token_name, ''))}\n"
        root.set(token_name, token)
        members, platforms, left_out = _libraries(original.name, old.namelist(), interfaces, sources, config, fmi)
        members[DESCRIPTION] = xml_of(root)
        members |= {f"{WRAPPER}{name}": data for name, data in sources.items()}
        with draft_of(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as new:
            for name in sorted(members):
                new.writestr(archive_member(name), members[name])
            for member in old.infolist():
                _copy(old, member, new, ORIGINAL + member.filename)
                if member.filename.startswith(KEPT):
                    _copy(old, member, new, member.filename)
    return Wrapped(out, platforms, left_out, tuple(withdrawn))


def _interfaces(file: str, about: Any, terms: TermCode, substep: float | None) -> dict[str, str]:
    """Return interface → modelIdentifier of all interfaces in which the terms act; raise CannotWrap for none."""
    exchange, steps = about.modelExchange, about.coSimulation
    variables, names = {v.name for v in about.modelVariables}, [p.name for p in terms.parameters]
    if taken := [name for name in names if name in variables]:
        raise CannotWrap(f'{file} already has a variable "{taken[0]}"; a parameter of a term needs another name')
    if terms.delay and terms.delay not in names:
        raise CannotWrap(f'the delay "{terms.delay}" is no parameter of the terms')
    if substep is not None and not substep > 0:
        raise CannotWrap(f"the substep is {substep:g} s; give a positive number")
    if terms.directions and exchange.canBeInstantiatedOnlyOncePerProcess:
        raise CannotWrap(f"the terms need a second instance of {file}, which allows one instance in a process")
    states, found = [*scalars(states_of(about))], {}
    reads_states = "port_inputs" in terms.hooks or "added_rates" in terms.hooks
    if exchange is not None and (not reads_states or [*terms.states] == states):
        found["ModelExchange"] = str(exchange.modelIdentifier)
    if steps is not None and "added_rates" not in terms.hooks:
        found["CoSimulation"] = str(steps.modelIdentifier)
    if not found and exchange is not None:
        fault = f"the terms are for the states {', '.join(terms.states)}, but {file} has {', '.join(states)}"
        raise CannotWrap(f"{fault}; print them for this FMU")
    if not found:
        raise CannotWrap(f"the terms act on derivatives, and {file} has no model exchange")
    if "ModelExchange" in found and terms.memory and substep is None:
        raise CannotWrap("the terms have a memory, which model exchange needs a substep for; give a substep [s]")
    return found


def _config(
    file: str,
    about: Any,
    terms: TermCode,
    values: Mapping[str, float],
    interfaces: Iterable[str],
    *,
    first: int,
    substep: float,
) -> str:
    """Return config.h without the tokens and the path of the original's library: sizes and tables of variables."""
    variables, parameters = {v.name: v for v in about.modelVariables}, terms.parameters

    def references(names: Iterable[str]) -> list[int]:
        for name in names:
            if name not in variables:
                raise CannotWrap(f'{file} has no variable "{name}"')
            if variables[name].type not in REALS or variables[name].shape:
                raise CannotWrap(f"{name} of {file} is no real scalar; terms act on real scalars")
        return [int(variables[name].valueReference) for name in names]

    names = [p.name for p in parameters]
    own = {name: float(value) for name, value in values.items() if name not in names}
    dampings = [d.parameter for d in terms.directions]
    own = {name: own.get(name, float(variables[name].start or 0.0)) for name in dampings} | own
    rates = [unknown.variable for unknown in about.derivatives] if "ModelExchange" in interfaces else []
    rates = [] if any(v.shape for v in rates) else rates
    roles = {
        "input": references(terms.inputs),
        "output": references(terms.outputs),
        "rate": [int(v.valueReference) for v in rates],
        "own": references(own),
    }
    # places of a variable that is not only forwarded among inputs, outputs, derivatives and own values; its elements
    places: dict[int, dict[str, int]] = {}
    for role, found in roles.items():
        for k, reference in enumerate(found):
            places.setdefault(reference, {})[role] = k
    for v in about.modelVariables:
        if v.shape and v.type in REALS:
            places.setdefault(int(v.valueReference), {})["size"] = prod(v.shape)
    defaults = {"input": -1, "output": -1, "rate": -1, "own": -1, "size": 1}
    rows = [(f"{r}u", *(defaults | there).values()) for r, there in sorted(places.items())]
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
        "ANY_STEP": int(takes_any_step(about) and not may_pend),  # a pending step goes on in the background
        **{flag: int(hook in terms.hooks) for flag, hook in FLAGS.items()},
    }
    whole = {
        "INPUT_REFERENCE": roles["input"],
        "STATE_REFERENCE": references(terms.states) if "CoSimulation" in interfaces else [],
        "OUTPUT_REFERENCE": roles["output"],
        "OWN_REFERENCE": roles["own"],
    }
    real = {
        "INPUT_START": [float(variables[name].start or 0.0) for name in terms.inputs],
        "OWN_START": [*own.values()],
        "PARAMETER_START": [float(values.get(p.name, p.default)) for p in parameters],
        "PARAMETER_NEUTRAL": [math.nan if p.neutral is None else p.neutral for p in parameters],
    }
    direction = ""
    if terms.directions:
        # of each direction: damping with its place among own values, change, largest value; state, speed
        whole["DAMPING_REFERENCE"] = references(dampings)
        whole["DAMPING_OWN"] = [[*own].index(name) for name in dampings]
        whole["BRAKED"] = [d.state for d in terms.directions]
        real["DAMPING_CHANGE"] = [d.change for d in terms.directions]
        real["DAMPING_HIGH"] = [d.high for d in terms.directions]
        real["SPEED"] = [d.speed for d in terms.directions]
        direction = "#define library_direction(k, i, t, x, u, p) ((x)[NX * ((k) + 1) + (i)]) /* behind the states */\n"
    # Arrays end with one more element, because C has no empty arrays.
    tables = {f"unsigned int {name}": [f"{value}u" for value in row] for name, row in whole.items()}
    tables |= {f"double {name}": [number(value) for value in row] for name, row in real.items()}
    lines = [
        "/* The variables on which the terms act, and which FMU this is. */",
        "#include <math.h>",
        *(f"#define {name} {value}" for name, value in sizes.items()),
        *(
            f"static const unsigned int {n}[] = {{{', '.join([*(f'{r}u' for r in k), '0'])}}};"
            for n, k in whole.items()
        ),
        *(f"static const double {n}[] = {{{', '.join([*map(number, v), '0.0'])}}};" for n, v in real.items()),
        f"static const char *const PARAMETER_NAME[] = {{{', '.join([*map(quote, names), quote('')])}}};",
        "",
        "/* Places of a variable among inputs, outputs, derivatives and own values, and its elements. */",
        "typedef struct {",
        "    unsigned int reference;",
        "    int input, output, rate, own, size;",
        "} Special;",
        "",
        "static const Special SPECIAL[] = {",
        *(f"    {{{', '.join(map(str, row))}}}," for row in rows),
        "    {0, -1, -1, -1, -1, 1}};",
        "",
    ]
    return "\n".join(lines) + direction


def _libraries(
    file: str,
    names: Sequence[str],
    interfaces: Mapping[str, str],
    sources: Mapping[str, bytes],
    config: str,
    fmi: int,
) -> tuple[dict[str, bytes], dict[str, str], dict[str, str]]:
    """Return libraries by member, their platforms with glibc, and the folders left out with reasons."""
    folders: dict[str, list[str]] = {}
    for name in names:
        parts = PurePosixPath(name).parts
        if len(parts) == 3 and parts[0] == "binaries" and not name.endswith("/"):
            folders.setdefault(parts[1], []).append(parts[2])
    if not folders:
        identifiers = ", ".join(sorted({*interfaces.values()}))
        raise CannotWrap(f"{file} has no library for {identifiers}; there is nothing to wrap")
    known = {p.folder(fmi): p for p in PLATFORMS.values()}
    members: dict[str, bytes] = {}
    built: dict[str, str] = {}
    left_out: dict[str, str] = {}
    for folder, files in sorted(folders.items()):
        platform = known.get(folder)
        if platform is None:
            left_out[folder] = f"{folder} is not among the platforms to build for"
            continue
        libraries = [each for each in files if each.endswith(platform.suffix)]
        # A single library may have another name than its identifier.
        own = {i: i + platform.suffix for i in interfaces.values()}
        if missing := [i for i, library in own.items() if library not in libraries and len(libraries) != 1]:
            left_out[folder] = f"{folder} has no library for {missing[0]}"
            continue
        is_here, made = platform == this_platform(), {}
        try:
            (command,) = commands(() if is_here else (platform.name,)).values()
            for library in own.values():
                at = f"binaries/{folder}/{library if library in libraries else libraries[0]}"
                files_of_c = {**sources, "config.h": f"{config}#define ORIGINAL {quote(at)}\n".encode()}
                more = ("-lm", "-ldl") if platform.suffix == ".so" else ("-lm",)
                path = library_of(files_of_c, "all.c", command, EXPORTS[fmi], libraries=more)
                made[f"binaries/{folder}/{library}"] = path.read_bytes()
        except NoCompiler as error:
            left_out[folder] = error.args[0]
        except CompilerFailed as error:
            if is_here:
                raise
            left_out[folder] = str(error)
        else:
            members |= made
            built[platform.name] = glibc_floor(b"".join(made.values()))
    if not members:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
        raise NoCompiler(
            f"the refined FMU of {file} needs a small library around the original, and no platform of it can be "
            f"compiled for: {reasons}"
        )
    return members, built, left_out


def _copy(old: zipfile.ZipFile, member: zipfile.ZipInfo, new: zipfile.ZipFile, place: str) -> None:
    """Copy a member, of any size, with its date."""
    info = zipfile.ZipInfo(place, member.date_time)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, member.external_attr
    if member.is_dir():
        new.writestr(info, b"")
        return
    with old.open(member) as source, new.open(info, "w", force_zip64=member.file_size > 2**31) as target:
        shutil.copyfileobj(source, target)
