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
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tests.conftest import ROOT
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
        self.folder = folder
        folder.mkdir()
        scenario = walker_scenario(
            folder, python=python, duration=0.01 * STEPS, pause=PAUSE, checkpoint="15 ms"
        )  # fmt: skip
        self.begin = [str(scenario), "--out", str(folder / "part"), "--force"]
        self.resume = [str(folder / "part"), "--resume"]
        command = self.command([str(scenario), "--out", str(folder / "whole")])
        assert command.wait(LONGEST) == 0, self._said(command)

    @staticmethod
    def command(arguments: list[str]) -> subprocess.Popen[bytes]:
        """Return the command, begun."""
        words = [sys.executable, "-m", "cosim", "run", *arguments, "--no-report", "--json", "-q"]
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        return subprocess.Popen(words, env=environment, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)

    def faults(self, kills: int, rng: random.Random, counts: Counter[str]) -> list[str]:
        """Kill a run so many times, let it end, and return what is wrong with its files."""
        part = self.folder / "part"
        shutil.rmtree(part, ignore_errors=True)
        arguments = self.begin
        for _ in range(kills):
            process = self.command(arguments)
            self._kill(process, rng, counts)
            code, said = process.poll(), self._said(process)
            if code == 2 and not self._is_finished():
                counts["nothing to resume"] += 1
                arguments = self.begin
                continue
            if code in (0, 2):
                counts["ended before"] += 1
            elif code not in (-signal.SIGKILL, 4):
                return [f"exit {code}: {said}"]
            arguments = self.resume
        return self._end(arguments)

    def _is_finished(self) -> bool:
        try:
            status: str = json.loads((self.folder / "part" / "manifest.json").read_text())["status"]
        except (OSError, ValueError):
            return False
        return status == "ok"

    def _end(self, arguments: list[str]) -> list[str]:
        part = self.folder / "part"
        for _ in range(2):
            process = self.command(arguments)
            code, said = process.wait(LONGEST), self._said(process)
            arguments = self.begin if code == 2 and not self._is_finished() else self.resume
        if code and not (code == 2 and self._is_finished()):
            return [f"exit {code}: {said}"]
        return self._differences(part)

    def _differences(self, part: Path) -> list[str]:
        found = []
        whole = self.folder / "whole"
        if (part / "results.csv").read_bytes() != (whole / "results.csv").read_bytes():
            found.append("results.csv differs")
        manifests = [json.loads((folder / "manifest.json").read_text()) for folder in (part, whole)]
        for manifest in manifests:
            del manifest["timings"]
        keys = [key for key in {**manifests[0], **manifests[1]} if manifests[0].get(key) != manifests[1].get(key)]
        found += [f"manifest.json differs in {', '.join(keys)}"] if keys else []
        names = sorted(path.relative_to(part).as_posix() for path in part.rglob("*") if path.is_file())
        if names != ["checkpoint/run.json", "checkpoint/state", "manifest.json", "results.csv"]:
            found.append(f"files: {names}")
        return found

    @staticmethod
    def _said(process: subprocess.Popen[bytes]) -> dict[str, str]:
        assert process.stdout is not None
        with process.stdout as stream, suppress(ValueError):
            return json.loads(stream.read())  # type: ignore[no-any-return]
        return {}

    # -- kills ----------------------------------------------------------------------------------

    def _kill(self, process: subprocess.Popen[bytes], rng: random.Random, counts: Counter[str]) -> None:
        """Kill the command, its worker or both: at any time, between two steps, or while a checkpoint is written."""
        moment, victims = rng.choice(("any", "step", "write")), rng.choice(("command", "worker", "both"))
        state = self.folder / "part" / "checkpoint" / "state"
        before = _changed(state)
        if moment == "any":
            self._wait(process, lambda: False, rng.uniform(0.0, 4.0))
        else:
            self._wait(process, lambda: _changed(state) != before, LONGEST)
            self._wait(process, lambda: False, rng.uniform(0.0, 0.6e-6 * PAUSE * STEPS))
        if moment == "write":
            self._wait(process, lambda: any(state.parent.glob(".state.*")), LONGEST, pause=0.0)
        if process.poll() is None:
            counts[f"{victims} killed"] += 1
        worker = _children(process.pid)
        for pid in (*(worker if victims != "command" else ()), *([process.pid] if victims != "worker" else ())):
            with suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        process.wait(LONGEST)
        time.sleep(0.02)
        counts["in a write"] += any(state.parent.glob(".state.*"))

    @staticmethod
    def _wait(
        process: subprocess.Popen[bytes], is_due: Callable[[], bool], longest: float, pause: float = 0.002
    ) -> None:
        end = time.monotonic() + longest
        while time.monotonic() < end and process.poll() is None and not is_due():
            time.sleep(pause)


def _changed(path: Path) -> int:
    with suppress(OSError):
        return path.stat().st_mtime_ns
    return 0


def _children(pid: int) -> list[int]:
    with suppress(OSError):
        return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]
    return []


def kill_runs(folder: Path, count: int, seed: int = SEED) -> tuple[Counter[str], list[str]]:
    """Kill runs so many times; return the counts and all faults."""
    rng, counts, wrong = random.Random(seed), Counter[str](), list[str]()
    killed = [Killed(folder / name, python=name == "python") for name in ("c", "python")]
    left = count
    while left > 0:
        kills = min(left, rng.randint(1, MOST_KILLS))
        left -= kills
        number = counts["runs"]
        faults = killed[number % 2].faults(kills, rng, counts)
        counts["runs"] += 1
        for fault in faults:
            wrong.append(f"run {number}, {kills} kills: {fault}")
            print(wrong[-1], file=sys.stderr, flush=True)
    return counts, wrong


def main(count: int) -> int:
    """Kill runs so many times and return the number of faults."""
    with tempfile.TemporaryDirectory(prefix="kills-") as folder:
        counts, wrong = kill_runs(Path(folder), count)
    print(json.dumps({"kills": count, "wrong": len(wrong), **dict(sorted(counts.items()))}))
    return len(wrong)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
