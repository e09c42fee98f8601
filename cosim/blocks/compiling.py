"""Compilation of FMU sources without a library for this platform, with the user's permission.

Sources are programs of other people. They are compiled only with the option `--compile` or the Python argument
`compile=True`. `permission` stores the choice, and each FMU passes it to its worker process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, TypeVar

from cosim.core.drafts import draft_of
from cosim.core.errors import FmuError
from cosim.fmi.description import C_ENDINGS, CPP_ENDINGS, library_file
from cosim.fmi.native.compiler import CompilerFailed, NoCompiler, fmi_headers, library_command, library_of

SOURCES_FOLDER = "sources"
FMU_COMPILE_LIMIT_S = 300.0  # time limit [s] of the compiler per FMU
MAX_COMPILER_LINES, MAX_COMPILER_LINE_CHARACTERS = 20, 200  # excerpt of the compiler output: lines, characters per line
OPTIMIZED = ("-O3", "-DNDEBUG", "-w")
PLAIN_NAMES = ("-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX")  # names of shared libraries
LANGUAGES = (
    "C89:gnu90 C90:gnu90 C99:gnu99 C11:gnu11 C17:gnu17 C18:gnu17 C23:gnu2x C++98:gnu++98 C++03:gnu++03 "
    "C++11:gnu++11 C++14:gnu++14 C++17:gnu++17 C++20:gnu++20 C++23:gnu++2b"
)
STANDARDS = dict(language.split(":") for language in LANGUAGES.split())  # name in FMI → compiler option
ENTRY = {"1": "{identifier}_fmiGetVersion", "2": "fmi2GetVersion", "3": "fmi3GetVersion"}
permission: ContextVar[bool] = ContextVar("compile the sources of FMUs", default=False)
Answer = TypeVar("Answer")


@contextmanager
def compiling(allowed: bool) -> Iterator[None]:
    """Allow or forbid compilation of sources within a `with` block."""
    token = permission.set(allowed)
    try:
        yield
    finally:
        permission.reset(token)


def with_permission(allowed: bool, function: Callable[..., Answer], *arguments: Any) -> Answer:
    """Call a function with the permission to compile that another process has."""
    with compiling(allowed):
        return function(*arguments)


def compile_library(folder: Path, description: Any, identifier: str) -> Path:
    """Compile the sources of an unpacked FMU, or take the library from the cache.

    Returns:
        Path of the library, in the FMU's folder.

    Raises:
        FmuError: The sources are incomplete or do not compile.
    """
    root = folder / SOURCES_FOLDER
    try:
        names, options, includes = _declared_sources(root, description, identifier)
        for name in (*names, *includes):
            if not (root / name).resolve().is_relative_to(root.resolve()):
                raise FmuError(f'its sources cannot be compiled: "{name[:60]}" lies outside its folder')
        if not names:
            raise FmuError(
                "its sources cannot be compiled: it has no C or C++ file in its folder `sources`; export it again "
                "with its sources"
            )
        if missing := [name for name in names if not (root / name).is_file()]:
            raise FmuError(
                f"its sources cannot be compiled: {', '.join(missing)} of its list is missing; export it again "
                "with all its sources"
            )
        folders = (SOURCES_FOLDER, *(f"{SOURCES_FOLDER}/{name}" for name in includes), fmi_headers())
        *first, last = (f"{SOURCES_FOLDER}/{name}" for name in names)
        command = [*library_command(), *OPTIMIZED, *PLAIN_NAMES, *options, *(f"-I{part}" for part in folders), *first]
        libraries = ["-lm", *(["-lstdc++"] if any(name.lower().endswith(CPP_ENDINGS) for name in names) else [])]
        entry = ENTRY[description.fmiVersion[0]].format(identifier=identifier)
        paths = sorted(path for path in root.rglob("*") if path.is_file())
        files = {path.relative_to(folder).as_posix(): path.read_bytes() for path in paths}
        binary = library_of(files, last, command, [entry], libraries=libraries, limit=FMU_COMPILE_LIMIT_S).read_bytes()
    except NoCompiler as error:
        raise FmuError(f"its sources cannot be compiled: {error}") from None
    except CompilerFailed as error:
        lines = error.output.splitlines()
        more = [f"… and {len(lines) - MAX_COMPILER_LINES} lines more"] if len(lines) > MAX_COMPILER_LINES else []
        excerpt = "".join(f"\n  {line[:MAX_COMPILER_LINE_CHARACTERS]}" for line in [*lines[:MAX_COMPILER_LINES], *more])
        raise FmuError(f"its sources do not compile: {error}{excerpt}") from None
    library = library_file(folder, description, identifier)
    with draft_of(library) as draft:
        draft.write_bytes(binary)
    return library


def _declared_sources(root: Path, description: Any, identifier: str) -> tuple[list[str], list[str], list[str]]:
    """Return the files to compile, the options of the compiler, and the folders of headers.

    If the library has no build description of its own, the first one applies. Without build descriptions, `all.c` is
    compiled or, if it is missing, all files.
    """
    builds = sorted(description.buildConfigurations, key=lambda build: build.modelIdentifier != identifier)
    sets = builds[0].sourceFileSets if builds else []
    if not sets:
        names = sorted(p.name for p in root.glob("*") if p.suffix.lower() in (*C_ENDINGS, *CPP_ENDINGS))
        return ["all.c"] if (root / "all.c").is_file() else names, [], []
    languages = [part.language for part in sets if part.language]
    for language in languages:
        if language not in STANDARDS:
            raise FmuError(f"its sources cannot be compiled: they are in {language}; supported: {', '.join(STANDARDS)}")
    options = [f"-std={STANDARDS[languages[-1]]}"] if languages else []
    for d in (definition for part in sets for definition in part.preprocessorDefinitions):
        options.append(f"-D{d.name}" if d.value is None else f"-D{d.name}={d.value}")
    files = dict.fromkeys(name for part in sets for name in part.sourceFiles)
    includes = dict.fromkeys(name for part in sets for name in part.includeDirectories)
    return list(files), list(dict.fromkeys(options)), list(includes)
