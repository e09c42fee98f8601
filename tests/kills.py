"""Runs killed by `kill -9` at random times and resumed: `python -m tests.kills 200`. Linux, with a C compiler.

Each run must end with the bytes of the uninterrupted run. One JSON line at the end; exit 1 if a run does not.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

from tests.users import ENVIRONMENT
from tests.walker import walker_scenario

SEED = 27
PAUSE, STEPS = 6000.0, 100  # wall time of a step [us], and steps of a run
LONGEST = 60.0  # [s] of a command
MOST_KILLS = 5  # of one run


class Killed:
    """A scenario whose runs are killed.

    Args:
        python: Whether the loop is in Python, with texts, fixes and model exchange.
    """

    def __init__(self, folder: Path, *, python: bool) -> None:
        self.folder, self.part, self.whole = folder, folder / "part", folder / "whole"
        folder.mkdir()
        scenario = walker_scenario(
            folder, python=python, duration=0.01 * STEPS, pause=PAUSE, checkpoint="15 ms"
        )  # fmt: skip
        self.begin, self.resume = [str(scenario), "--out", str(self.part), "--force"], [str(self.part), "--resume"]
        assert self.command([str(scenario), "--out", str(self.whole)]).wait(LONGEST) == 0

    @staticmethod
    def command(arguments: list[str]) -> subprocess.Popen[bytes]:
        """Return the command, begun."""
        words = [sys.executable, "-m", "cosim", "run", *arguments, "--no-report", "-q"]
        return subprocess.Popen(words, env=ENVIRONMENT, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def faults(self, kills: int, rng: random.Random, counts: Counter[str]) -> list[str]:
        """Kill a run so many times, let it end, and return what is wrong with its files."""
        shutil.rmtree(self.part, ignore_errors=True)
        arguments = self.begin
        for _ in range(kills):
            code = self._kill(self.command(arguments), rng, counts)
            arguments = self.begin if code == 2 and not self._is_finished() else self.resume
            if code in (0, 2):
                counts["ended before" if arguments is self.resume else "nothing to resume"] += 1
            elif code not in (-signal.SIGKILL, 4):
                return [f"exit {code}"]
        for _ in range(2):
            code = self.command(arguments).wait(LONGEST)
            arguments = self.begin if code == 2 and not self._is_finished() else self.resume
        return [] if code == 0 or (code == 2 and self._is_finished()) else [f"exit {code}"]

    def differences(self) -> list[str]:
        """Return what differs in the files of the run and of one that was not killed."""
        manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (self.part, self.whole)]
        for manifest in manifests:
            del manifest["date"], manifest["timings"]
        found = ["manifest.json differs"] if manifests[0] != manifests[1] else []
        if (self.part / "results.csv").read_bytes() != (self.whole / "results.csv").read_bytes():
            found.append("results.csv differs")
        names = sorted(path.relative_to(self.part).as_posix() for path in self.part.rglob("*") if path.is_file())
        if names != ["checkpoint/run.json", "checkpoint/state", "manifest.json", "results.csv"]:
            found.append(f"files: {names}")
        return found

    def _is_finished(self) -> bool:
        with suppress(OSError, ValueError):
            return bool(json.loads((self.part / "manifest.json").read_text())["status"] == "ok")
        return False

    def _kill(self, process: subprocess.Popen[bytes], rng: random.Random, counts: Counter[str]) -> int:
        """Kill the command, its worker or both: at any time of a run, or some time after a checkpoint."""
        victims, checkpoint = rng.choice(("command", "worker", "both")), self.part / "checkpoint"
        before, end = _changed(checkpoint), time.monotonic() + LONGEST
        while rng.random() < 0.999 and _changed(checkpoint) == before and time.monotonic() < end:
            time.sleep(0.002)
        end = time.monotonic() + rng.uniform(0.0, 0.6e-6 * PAUSE * STEPS)
        while process.poll() is None and time.monotonic() < end:
            time.sleep(0.002)
        counts[f"{victims} killed"] += process.poll() is None
        worker = _children(process.pid) if victims != "command" else []
        for pid in [*worker, process.pid] if victims != "worker" else worker:
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        code = process.wait(LONGEST)
        counts["in a write"] += any(checkpoint.glob(".state.*"))
        return code


def _changed(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


def _children(pid: int) -> list[int]:
    with suppress(OSError):
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def main(count: int) -> int:
    """Kill runs so many times and return the number of faults."""
    rng, counts, wrong = random.Random(SEED), Counter[str](), 0
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        killed = [Killed(Path(folder) / name, python=name == "python") for name in ("c", "python")]
        left = count
        while left > 0:
            kills, number = min(left, rng.randint(1, MOST_KILLS)), counts["runs"]
            left -= kills
            run = killed[number % 2]
            counts["runs"] += 1
            for fault in run.faults(kills, rng, counts) or run.differences():
                wrong += 1
                print(f"run {number}, {kills} kills: {fault}", file=sys.stderr, flush=True)
    print(json.dumps({"kills": count, "wrong": wrong, **dict(sorted(counts.items()))}))
    return wrong


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
