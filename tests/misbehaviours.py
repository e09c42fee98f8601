"""What becomes of a run whose FMU misbehaves, here and elsewhere, as a table: `python -m tests.misbehaviours`.

Linux, with a C compiler. Others run as their Python packages, each in a process of its own that gets six seconds.
"""

from __future__ import annotations

import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

from tests.conftest import ROOT
from tests.deeds import deeds_fmu

STEPS = 10
PATIENCE = 6.0  # [s]
LIMITS = "{step: 1 s, load: 1 s, memory: 300 MB}"
CALLS = (
    "Instantiate", "EnterInitializationMode", "ExitInitializationMode", "SetReal", "DoStep", "GetReal", "Terminate",
    "FreeInstance",
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """A line of the table."""

    what: str
    call: str
    deed: str
    at: int = 5
    number: int = 0  # signal to the caller
    blocks: int = 0  # of 1024 bytes, how large a file may grow


CASES = (
    *(Case(f"segfault in {c}", c, "segfault", 5 if c in ("DoStep", "GetReal") else 1) for c in CALLS),
    Case("abort", "DoStep", "abort"),
    Case("exit(0)", "DoStep", "exit"),
    Case("stack overflow", "DoStep", "overflow"),
    *(Case(f"hang in {c}", c, "hang", 5 if c in ("DoStep", "GetReal") else 1) for c in CALLS),
    Case("endless memory", "DoStep", "memory"),
    Case("endless output", "DoStep", "print"),
    Case("endless log", "DoStep", "log"),
    Case("crash on free", "FreeInstance", "free", 1),
    Case("Discard", "DoStep", "discard"),
    Case("Error", "DoStep", "error"),
    Case("Fatal", "DoStep", "fatal"),
    Case("Warning", "DoStep", "warning"),
    Case("NaN", "none", "nan"),
    Case("early end", "DoStep", "end"),
    Case("changes folder and environment", "Instantiate", "folder", 1),
    Case("SIGTERM to the caller", "DoStep", "slow", 0, signal.SIGTERM),
    Case("SIGINT to the caller", "DoStep", "slow", 0, signal.SIGINT),
    Case("full disk", "none", "none", 1, 0, 100),
)

WATCHED = """
import os, runpy, sys
before = os.getcwd()
module = sys.argv.pop(1)
runpy.run_module(module, run_name="__main__")
if os.getcwd() != before:
    print("the caller's folder is changed", file=sys.stderr)
"""
FMPY = """
import os, sys, fmpy
before = os.getcwd()
from fmpy.util import write_csv
path, steps, target = sys.argv[1], int(sys.argv[2]), sys.argv[3]
result = fmpy.simulate_fmu(path, stop_time=0.1 * steps, output_interval=0.1, input=fmpy.util.read_csv(sys.argv[4]))
if os.getcwd() != before:
    print("the caller's folder is changed", file=sys.stderr)
write_csv(target, result)
"""


def fmu_of(folder: Path, case: Case) -> Path:
    """Return the FMU of a case; non-numbers appear from its step on."""
    return deeds_fmu(folder / "bad.fmu", case.call, case.deed, case.at)


def steps_of(case: Case) -> int:
    """How many steps are asked for."""
    return 1000 if case.number else 5000 if case.blocks else STEPS


def command_of(tool: str, folder: Path, case: Case) -> tuple[list[str], str]:
    """The command, and its input."""
    steps, fmu = steps_of(case), str(folder / "bad.fmu")
    if tool == "cosim":
        (folder / "run.yaml").write_text(
            f"name: run\nduration: {0.1 * steps:g}\nstep: 0.1\nlimits: {LIMITS}\n"
            "components:\n  fmu: {fmu: bad.fmu}\n  u: {block: reference, signals: {u: {start: 1}}}\n"
            "connections: [{from: u.u, to: fmu.u1}]\n"
        )
        command = [sys.executable, "-m", "cosim", "run", str(folder / "run.yaml"), "--no-report"]
        return [*command, "--out", str(folder / "out")], ""
    if tool == "FMPy":
        (folder / "in.csv").write_text("time,u1\n" + "".join(f"{0.1 * k:.1f},1\n" for k in range(steps + 1)))
        command = [sys.executable, "-c", FMPY, fmu, str(steps), str(folder / "out" / "results.csv")]
        return [*command, str(folder / "in.csv")], ""
    job = {
        "fmus": {"fmu": fmu}, "start": {"fmu": {"u1": 1.0}}, "connections": [], "columns": ["fmu.y0", "fmu.y1"],
        "steps": steps, "step": 0.1,
    }  # fmt: skip
    return [sys.executable, "-c", WATCHED, f"tests.hosts_{tool}"], json.dumps(job)


def run(tool: str, case: Case) -> str:
    """Run the case and return its outcome as text."""
    if case.blocks and tool not in ("cosim", "FMPy"):
        return "writes no file"
    with tempfile.TemporaryDirectory(prefix="misbehaviours-") as name:
        folder = Path(name)
        (folder / "out").mkdir()
        fmu_of(folder, case)
        command, text = command_of(tool, folder, case)
        if case.blocks:
            command = ["bash", "-c", f'ulimit -f {case.blocks}; exec "$@"', "bash", *command]
        elif case.deed == "memory" and tool != "cosim":  # or all else here would come to its end
            command = ["bash", "-c", 'ulimit -v 4000000; exec "$@"', "bash", *command]
        libraries = f"{sys.prefix}/lib:{os.environ.get('LD_LIBRARY_PATH', '')}"
        environment = {**os.environ, "PYTHONPATH": str(ROOT), "LD_LIBRARY_PATH": libraries, "TMPDIR": name}
        process = subprocess.Popen(
            command, cwd=folder, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
            stderr=subprocess.PIPE, text=True, errors="replace", start_new_session=True,
        )  # fmt: skip
        if case.number:
            time.sleep(4.0)
            process.send_signal(case.number)
        try:
            out, told = process.communicate(text, timeout=PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()
            return "hangs"
        return words(tool, process.returncode, told, _rows(folder, out), steps_of(case) + 1)


def _rows(folder: Path, out: str) -> int:
    file = folder / "out" / "results.csv"
    if file.exists():
        return max(0, file.read_text().count("\n") - 1)
    try:
        return len(json.loads(out.splitlines()[-1]))
    except (IndexError, ValueError):
        return 0


def words(tool: str, code: int, told: str, rows: int, asked: int) -> str:
    """An outcome for a cell."""
    kept = "all rows" if rows == asked else f"{rows} of {asked} rows"
    if tool == "cosim":
        own = [line for line in told.splitlines() if line.startswith("error: ")]
        said = own[-1].removeprefix("error: ").partition("; it said last")[0] if own else ""
        return f"exit {code}, {kept}" + (f": {said}" if said else "")
    if code < 0:
        return f"the caller ends ({signal.Signals(-code).name}), {kept if rows else 'no rows'}"
    if code == 0 and "folder is changed" in told:
        return "runs, the caller's folder is changed"
    if code == 0:
        return "runs" if rows == asked else f"exit 0, {kept}, {'no word' if not told.strip() else 'a message'}"
    if rows:
        return f"exit {code}, {kept}"
    last = next((line for line in reversed(told.splitlines()) if line.strip()), "")
    return f"exit {code}, no rows: {last.strip()[:90]}"


def tools() -> list[str]:
    """Return the installed tools."""
    others = {"libcosim": "libcosimpy", "ecos": "ecospy"}
    return ["cosim", "FMPy", *(tool for tool, package in others.items() if importlib.util.find_spec(package))]


def main(chosen: Sequence[str]) -> None:
    """Print the table line by line."""
    names = {"FMPy": "FMPy", "libcosim": "libcosimpy", "ecos": "ecospy"}
    columns = list(chosen) or tools()
    heads = [tool if tool == "cosim" else f"{tool} ({names[tool]} {version(names[tool])})" for tool in columns]
    print(f"| misbehaviour | {' | '.join(heads)} |\n|{'---|' * (len(heads) + 1)}", flush=True)
    for case in CASES:
        cells = [run(tool, case).replace("|", "/") for tool in columns]
        print(f"| {case.what} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
