"""Crashes and hangs in any call of an FMU, each made to happen: `make crash CRASHES=200`. Linux, with a C compiler.

Each must be told in one line with the exit code of the contract, its rows those of a good run, no process and no
folder left. One JSON line at the end; exit 1 where one of them was not so. Kills are in `tests/test_misbehaving.py`.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import ROOT
from tests.deeds import deeds_fmu, deeds_scenario

SEED, STEPS = 11, 400
RUNNING, FREEING = ("SetReal", "DoStep", "GetReal"), ("Terminate", "FreeInstance")
CALLS = ("load", "Instantiate", "SetupExperiment", "EnterInitializationMode", "ExitInitializationMode")
CALLS += RUNNING + FREEING
CODES = {
    **dict.fromkeys(("segfault", "abort", "exit", "overflow", "free", "division", "kill"), 4),
    **dict.fromkeys(("hang", "sleep", "print", "children"), 124),
}


class Trial:
    """A folder in which crashes happen, one after the other."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.temporary = folder, folder / "tmp"
        self.temporary.mkdir()
        self.mark = f"COSIM_CRASH={os.getpid()}"
        name, _, value = self.mark.partition("=")
        self.environment = {**os.environ, "PYTHONPATH": str(ROOT), "TMPDIR": str(self.temporary), name: value}
        deeds_fmu(folder / "good.fmu")
        assert self.run("none", "none", 1).returncode == 0
        self.good = (folder / "out" / "results.csv").read_text()

    def run(self, call: str, deed: str, at: int) -> subprocess.CompletedProcess[str]:
        """Run a scenario in which a call does a deed at a step."""
        shutil.rmtree(self.folder / "out", ignore_errors=True)
        limits = "{step: 400 ms, load: 1500 ms}"
        path = deeds_scenario(self.folder, call, deed, at, 0.1 * STEPS, limits)
        command = [sys.executable, "-m", "cosim", "run", str(path), "--out", str(self.folder / "out"), "--no-report"]
        return subprocess.run(
            command, env=self.environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, timeout=60
        )

    def faults(self, call: str, deed: str, at: int) -> Iterator[str]:
        """Yield what is wrong with the end of a run."""
        done = self.run(call, deed, at)
        own = [line for line in done.stderr.splitlines() if line.startswith(("error: ", str(self.folder)))]
        if done.returncode != CODES[deed] or len(own) != 1:
            yield f"exit {done.returncode}, {len(own)} lines: {done.stderr[-300:]}"
        text = (self.folder / "out" / "results.csv").read_text()
        rows = len(text.splitlines()) - 1
        if not self.good.startswith(text):
            yield "rows differ from those of a good run"
        if (call == "DoStep" and rows != at) or (call in FREEING and rows != STEPS + 1):
            yield f"{rows} rows"
        end = time.monotonic() + 15.0
        while (left := self.left()) and time.monotonic() < end:
            time.sleep(0.1)
        yield from left

    def left(self) -> list[str]:
        """Return processes and folders that are left."""
        found = [path.name for path in (*self.temporary.iterdir(), *self.folder.glob("out/.*"))]
        for path in Path("/proc").glob("[0-9]*"):
            try:
                if self.mark.encode() in (path / "environ").read_bytes().split(b"\0"):
                    found.append(f"process {path.name}")
            except OSError:
                continue
        return found


def main(count: int) -> int:
    """Run the requested number of crashes and return the number of faults."""
    wrong, rng = 0, random.Random(SEED)
    with tempfile.TemporaryDirectory(prefix="crash-") as folder:
        trial = Trial(Path(folder))
        for _ in range(count):
            call, deed = rng.choice(CALLS), rng.choice([*CODES])
            at = rng.randint(2, STEPS) if call in RUNNING else 1
            for fault in trial.faults(call, deed, at):
                wrong += 1
                print(f"{call} {deed} {at}: {fault}", file=sys.stderr, flush=True)
    print(json.dumps({"induced": count, "wrong": wrong}))
    return wrong


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 200) > 0)
