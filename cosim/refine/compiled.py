"""The filter in C: built once for a model and the outputs a log holds, cached by content."""

from __future__ import annotations

import ctypes
import hashlib
import os
import shlex
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path

from cosim.refine.generate import Generated
from cosim.refine.kernel import Array, ArrayKernel, Data, cached, constants

OPTIONS = ("-O3", "-fno-math-errno", "-shared", "-fPIC", "-std=c99")  # errno of sin and pow is not looked at


class _Log(ctypes.Structure):
    _fields_ = (
        ("rows", ctypes.c_int),
        ("substeps", ctypes.c_int),
        ("step", ctypes.c_double),
        ("start", ctypes.c_double),
        ("u", ctypes.c_void_p),
        ("y", ctypes.c_void_p),
    )


def compiler() -> list[str] | None:
    """The command of the C compiler: what `CC` in the environment says, else cc, gcc or clang; None: there is none."""
    named = os.environ.get("CC")
    commands = (_words(c) for c in (("cc", "gcc", "clang") if named is None else (named,)))
    return next((words for words in commands if words and shutil.which(words[0])), None)


def _words(command: str) -> list[str]:
    """A command as a shell splits it; none where a quote is left open."""
    try:
        return shlex.split(command)
    except ValueError:
        return []


class CompiledKernel(ArrayKernel):
    """The filter in C. Raises OSError or subprocess.SubprocessError where the compiler does not do its work."""

    def __init__(self, generated: Generated) -> None:
        self.generated = generated
        self._library = _loaded(_source(generated))
        self._library.filter.argtypes = [ctypes.POINTER(_Log), *[ctypes.c_void_p] * 9]
        self._library.simulate.argtypes = [ctypes.POINTER(_Log), ctypes.c_int, *[ctypes.c_void_p] * 7]

    def _filter(self, data: Data, u: Array, y: Array, given: Sequence[Array], room: Sequence[Array]) -> int:
        log = _Log(len(u), data.substeps, data.step, data.start, u.ctypes.data, y.ctypes.data)
        return int(self._library.filter(ctypes.byref(log), *map(_address, (*given, *room))))

    def _simulate(self, data: Data, u: Array, first: int, given: Sequence[Array], room: Sequence[Array]) -> None:
        log = _Log(len(u), data.substeps, data.step, data.start, u.ctypes.data, None)
        self._library.simulate(ctypes.byref(log), first, *map(_address, (*given, *room)))


def _address(a: Array) -> int | None:
    return a.ctypes.data if a.size else None


def _source(g: Generated) -> str:
    """The whole C file."""

    def literal(value: float | tuple[int, ...]) -> str:
        return "{" + ", ".join(map(str, value)) + "}" if isinstance(value, tuple) else f"({value})"

    head = "\n".join(f"#define {name} {literal(value)}" for name, value in constants(g).items())
    body = (Path(__file__).parent / "filter.c").read_text(encoding="utf-8")
    return f"#include <math.h>\n{head}\n{g.source}\n{body}"


def _loaded(source: str) -> ctypes.CDLL:
    """The shared library of a source; one of another machine in the cache is compiled anew."""
    library = _compiled(source)
    try:
        return ctypes.CDLL(str(library))
    except OSError:
        library.unlink(missing_ok=True)
        return ctypes.CDLL(str(_compiled(source)))


def _compiled(source: str) -> Path:
    """The shared library of a source, from the cache or compiled now.

    Its name ends with the hash of its content: to load one that is damaged can end the process.
    """
    stem = cached(source, "")
    for kept in stem.parent.glob(f"{stem.name}-*.so"):
        if kept.name == _named(stem, kept).name:
            return kept
        kept.unlink(missing_ok=True)
    command = compiler()
    if command is None:
        raise FileNotFoundError("no C compiler")
    with tempfile.TemporaryDirectory(dir=stem.parent) as folder:
        file, library = Path(folder) / "filter.c", Path(folder) / "filter.so"
        file.write_text(source, encoding="utf-8")
        full = [*command, *OPTIONS, "-o", str(library), str(file), "-lm"]
        subprocess.run(full, check=True, capture_output=True, timeout=120)
        return library.replace(_named(stem, library))


def _named(stem: Path, library: Path) -> Path:
    """Where a library of this content is kept."""
    return stem.with_name(f"{stem.name}-{hashlib.sha256(library.read_bytes()).hexdigest()[:32]}.so")
