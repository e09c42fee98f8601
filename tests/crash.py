"""Crashes, hangs and kills, each made to happen: `make crash CRASHES=200`. Linux, with a C compiler.

Each must be told in one line with the exit code of the contract, its rows those of a good run, no process and no
folder left. One JSON line at the end; exit 1 where one of them was not so.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from cosim.files.folders import INTERRUPTED, state_of
from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario

SEED = 11
STEPS = 400
LIMITS = "{step: 400 ms, load: 1500 ms}"
LOADING = ("load", "Instantiate", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode")
RUNNING = ("SetReal", "DoStep", "GetReal")
FREEING = ("Terminate", "FreeInstance")
CRASHES = ("segfault", "abort", "exit", "overflow", "free", "division", "kill")
HANGS = ("hang", "sleep", "print", "children")


@dataclass(frozen=True)
class Case:
    """What is made to happen, where, and the exit code that must come of it."""

    verb: str
    call: str
    deed: str
    at: int
    code: int
    number: int = 0  # signal
    to_worker: bool = False


def cases(count: int) -> list[Case]:
    """Return the requested number of cases of every kind, in a fixed order."""
    rng = random.Random(SEED)
    kinds: list[Iterator[Case]] = [
        itertools.cycle(
            Case("run", call, deed, rng.randint(2, STEPS) if call in RUNNING else 1, 4)
            for call in LOADING + RUNNING + FREEING
            for deed in CRASHES
        ),
        itertools.cycle(
            Case("run", call, deed, rng.randint(2, STEPS) if call in RUNNING else 1, 124)
            for call in RUNNING + LOADING + FREEING
            for deed in HANGS
        ),
        itertools.cycle(
            Case("run", "DoStep", deed, at, code, number)
            for number, code in ((signal.SIGINT, 130), (signal.SIGTERM, 4), (signal.SIGKILL, -9))
            for deed, at in (("slow", 0), ("hang", 3), ("children", 5), ("log", 4))
        ),
        itertools.cycle(Case("run", "DoStep", deed, 3, 4, signal.SIGKILL, True) for deed in ("hang", "sleep")),
        itertools.cycle(
            Case("check", call, deed, 1, 3) for call in ("DoStep", "Instantiate", *FREEING) for deed in CRASHES
        ),
        itertools.cycle(
            Case("replay", call, deed, rng.randint(2, 100), 4) for call in ("DoStep", "GetReal") for deed in CRASHES
        ),
        itertools.cycle([Case("run", "DoStep", "memory", 7, 4)]),
    ]
    shares = (8, 5, 5, 1, 2, 3, 1)
    turn = [kind for kind, share in zip(kinds, shares, strict=True) for _ in range(share)]
    rng.shuffle(turn)
    return [next(kind) for kind in itertools.islice(itertools.cycle(turn), count)]


class Trial:
    """A folder in which cases happen, one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.temporary = folder, folder / "tmp"
        self.temporary.mkdir()
        self.mark = f"COSIM_CRASH={os.getpid()}"
        name, _, value = self.mark.partition("=")
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(self.temporary), name: value}
        time_ = [0.1 * k for k in range(100)]
        lines = ["time,u0,u1,y1", *(f"{t:.1f},0,{t % 2 > 1:d},0" for t in time_)]
        (folder / "log.csv").write_text("\n".join(lines) + "\n")
        self.good = {}
        for verb in ("run", "replay"):
            assert self.command(Case(verb, "none", "none", 1, 0)).wait() == 0
            self.good[verb] = (folder / "out" / "results.csv").read_text()

    def command(self, case: Case) -> subprocess.Popen[str]:
        """Return the command to be killed."""
        folder = self.folder
        subprocess.run(["rm", "-rf", folder / "out"], check=True)
        limits = "" if case.number else "{memory: 300 MB}" if case.deed == "memory" else LIMITS
        path = deeds_scenario(folder, case.call, case.deed, case.at, 0.1 * STEPS, limits)
        out = ["--out", str(folder / "out"), "--no-report"]
        arguments = {
            "run": ["run", str(path), *out],
            "check": ["check", str(folder / "bad.fmu")],
            "replay": ["replay", str(folder / "log.csv"), "--plant", str(folder / "bad.fmu"), *out],
        }[case.verb]
        return subprocess.Popen(
            [sys.executable, "-m", "cosim", *arguments],
            env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip

    def faults(self, case: Case) -> list[str]:
        """Run the case and return its faults."""
        process = self.command(case)
        if case.number:
            self._signal(process, case)
        try:
            _, told = process.communicate(timeout=60)
        except subprocess.TimeoutExpired:
            process.kill()
            return ["it does not end"]
        found = []
        if process.returncode != case.code:
            found.append(f"exit {process.returncode}, not {case.code}: {told[-300:]}")
        own = [line for line in told.splitlines() if line.startswith(("error: ", str(self.folder)))]
        if len(own) != (0 if case.number == signal.SIGKILL and not case.to_worker else 1):
            found.append(f"{len(own)} lines: {told[-300:]}")
        if case.code == -9:
            found += self._state()
        elif case.verb != "check":
            found += self._rows(case)
        return found + self._leftovers()

    def _signal(self, process: subprocess.Popen[str], case: Case) -> None:
        for _ in range(600):
            if [*self.folder.glob("out/.rows-*/rows")] or process.poll() is not None:
                break
            time.sleep(0.02)
        time.sleep(1.5)
        if case.to_worker:
            with contextlib.suppress(OSError):  # it has ended, which is told by its exit code
                children = Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()
                for child in children:
                    os.kill(int(child), case.number)
        else:
            process.send_signal(case.number)

    def _rows(self, case: Case) -> list[str]:
        file = self.folder / "out" / "results.csv"
        if not file.exists():
            return ["no results.csv"]
        text = file.read_text()
        if not self.good[case.verb].startswith(text):
            return ["rows differ from those of a good run"]
        rows = len(text.splitlines()) - 1
        if case.call == "DoStep" and case.at and case.verb == "run" and rows != case.at:
            return [f"{rows} rows, not {case.at}"]
        if case.call in FREEING and rows != len(self.good[case.verb].splitlines()) - 1:
            return [f"{rows} rows, though all were made"]
        return []

    def _state(self) -> list[str]:
        """Check that the folder of a killed command is listed as such."""
        return [] if state_of(self.folder / "out") == INTERRUPTED else ["the run is not listed as interrupted"]

    def _leftovers(self) -> list[str]:
        """Return processes and folders left after a moment."""
        found: list[str] = []
        for _ in range(150):
            found = [f"process {pid} is left" for pid in self._processes()]
            found += [f"{path.name} is left" for path in self.temporary.iterdir()]
            found += [f"{path.name} is left" for path in self.folder.glob("out/.*")]
            if not found:
                break
            time.sleep(0.1)
        return found

    def _processes(self) -> Iterator[int]:
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if self.mark.encode() in (path / "environ").read_bytes().split(b"\0"):
                    yield int(path.name)
            except OSError:
                continue


def main(count: int) -> int:
    """Run the cases and return the number of cases with faults."""
    wrong: list[str] = []
    kinds: Counter[str] = Counter()
    signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it, and its children do
    with tempfile.TemporaryDirectory(prefix="crash-") as folder:
        deeds_fmu(Path(folder) / "good.fmu")
        trial = Trial(Path(folder))
        for case in cases(count):
            kind = signal.Signals(case.number).name if case.number else f"{case.verb} {case.code}"
            kinds[kind] += 1
            for fault in trial.faults(case):
                wrong.append(f"{case}: {fault}")
                print(wrong[-1], file=sys.stderr, flush=True)
    print(json.dumps({"induced": count, "wrong": len(wrong), **dict(sorted(kinds.items()))}))
    return len(wrong)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
