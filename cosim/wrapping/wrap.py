"""Refined FMUs: the original binary unchanged, and a small library that forwards every call and adds terms."""

from __future__ import annotations

import shutil
import zipfile
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import prod
from pathlib import Path, PurePosixPath
from typing import Any

from cosim.base.drafts import draft_of
from cosim.blocks.derivatives import REALS, scalars, states_of
from cosim.blocks.description import read_description, takes_any_step
from cosim.fmi.fmu_build import EPOCH, digest
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, commands, fmi_headers, library_of
from cosim.fmi.native.platforms import PLATFORMS, Platform, glibc_floor, this_platform
from cosim.storage.archive import DESCRIPTION, description_of
from cosim.terms.code import TermCode
from cosim.wrapping.forwarding import forwarding_code, function_table
from cosim.wrapping.wrapped_description import INPUT_SLOPES, OUTPUT_SLOPES, SLOPES, DescriptionEdit
from cosim.wrapping.wrapper_config import WrapperConfig

FOLDER = Path(__file__).resolve().parent
ORIGINAL = "resources/original/"  # the whole original inside the wrapped FMU
WRAPPER = "resources/wrapper/"  # the C code of the wrapper
KEPT = ("documentation/", "terminalsAndIcons/", "extra/", "model.png")  # members that are also in their own place
EXPORTS = {
    2: ("fmi2Instantiate", "fmi2DoStep", "fmi2GetReal"),
    3: ("fmi3InstantiateCoSimulation", "fmi3DoStep", "fmi3GetFloat64"),
}
MOST_REFERENCE = 2**31 - 1  # some hosts take value references as signed


class CannotWrap(ValueError):
    """Error: terms cannot be added to an FMU."""


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
    original: Path,
    terms: TermCode,
    values: Mapping[str, float],
    out: Path,
    *,
    substep: float | None = None,
    platforms: Sequence[str] = (),
) -> Wrapped:
    """Write an FMU that holds the original and adds terms, completely or not at all.

    Args:
        values: Start values of the terms' parameters, and of real variables of the original.
        substep: Longest step [s] in co-simulation over which forces and shaped inputs are held, if the original takes
            steps of any length; by default the communication step. Model exchange needs one for terms with memory.
        platforms: Names in `PLATFORMS`, all for the cross compiler if there is one, which also targets old versions of
            glibc; by default those of the original, with this machine's by its own compiler.

    Raises:
        FmuError: The original is invalid.
        CannotWrap: The terms do not fit the original.
        NoCompiler: No platform of the original can be compiled for.
        CompilerFailed: Compilation failed.
    """
    return Wrapper(original, terms, values, substep, tuple(platforms)).write(out)


@dataclass(frozen=True)
class Wrapper:
    """The parts of a wrapped FMU."""

    original: Path
    terms: TermCode
    values: Mapping[str, float]
    substep: float | None
    platforms: tuple[str, ...]

    @cached_property
    def about(self) -> Any:
        """Return FMPy's description of the original, of FMI 2.0 or 3.0."""
        about = read_description(self.original)
        if about.fmiVersion[0] not in "23":
            raise CannotWrap(f"{self.original.name} is FMI {about.fmiVersion}; terms are added to FMI 2.0 and 3.0")
        return about

    @property
    def fmi(self) -> int:
        """Return the major version of FMI."""
        return int(self.about.fmiVersion[0])

    @cached_property
    def variables(self) -> dict[str, Any]:
        """Return the original's variables by name."""
        return {v.name: v for v in self.about.modelVariables}

    # -- what the terms demand --------------------------------------------------------------------

    @property
    def acts_on_inputs(self) -> bool:
        """Return whether the terms change inputs."""
        return bool({"shape_all", "port_inputs"} & {*self.terms.hooks} or self.terms.delay)

    @property
    def needs_states(self) -> bool:
        """Return whether the terms read states."""
        return bool({"port_inputs", "added_rates"} & {*self.terms.hooks})

    @cached_property
    def interfaces(self) -> dict[str, str]:
        """Return interface → modelIdentifier of all interfaces in which the terms act."""
        exchange, steps = self.about.modelExchange, self.about.coSimulation
        states = [*scalars(states_of(self.about))]
        fits = not self.needs_states or [*self.terms.states] == states
        found = {}
        if exchange is not None and fits:
            found["ModelExchange"] = str(exchange.modelIdentifier)
        if steps is not None and "added_rates" not in self.terms.hooks:
            found["CoSimulation"] = str(steps.modelIdentifier)
        if not found and exchange is not None:
            names = ", ".join(self.terms.states), ", ".join(states)
            fault = (
                f"the terms are for the states {names[0]}, but {self.original.name} has {names[1]}; print them "
                "for this FMU"
            )
            raise CannotWrap(fault)
        if not found:
            raise CannotWrap(f"the terms act on derivatives, and {self.original.name} has no model exchange")
        return found

    def reference(self, name: str) -> int:
        """Return the value reference of a real scalar."""
        variable = self.variables.get(name)
        if variable is None:
            raise CannotWrap(f'{self.original.name} has no variable "{name}"')
        if variable.type not in REALS or variable.shape:
            raise CannotWrap(f"{name} of {self.original.name} is no real scalar; terms act on real scalars")
        return int(variable.valueReference)

    @cached_property
    def own(self) -> dict[str, float]:
        """Return values of the original's own variables."""
        ours = {p.name for p in self.terms.parameters}
        return {name: float(value) for name, value in self.values.items() if name not in ours}

    @cached_property
    def _dampings(self) -> dict[str, float]:
        """Return the parameter of each direction with its start value."""
        names = [d.parameter for d in self.terms.directions]
        return {name: self.own.get(name, float(self.variables[name].start or 0.0)) for name in names}

    def check(self) -> None:
        """Raise CannotWrap if terms do not fit."""
        file, names = self.original.name, [p.name for p in self.terms.parameters]
        if taken := [name for name in names if name in self.variables]:
            raise CannotWrap(f'{file} already has a variable "{taken[0]}"; a parameter of a term needs another name')
        if self.terms.delay and self.terms.delay not in names:
            raise CannotWrap(f'the delay "{self.terms.delay}" is no parameter of the terms')
        if self.substep is not None and not self.substep > 0:
            raise CannotWrap(f"the substep is {self.substep:g} s; give a positive number")
        if self.terms.directions and self.about.modelExchange.canBeInstantiatedOnlyOncePerProcess:
            raise CannotWrap(f"the terms need a second instance of {file}, which allows one instance in a process")
        if "ModelExchange" in self.interfaces and self.terms.memory and self.substep is None:
            raise CannotWrap("the terms have a memory, which model exchange needs a substep for; give a substep [s]")

    # -- parts --------------------------------------------------------------------------------------

    @cached_property
    def config(self) -> WrapperConfig:
        """Return the tables of the C code."""
        return WrapperConfig(
            terms=self.terms,
            values=self.values,
            first_parameter=self._first_parameter(),
            inputs={self.reference(n): float(self.variables[n].start or 0.0) for n in self.terms.inputs},
            states=self._references(self.terms.states) if "CoSimulation" in self.interfaces else [],
            rates=self._rates() if "ModelExchange" in self.interfaces else [],
            outputs=self._references(self.terms.outputs),
            own={self.reference(name): value for name, value in (self._dampings | self.own).items()},
            dampings=[self.reference(name) for name in self._dampings],
            sizes=self._sizes(),
            substep=self.substep or 0.0,
            any_step=takes_any_step(self.about) and not self._may_pend(),
        )

    def _references(self, names: Iterable[str]) -> list[int]:
        return [self.reference(name) for name in names]

    def _rates(self) -> list[int]:
        """Return the value references of the derivatives, if all of them are scalars."""
        rates = [unknown.variable for unknown in self.about.derivatives]
        return [] if any(v.shape for v in rates) else [int(v.valueReference) for v in rates]

    def _sizes(self) -> dict[int, int]:
        """Return value reference → number of elements of each real array."""
        arrays = (v for v in self.variables.values() if v.shape and v.type in REALS)
        return {int(v.valueReference): prod(v.shape) for v in arrays}

    def _may_pend(self) -> bool:
        """Return whether steps may go on in the background."""
        return bool(getattr(self.about.coSimulation, "canRunAsynchronuously", False))

    def _first_parameter(self) -> int:
        """Return the first of as many free value references as there are parameters."""
        taken = sorted({int(v.valueReference) for v in self.variables.values()})
        first, count = (taken[-1] if taken else -1) + 1, len(self.terms.parameters)
        if first + count <= MOST_REFERENCE:
            return first
        gaps = zip([-1, *taken], taken, strict=False)
        return next(low + 1 for low, high in gaps if high - low > count)

    def description(self) -> DescriptionEdit:
        """Return the model description with the original's token."""
        edit = DescriptionEdit(description_of(self.original), self.fmi)
        edit.keep_interfaces(self.interfaces)
        if any(self.values.get(p.name, p.default) != p.neutral for p in self.terms.parameters if p.neutral is not None):
            edit.withdraw(SLOPES)
        if self.acts_on_inputs:
            edit.withdraw(INPUT_SLOPES)
        if "readings" in self.terms.hooks:
            edit.withdraw(OUTPUT_SLOPES)
        if self.terms.memory or self.terms.delay:
            edit.require_completed_steps()
        if self.needs_states:
            edit.forget_dependencies(self.terms.inputs)
        if missing := edit.set_starts(self.own):
            raise CannotWrap(
                f"{missing[0]} of {self.original.name} has no start value; only variables with one take another"
            )
        edit.add_parameters(self.terms.parameters, self.config.first_parameter, self.values)
        return edit

    def sources(self) -> dict[str, bytes]:
        """Return the C sources without config.h."""
        headers = {p.name: p.read_text(encoding="utf-8") for p in sorted(fmi_headers().glob(f"fmi{self.fmi}*.h"))}
        types = headers[f"fmi{self.fmi}FunctionTypes.h"]
        order = ["config.h", f"fmi{self.fmi}Functions.h", "functions.h", "loading.c", "terms.c"]
        order += [f"wrapper{self.fmi}.c", "forward.c"]
        texts = {
            "all.c": "#define _GNU_SOURCE\n" + "".join(f'#include "{name}"\n' for name in order),
            "functions.h": function_table(types, self.fmi),
            "forward.c": forwarding_code(types, self.fmi),
            "terms.c": f"/* Terms added to the original. */\n#include <math.h>\n\n{self.terms.source}\n",
            **headers,
        }
        names = ("loading.c", "history.c", "wrapper.c", f"wrapper{self.fmi}.c")
        return {n: t.encode() for n, t in texts.items()} | {n: (FOLDER / n).read_bytes() for n in names}

    # -- platforms ----------------------------------------------------------------------------------

    def libraries(self, names: Iterable[str]) -> tuple[dict[Platform, dict[str, str]], dict[str, str]]:
        """Return platform → identifier → library of the original, and the folders left out with reasons."""
        folders = _folders_of_libraries(names)
        known = {p.folder(self.fmi): p for p in PLATFORMS.values()}
        found: dict[Platform, dict[str, str]] = {}
        left_out: dict[str, str] = {}
        for folder, files in sorted(folders.items()):
            if folder not in known or (self.platforms and known[folder].name not in self.platforms):
                left_out[folder] = f"{folder} is not among the platforms to build for"
                continue
            platform = known[folder]
            each = {i: _library(i, files, platform.suffix) for i in self.interfaces.values()}
            if missing := [i for i, file in each.items() if file is None]:
                left_out[folder] = f"{folder} has no library for {missing[0]}"
            else:
                found[platform] = {i: f"binaries/{folder}/{file}" for i, file in each.items()}
        return found, left_out

    def build(
        self, names: Sequence[str], tokens: tuple[str, str], sources: Mapping[str, bytes]
    ) -> tuple[dict[str, bytes], dict[str, str], dict[str, str]]:
        """Return libraries by member, their platforms with glibc, and the folders left out with reasons."""
        libraries, left_out = self.libraries(names)
        if not libraries and not left_out:
            identifier = ", ".join(sorted({*self.interfaces.values()}))
            raise CannotWrap(f"{self.original.name} has no library for {identifier}; there is nothing to wrap")
        members: dict[str, bytes] = {}
        built: dict[str, str] = {}
        for platform, originals in libraries.items():
            try:
                made = self._compile(platform, originals, tokens, sources)
            except NoCompiler as error:
                left_out[platform.folder(self.fmi)] = error.args[0]
            except CompilerFailed as error:
                if platform == this_platform():
                    raise
                left_out[platform.folder(self.fmi)] = str(error)
            else:
                members |= made
                built[platform.name] = glibc_floor(b"".join(made.values()))
        if not members:
            reasons = "; ".join(f"{name}: {reason}" for name, reason in left_out.items())
            raise NoCompiler(
                f"the refined FMU of {self.original.name} needs a small library around the original, and no "
                f"platform of it can be compiled for: {reasons}"
            )
        return members, built, left_out

    def _compile(
        self, platform: Platform, originals: Mapping[str, str], tokens: tuple[str, str], sources: Mapping[str, bytes]
    ) -> dict[str, bytes]:
        """Return the libraries of a platform by member."""
        command, made = self._command(platform), {}
        more = ("-lm", "-ldl") if platform.suffix == ".so" else ("-lm",)
        for identifier, library in originals.items():
            files = {**sources, "config.h": self.config.text(tokens, library).encode()}
            path = library_of(files, "all.c", command, EXPORTS[self.fmi], libraries=more)
            made[f"binaries/{platform.folder(self.fmi)}/{identifier}{platform.suffix}"] = path.read_bytes()
        return made

    def _command(self, platform: Platform) -> list[str]:
        """Return the compiler's command, or raise NoCompiler."""
        names = (platform.name,) if self.platforms or platform != this_platform() else ()
        (command,) = commands(names).values()
        return command

    def write(self, out: Path) -> Wrapped:
        """Write the wrapped FMU."""
        self.check()
        _ = self.config  # raises CannotWrap for variables that are not there
        edit, sources = self.description(), self.sources()
        original_token = edit.token
        edit.token = token = f"{{{self._digest(edit.bytes(), sources)[:32]}}}"
        with zipfile.ZipFile(self.original) as old:
            members, platforms, left_out = self.build(old.namelist(), (token, original_token), sources)
            members[DESCRIPTION] = edit.bytes()
            members |= {f"{WRAPPER}{name}": data for name, data in sources.items()}
            with draft_of(out) as draft, zipfile.ZipFile(draft, "w", zipfile.ZIP_DEFLATED) as new:
                for name in sorted(members):
                    new.writestr(_member(name), members[name])
                for member in old.infolist():
                    places = [ORIGINAL + member.filename]
                    places += [member.filename] if member.filename.startswith(KEPT) else []
                    for place in places:
                        _copy(old, member, new, place)
        return Wrapped(out, platforms, left_out, tuple(edit.withdrawn))

    def _digest(self, description: bytes, sources: dict[str, bytes]) -> str:
        with zipfile.ZipFile(self.original) as archive:
            content = repr(sorted((m.filename, m.CRC, m.file_size) for m in archive.infolist()))
        return digest({**sources, "config.h": self.config.text(("", ""), "").encode()}, description + content.encode())


def _folders_of_libraries(names: Iterable[str]) -> dict[str, list[str]]:
    """Return the files of each folder below `binaries`."""
    folders: dict[str, list[str]] = {}
    for name in names:
        parts = PurePosixPath(name).parts
        if len(parts) == 3 and parts[0] == "binaries" and not name.endswith("/"):
            folders.setdefault(parts[1], []).append(parts[2])
    return folders


def _library(identifier: str, files: Sequence[str], suffix: str) -> str | None:
    """Return the library of an identifier in a platform's folder. A single library may have another name."""
    libraries = [file for file in files if file.endswith(suffix)]
    if f"{identifier}{suffix}" in libraries:
        return f"{identifier}{suffix}"
    return libraries[0] if len(libraries) == 1 else None


def _member(name: str) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name, EPOCH)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    return info


def _copy(old: zipfile.ZipFile, member: zipfile.ZipInfo, new: zipfile.ZipFile, place: str) -> None:
    """Copy a member, of any size, with its date."""
    info = zipfile.ZipInfo(place, member.date_time)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, member.external_attr
    if member.is_dir():
        new.writestr(info, b"")
        return
    with old.open(member) as source, new.open(info, "w", force_zip64=member.file_size > 2**31) as target:
        shutil.copyfileobj(source, target)
