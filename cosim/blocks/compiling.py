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
from cosim.fmi.native.compiler import (
    POSITION,
    CompilerFailed,
    NoCompiler,
    fmi_headers,
    library_of,
    required_compiler,
)

SOURCES_FOLDER = "sources"
FMU_COMPILE_LIMIT_S = 300.0  # time limit [s] of the compiler per FMU
MAX_COMPILER_LINES, MAX_COMPILER_LINE_CHARACTERS = 20, 200  # excerpt of the compiler output: lines, characters per line
# optimized, with the names that functions have in shared libraries
OPTIMIZED = ("-O3", "-DNDEBUG", "-w", "-DFMI2_OVERRIDE_FUNCTION_PREFIX", "-DFMI3_OVERRIDE_FUNCTION_PREFIX")
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
    root, includes, options = (folder / SOURCES_FOLDER).resolve(), dict[str, None](), dict[str, None]()
    # If the library has no build description of its own, the first one applies.
    builds = sorted(description.buildConfigurations, key=lambda build: build.modelIdentifier != identifier)
    if sets := builds[0].sourceFileSets if builds else []:
        names = [*dict.fromkeys(name for part in sets for name in part.sourceFiles)]
        includes = dict.fromkeys(name for part in sets for name in part.includeDirectories)
        definitions = [definition for part in sets for definition in part.preprocessorDefinitions]
        options = dict.fromkeys(f"-D{d.name}" if d.value is None else f"-D{d.name}={d.value}" for d in definitions)
    elif (root / "all.c").is_file():
        names = ["all.c"]
    else:
        names = sorted(p.name for p in root.glob("*") if p.suffix.lower() in (*C_ENDINGS, *CPP_ENDINGS))
    outside = [name for name in (*names, *includes) if not (root / name).resolve().is_relative_to(root)]
    missing = outside or [name for name in names if not (root / name).is_file()]
    if missing or not names:
        files = f"{', '.join(missing)[:200]} of its list is" if names else "C and C++ files are"
        raise FmuError(
            f"its sources cannot be compiled: {files} not in its folder `sources`; export it again with them"
        )
    folders = (SOURCES_FOLDER, *(f"{SOURCES_FOLDER}/{name}" for name in includes), fmi_headers())
    *first, last = (f"{SOURCES_FOLDER}/{name}" for name in names)
    libraries = ["-lm", *(["-lstdc++"] if any(name.lower().endswith(CPP_ENDINGS) for name in names) else [])]
    paths = sorted(path for path in root.rglob("*") if path.is_file())
    files_of_c = {f"{SOURCES_FOLDER}/{path.relative_to(root).as_posix()}": path.read_bytes() for path in paths}
    try:
        includes_of_c = [f"-I{part}" for part in folders]
        command = [*required_compiler(), "-shared", *POSITION, *OPTIMIZED, *options, *includes_of_c, *first]
        made = library_of(files_of_c, last, command, libraries=libraries, limit=FMU_COMPILE_LIMIT_S)
    except NoCompiler as error:
        raise FmuError(f"its sources cannot be compiled: {error}") from None
    except CompilerFailed as error:
        lines = error.output.splitlines()[:MAX_COMPILER_LINES]
        excerpt = "".join(f"\n  {line[:MAX_COMPILER_LINE_CHARACTERS]}" for line in lines)
        raise FmuError(f"its sources do not compile: {error}{excerpt}") from None
    library = library_file(folder, description, identifier)
    with draft_of(library) as draft:
        draft.write_bytes(made.read_bytes())
    return library
