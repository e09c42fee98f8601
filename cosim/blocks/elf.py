"""Dynamic symbols and dependencies of a Linux library (ELF, 64 bits, little endian)."""

from __future__ import annotations

import struct
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

HEAD = b"\x7fELF\x02\x01"
DYNAMIC, DYNAMIC_SYMBOLS = 6, 11  # types of sections
NEEDED, SONAME = 1, 14  # tags of the dynamic section
UNIQUE, EXPORTED = 10, (1, 2, 10)  # bindings of symbols: global, weak, unique
VISIBLE = (0, 3)  # default, protected
SYMBOL = np.dtype(
    [("name", "<u4"), ("info", "u1"), ("other", "u1"), ("section", "<u2"), ("value", "<u8"), ("size", "<u8")]
)


@dataclass(frozen=True)
class ElfLibrary:
    """Names by which the loader knows a library, and the symbols that it defines.

    Attributes:
        soname: Name in the process, "" for that of the file.
        needed: Names of the libraries that it needs.
        defined: Symbols that other libraries can refer to.
        unique: Those of them that exist once in a process (C++, `STB_GNU_UNIQUE`).
    """

    soname: str = ""
    needed: frozenset[str] = frozenset()
    defined: frozenset[str] = frozenset()
    unique: frozenset[str] = frozenset()


def read_elf(content: bytes, *, symbols: bool = True) -> ElfLibrary:
    """Return the names of a library, if asked with its symbols; none for another kind of file and a damaged one."""
    if content.startswith(HEAD):
        with suppress(struct.error, ValueError, IndexError, OverflowError):
            return _read(content, symbols)
    return ElfLibrary()


def _read(content: bytes, with_symbols: bool) -> ElfLibrary:
    (first,) = struct.unpack_from("<Q", content, 40)
    size, count = struct.unpack_from("<HH", content, 58)
    sections = [struct.unpack_from("<IIQQQQI", content, first + k * size) for k in range(count)]

    def text(start: int) -> str:
        return content[start : content.index(b"\0", start)].decode("utf-8", "replace")

    soname, needed = "", set[str]()
    defined, unique = set[str](), set[str]()
    for _, kind, _, _, offset, length, link in sections:
        if kind == DYNAMIC:
            strings = sections[link][4]
            for tag, value in struct.iter_unpack("<qQ", content[offset : offset + length // 16 * 16]):
                if tag == NEEDED:
                    needed.add(text(strings + value))
                elif tag == SONAME:
                    soname = text(strings + value)
        elif kind == DYNAMIC_SYMBOLS and with_symbols:
            strings = sections[link][4]
            symbols = np.frombuffer(content, SYMBOL, length // SYMBOL.itemsize, offset)
            binding, is_visible = symbols["info"] >> 4, np.isin(symbols["other"] & 3, VISIBLE)
            is_defined = (symbols["section"] != 0) & (symbols["size"] > 0) & is_visible & np.isin(binding, EXPORTED)
            defined |= {text(strings + name) for name in symbols["name"][is_defined].tolist()}
            unique |= {text(strings + name) for name in symbols["name"][is_defined & (binding == UNIQUE)].tolist()}
    return ElfLibrary(soname, frozenset(needed), frozenset(defined), frozenset(unique))
