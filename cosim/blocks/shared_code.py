"""Code of FMUs that a process finds by name: libraries, unique C++ symbols, and Python modules.

A process loads only one library, symbol or module of each name. If a second FMU contains different code with the same
name, it would execute the code of the first FMU. Such FMUs need processes of their own.
"""

from __future__ import annotations

import ctypes
import os
import platform
import re
import struct
import sys
import zipfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path, PurePosixPath

import numpy as np

from cosim.core.errors import FmuError
from cosim.core.messages import CheckNote
from cosim.files.archive import DAMAGES, DESCRIPTION

ELF_MAGIC = b"\x7fELF\x02\x01"
ALL_SYMBOLS, DYNAMIC, DYNAMIC_SYMBOLS = 2, 6, 11  # types of sections
DATA_SYMBOL, THREAD_SYMBOL = 1, 6  # types of symbols of data
CONSTANT_SECTION = ".data.rel.ro"  # whose data are constant after relocation
COMPILER_VARIABLE = re.compile(r"completed(\.\d+)?")  # which the compiler puts into every library
NEEDED, SONAME = 1, 14  # tags of the dynamic section
UNIQUE, EXPORTED = 10, (1, 2, 10)  # bindings of symbols: global, weak, unique
VISIBLE = (0, 3)  # default, protected
ELF_SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)


@dataclass
class ElfLibrary:
    """Names of a Linux library for the loader, and the symbols that the library defines.

    Attributes:
        soname: Name for the loader; "" if it is the file name.
        needed: Names of the libraries that this library needs.
        defined: Symbols that other libraries can refer to.
        unique: Those of them that exist once in a process (C++, `STB_GNU_UNIQUE`).
        has_variables: Whether it has variables that its instances share, as far as is known.
    """

    soname: str = ""
    needed: set[str] = field(default_factory=set)
    defined: set[str] = field(default_factory=set)
    unique: set[str] = field(default_factory=set)
    has_variables: bool = True


def _read(content: bytes) -> ElfLibrary:
    """Return the names and symbols of a library; raise struct.error, ValueError or IndexError for a damaged one."""
    (first,) = struct.unpack_from("<Q", content, 40)
    size, count, of_names = struct.unpack_from("<HHH", content, 58)
    sections = [struct.unpack_from("<IIQQQQI", content, first + k * size) for k in range(count)]

    def text(start: int) -> str:
        return content[start : content.index(b"\0", start)].decode("utf-8", "replace")

    elf = ElfLibrary()
    for _, kind, _, _, offset, length, link in sections:
        if kind == DYNAMIC:
            strings = sections[link][4]
            for tag, value in struct.iter_unpack("<qQ", content[offset : offset + length // 16 * 16]):
                if tag == NEEDED:
                    elf.needed.add(text(strings + value))
                elif tag == SONAME:
                    elf.soname = text(strings + value)
        elif kind == DYNAMIC_SYMBOLS:
            strings = sections[link][4]
            symbols = np.frombuffer(content, ELF_SYMBOL, length // ELF_SYMBOL.itemsize, offset)
            binding, is_visible = symbols["info"] >> 4, np.isin(symbols["other"] & 3, VISIBLE)
            is_defined = (symbols["section"] != 0) & (symbols["size"] > 0) & is_visible & np.isin(binding, EXPORTED)
            elf.defined |= {text(strings + name) for name in symbols["name"][is_defined].tolist()}
            elf.unique |= {text(strings + name) for name in symbols["name"][is_defined & (binding == UNIQUE)].tolist()}
        elif kind == ALL_SYMBOLS:
            strings = sections[link][4]
            symbols = np.frombuffer(content, ELF_SYMBOL, length // ELF_SYMBOL.itemsize, offset)
            names = [text(sections[of_names][4] + name) for name, *_ in sections]
            writable = [
                k
                for k, (_, _, flags, *_) in enumerate(sections)
                if flags & 1 and not names[k].startswith(CONSTANT_SECTION)
            ]
            is_data = np.isin(symbols["info"] & 15, (DATA_SYMBOL, THREAD_SYMBOL)) & (symbols["size"] > 0)
            of_data = symbols["name"][is_data & np.isin(symbols["section"], writable)].tolist()
            # Without that of the compiler, local symbols have been removed.
            elf.has_variables = {bool(COMPILER_VARIABLE.fullmatch(text(strings + name))) for name in of_data} != {True}
    return elf


# files of this system's libraries, and words in their folders, of FMI 1.0, 2.0 and 3.0
LIBRARY_ENDING, PLATFORM_WORDS = {
    "Windows": (r"\.dll", ("win", "windows")),
    "Darwin": (r"\.dylib|\.so", ("darwin",)),
}.get(platform.system(), (r"\.so(\.\d+)*", ("linux",)))
LIBRARY = re.compile(rf".*({LIBRARY_ENDING})", re.IGNORECASE)
PLATFORM = re.compile(r"(?:^|/)binaries/([^/]+)/")
RESOURCE_FILE = re.compile(r"(?:resources/original/)*resources/(?P<name>(?P<top>[^/.]+)[^/]*(?P<rest>/.*)?)")
IDENTIFIER = re.compile(rb'modelIdentifier\s*=\s*"([^"]*)"')
CODE_ENDINGS = (".py", ".pyc", ".pyd", ".so")
NAME_OF_SLAVE = "slavemodule.txt"  # of pythonfmu, no data of a module
OF_STD = re.compile(r"_Z(G[VR]|T[ISVT])?[ZNK]*S[tabsiod]")  # symbols of the C++ library, equal in all of its builds
OF_SYSTEM = re.compile(r"(lib(c|m|dl|pthread|rt|gcc_s|stdc\+\+|atomic)|ld-linux[\w-]*)\.so")  # without data of FMUs
VERSION_FUNCTIONS = ("fmi2GetVersion", "fmi3GetVersion", "fmiGetVersion")  # which the library of an FMU exports
ALLOCATORS = {"malloc", "calloc", "realloc", "free"}


class SharedCode(FmuError):
    """Error: this process has loaded different code under a name that an FMU uses."""


@dataclass
class Code:
    """Code of an FMU: name → digest of its content.

    Attributes:
        wanted: Code that this FMU looks up by name: libraries that its libraries need, unique symbols, modules.
        offered: Code that another FMU could find by name: the same, and the FMU's own library.
        symbols: Symbols that the FMU's libraries define.
        needed: Libraries that the FMU's libraries need.
        has_variables: Whether instances share variables of a library, as far as is known.
        has_resources: Whether the FMU has files that an instance may change.
    """

    wanted: dict[str, str] = field(default_factory=dict)
    offered: dict[str, str] = field(default_factory=dict)
    symbols: set[str] = field(default_factory=set)
    needed: set[str] = field(default_factory=set)
    has_variables: bool = True
    has_resources: bool = True

    @cached_property
    def common(self) -> frozenset[str]:
        """Return the names of code whose global data several FMUs of a process have in common."""
        return frozenset({*self.wanted, *(name for name in self.needed if not OF_SYSTEM.match(name))})

    @cached_property
    def needs_own_symbols(self) -> bool:
        """Return whether this process has symbols of the same names, which its libraries must not find."""
        if sys.platform != "linux" or not hasattr(os, "RTLD_DEEPBIND") or "LD_PRELOAD" in os.environ:
            return False
        if self.symbols & ALLOCATORS or any(name.startswith("libpython") for name in self.needed):
            return False
        from _ctypes import dlsym  # type: ignore[attr-defined, unused-ignore]

        process = ctypes.CDLL(None)._handle
        for symbol in self.symbols:
            with suppress(OSError):
                dlsym(process, symbol)
                return True
        return False

    def clash(self, other: Code) -> str:
        """Return a name under which both FMUs have different code; "" if there is none."""
        pairs = (self.wanted, other.offered), (other.wanted, self.offered)
        names = [n for one, two in pairs for n in one.keys() & two.keys() if one[n] != two[n]]
        return min(names, default="")


def code_of(path: Path) -> Code:
    """Return the code of an FMU; empty if the FMU cannot be read, which is reported when it is loaded."""
    try:
        about = path.stat()
        return _code_of(path, about.st_mtime_ns, about.st_size, about.st_ino)
    except DAMAGES:
        return Code()


@lru_cache(64)
def _code_of(path: Path, _changed: int, _size: int, _file: int) -> Code:
    code = Code()
    with zipfile.ZipFile(path) as archive:
        files = [info for info in archive.infolist() if not info.is_dir()]
        own = {name.decode() for name in IDENTIFIER.findall(archive.read(DESCRIPTION))}
        versions = {*VERSION_FUNCTIONS, *(f"{identifier}_fmiGetVersion" for identifier in own)}
        code.has_resources = any(info.filename.startswith("resources/") for info in files)
        elfs = list[ElfLibrary]()
        for info in files:
            folder = PLATFORM.findall(info.filename)
            is_of_here = not folder or any(word in folder[-1] for word in PLATFORM_WORDS)
            if not (is_of_here and LIBRARY.fullmatch(info.filename)):
                continue
            name, digest = PurePosixPath(info.filename).name, _digest(info)
            elf, content = ElfLibrary(), archive.read(info)
            if sys.platform.startswith("linux") and content.startswith(ELF_MAGIC):
                with suppress(struct.error, ValueError, IndexError, OverflowError):
                    elf = _read(content)
            elfs.append(elf)
            names = {f"library {n}": digest for n in (name, elf.soname) if n}
            unique = {f"C++ symbol {n}": digest for n in elf.unique if not OF_STD.match(n)}
            is_fmu = name.partition(".")[0] in own or not elf.defined.isdisjoint(versions)
            code.wanted |= unique if is_fmu else names | unique
            code.offered |= names | unique
            code.symbols |= elf.defined
            code.needed |= elf.needed
    code.has_variables = not elfs or any(elf.has_variables for elf in elfs)
    modules = _modules([(info.filename, _digest(info)) for info in files])
    for name, digest in modules.items():
        code.wanted[f"Python module {name}"] = code.offered[f"Python module {name}"] = digest
    return code


def _digest(info: zipfile.ZipInfo) -> str:
    """Return a digest of the content of a member."""
    return f"{info.CRC:08x}-{info.file_size}"


def _modules(files: Iterable[tuple[str, str]]) -> dict[str, str]:
    """Return Python module → digest of its files and of the data beside it, for the modules in the resources."""
    parts: dict[str, list[tuple[str, str]]] = {}
    for name, digest in files:
        if (match := RESOURCE_FILE.fullmatch(name)) and match["name"] != NAME_OF_SLAVE:
            parts.setdefault(match["top"], []).append((match["name"], digest))
    modules = {top: part for top, part in parts.items() if any(n.endswith(CODE_ENDINGS) for n, _ in part)}
    data = [entry for top, part in parts.items() if top not in modules for entry in part]
    if not any(n.endswith(".py") for part in modules.values() for n, _ in part):
        return {}
    return {top: repr(sorted([*part, *data])) for top, part in modules.items()}


# -- FMUs of one process ---------------------------------------------------------------------------

_loaded: dict[Path, Code] = {}  # also freed FMUs, because modules and some libraries remain


def has_loaded_fmus() -> bool:
    """Return True if this process has loaded an FMU."""
    return bool(_loaded)


def claim(path: Path) -> None:
    """Record that this process loads an FMU.

    Raises:
        SharedCode: The process has loaded an FMU with different code of the same name.
    """
    code = code_of(path)
    for other, known in _loaded.items():
        if what := code.clash(known):
            raise SharedCode(
                f"{path} does not load: its {what} differs from that of {other}, which this process has loaded; "
                "run it in a worker process (without in_process, --in-process)"
            )
    if code not in _loaded.values():
        _loaded[path] = code


def separate(fmus: Iterable[tuple[str, Path]], apart: Iterable[str]) -> tuple[set[str], list[str]]:
    """Return the components that need processes of their own, with a note for each.

    Args:
        fmus: Components and their FMUs.
        apart: Components that already have processes of their own.
    """
    shared: dict[Path, tuple[str, Code]] = {}
    names, notes = set[str](), list[str]()
    for name, path in fmus:
        if name in apart or path in shared:
            continue
        code = code_of(path)
        clashes = ((other, code.clash(known)) for other, known in shared.values())
        other, what = next((clash for clash in clashes if clash[1]), ("", ""))
        if what:
            names.add(name)
            notes.append(CheckNote(f"{name} runs in a process of its own: its {what} differs from that of {other}"))
        else:
            shared[path] = name, code
    return names, notes


# -- symbols of the process --------------------------------------------------------------------------


@contextmanager
def own_symbols_first(path: Path, library: Path) -> Iterator[None]:
    """Load a library so that it uses its own symbols before equally named symbols of the process.

    Exceptions, which use the symbols of the process: a replaced allocator (LD_PRELOAD), an FMU with its own allocator,
    and an FMU that needs Python's library.
    """
    handle = None
    if sys.platform == "linux" and code_of(path).needs_own_symbols:
        library, folder = library.resolve(), os.getcwd()
        os.chdir(library.parent)  # as FMPy does
        with suppress(OSError):  # FMPy reports the error when it loads the library
            handle = ctypes.CDLL(str(library), mode=os.RTLD_NOW | os.RTLD_LOCAL | os.RTLD_DEEPBIND)._handle
        os.chdir(folder)
    try:
        yield  # a second load of the library returns the same handle
    finally:
        if sys.platform == "linux" and handle is not None:
            from _ctypes import dlclose

            dlclose(handle)
