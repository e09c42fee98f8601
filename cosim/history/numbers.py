"""Numbers of results: given once, by age, and kept, so that a number never means other results later.

Line k of the file NUMBERS in a folder of results has the lasting name of the results with the number k: `tank/0003`.
Lines are only added, and the first line of a name counts, so that commands that add lines at the same time agree.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Sequence
from pathlib import Path

NUMBERS = ".numbers"
MOST_BYTES = 200_000_000
NO_LINK = getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_NONBLOCK", 0)


def numbers_of(names: Sequence[str], root: Path) -> list[int]:
    """Return the number of each lasting name.

    Names without a number get the next ones, in their order. Where the file cannot be written, new numbers are those
    that it would get.
    """
    lines = _lines(root)
    known = _by_name(lines)
    if new := [name for name in names if name not in known]:
        try:
            _add(new, root)
            known = _by_name(_lines(root))
        except OSError:
            pass
        last = len(lines)
        for name in new:
            known.setdefault(name, last := last + 1)
    return [known[name] for name in names]


def unknown_number(text: str, root: Path) -> str:
    """Return the message about an unused number."""
    lines = _lines(root)
    number = int(text) if len(text) <= len(str(len(lines))) else 0
    if 0 < number <= len(lines):
        return (
            f"the results with the number {number}, {_name_in(lines[number - 1])}, were removed; `cosim list` shows all"
        )
    return f"no results with the number {text}; `cosim list` shows the numbers, up to {len(lines)}"


def _by_name(lines: Sequence[str]) -> dict[str, int]:
    return {_name_in(lines[k]): k + 1 for k in reversed(range(len(lines)))}


def _lines(root: Path) -> list[str]:
    """Return the lines of the file, if readable."""
    try:
        stream = os.open(root / NUMBERS, os.O_RDONLY | NO_LINK)
    except OSError:
        return []
    try:
        status = os.fstat(stream)
        if not stat.S_ISREG(status.st_mode) or status.st_size > MOST_BYTES:
            return []
        return os.read(stream, MOST_BYTES).decode("utf-8", "surrogateescape").split("\n")[:-1]
    except OSError:
        return []
    finally:
        os.close(stream)


def _add(names: Sequence[str], root: Path) -> None:
    """Add names in one write; end a cut line."""
    stream = os.open(root / NUMBERS, os.O_RDWR | os.O_APPEND | os.O_CREAT | NO_LINK, 0o666)
    try:
        status = os.fstat(stream)
        if not stat.S_ISREG(status.st_mode):
            return
        if is_cut := status.st_size > 0:
            os.lseek(stream, -1, os.SEEK_END)  # Windows has no pread.
            is_cut = os.read(stream, 1) != b"\n"
        text = "\n" * is_cut + "".join(f"{_line_of(name)}\n" for name in names)
        os.write(stream, text.encode("utf-8", "surrogateescape"))
    finally:
        os.close(stream)


def _line_of(name: str) -> str:
    """Return a name as a line."""
    return name.replace("\n", "\0")


def _name_in(line: str) -> str:
    return line.replace("\0", "\n")
