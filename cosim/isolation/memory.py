"""Memory use of another process and of the processes that it has started."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

IN_MEMORY = re.compile(r"/memfd:.*|/dev/shm/[^/]*")  # files that take memory in place of a disk
MAPPING = re.compile(r"^[0-9a-f]+-[0-9a-f]+ \S+ \S+ (?P<device>\S+) (?P<inode>\d+)|^Pss: +(?P<size>\d+)", re.MULTILINE)
SCAN = 0.2  # interval [s] between searches for processes whose parent has ended
File = tuple[str, int]  # device and inode


def resident(pid: int) -> int:
    """Return the resident size of a process [bytes], 0 if unknown."""
    try:
        if sys.platform.startswith("linux"):
            return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        command = ["ps", "-o", "rss=", "-p", str(pid)]
        if os.name == "nt":
            command = ["tasklist", "/FI", f"PID eq {pid}", "/FO", "CSV", "/NH"]
        shown = subprocess.run(command, capture_output=True, text=True, check=False).stdout
        return 1024 * int(re.sub(r"\D", "", shown.strip().rpartition(',"')[2]) or 0)
    except (OSError, ValueError, IndexError):
        return 0


class ProcessTree:
    """A process and its descendants, except orphans that began a session of their own."""

    def __init__(self, pid: int) -> None:
        self.pid = pid
        self._orphans: set[int] = set()
        self._next_scan = 0.0

    def size(self, limit: float) -> float:
        """Return the memory of all processes [bytes], exact above the limit and an upper bound below it.

        Shared pages count once, as do files in memory, mapped or not.
        """
        if not sys.platform.startswith("linux"):
            return resident(self.pid)
        processes = _descendants({self.pid, *self._orphans})
        if (now := time.monotonic()) >= self._next_scan:
            self._next_scan = now + SCAN
            self._orphans = set()
            for name in filter(str.isdecimal, os.listdir("/proc")):
                with suppress(OSError):
                    session = int(Path(f"/proc/{name}/stat").read_bytes().rpartition(b")")[2].split()[3])
                    if session in processes:
                        self._orphans.add(int(name))
            processes |= _descendants(set(self._orphans))
        files = {file: size for pid in processes for file, size in _files_in_memory(pid)}
        bound = float(sum(map(resident, processes)) + sum(files.values()))
        if bound <= limit:
            return bound
        proportional = 0
        for pid in processes:
            total, mapped = _mapped_memory(pid)
            proportional += total
            for file in files.keys() & mapped.keys():
                files[file] = max(0, files[file] - mapped[file])
        return max(resident(self.pid), proportional) + sum(files.values())


def _descendants(pending: set[int]) -> set[int]:
    """Return processes and all their descendants."""
    found = set[int]()
    while pending:
        found.add(pid := pending.pop())
        with suppress(OSError):
            for task in Path(f"/proc/{pid}/task").iterdir():
                with suppress(OSError):
                    pending |= {*map(int, (task / "children").read_text().split())} - found
    return found


def _files_in_memory(pid: int) -> Iterator[tuple[File, int]]:
    """Yield the open files without a disk, and their sizes [bytes]."""
    if sys.platform == "win32":
        return
    with suppress(OSError):
        for entry in os.scandir(f"/proc/{pid}/fd"):
            with suppress(OSError):
                if IN_MEMORY.fullmatch(os.readlink(entry.path)):
                    about = os.stat(entry.path)
                    device = f"{os.major(about.st_dev):02x}:{os.minor(about.st_dev):02x}"
                    yield (device, about.st_ino), 512 * about.st_blocks


def _mapped_memory(pid: int) -> tuple[int, dict[File, int]]:
    """Return the memory of a process and its part in each mapped file [bytes]; shared pages count in parts."""
    total, files, file = 0, dict[File, int](), ("", 0)
    try:
        text = Path(f"/proc/{pid}/smaps").read_text(errors="replace")
    except OSError:  # ended, or of another user
        return resident(pid), files
    for match in MAPPING.finditer(text):
        if match["size"] is None:
            file = match["device"], int(match["inode"])
        else:
            total += (size := 1024 * int(match["size"]))
            files[file] = files.get(file, 0) + size
    return total, files
