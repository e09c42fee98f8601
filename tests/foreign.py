"""Other people's FMUs, each run by `cosim` and by FMPy's own `simulate_fmu`: `python -m tests.foreign FOLDER…`.

Whatever FMUs with a library for this platform lie in the folders are run alone, in every way that they offer, by
both at the tolerance and step of their default experiment; what they record is compared row by row. Each FMU runs
in a process of its own, for some crash. Prints a table in Markdown.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import re
import subprocess
import sys
import tempfile
import zipfile
from importlib.metadata import version
from pathlib import Path
from typing import Any

import fmpy

from cosim.master.master import StoppedRun, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system

MOST_STEPS = 1000
LIMIT, FMPY_LIMIT = 100, 20  # s, each
NEAR = 1e-9
PLATFORMS = ("binaries/linux64/", "binaries/x86_64-linux/")
WAYS = {"co-simulation": "CoSimulation", "model-exchange": "ModelExchange"}


def fmus_in(folders: list[Path]) -> dict[str, Path]:
    """Return FMUs with a library for Linux by their SHA-256."""
    found: dict[str, Path] = {}
    for path in sorted(p for folder in folders for p in folder.rglob("*.fmu") if zipfile.is_zipfile(p)):
        with zipfile.ZipFile(path) as archive:
            if any(name.startswith(PLATFORMS) and not name.endswith("/") for name in archive.namelist()):
                found.setdefault(hashlib.sha256(path.read_bytes()).hexdigest(), path)
    return found


def plan(description: Any) -> tuple[float, float, int]:
    """Start, step and number of steps, as FMPy takes them from the default experiment."""
    experiment, cosimulation = description.defaultExperiment, description.coSimulation
    start = float(getattr(experiment, "startTime", None) or 0.0)
    stop = getattr(experiment, "stopTime", None)
    stop = start + 1.0 if stop is None else float(stop)
    step = getattr(cosimulation, "fixedInternalStepSize", None) or getattr(experiment, "stepSize", None)
    step = float(step or (stop - start) / 500)
    return start, step, min(MOST_STEPS, max(1, math.floor((stop - start) / step + 1e-9)))


def one(path: Path, way: str) -> dict[str, Any]:
    """Simulate an FMU with both programs and compare; called in a separate process."""
    found: dict[str, Any] = {}
    reference, start, step, steps = None, 0.0, 0.01, 100
    try:
        description = fmpy.read_model_description(str(path), validate=False)
        found |= {"tool": description.generationTool or "?", "fmi": description.fmiVersion}
        start, step, steps = plan(description)
        reference = fmpys(path, way, description, start, step, steps)
        if len(reference) > steps + 1:
            raise RuntimeError("stands still at a step that is discarded")
        steps = len(reference) - 1  # of a slow one: what it came to
        found["fmpy"] = "runs"
    except Exception as error:
        reference, found["fmpy"] = None, f"fails: {error}"
    try:
        results = ours(path, way, start, step, steps, [] if reference is None else reference.dtype.names[1:])
        found["cosim"] = "runs"
    except Exception as error:
        return found | {"cosim": f"fails: {error}"}
    return found if reference is None else found | {"difference": difference(results, reference, step)}


def fmpys(path: Path, way: str, description: Any, start: float, step: float, steps: int) -> Any:
    """Results of FMPy."""
    return fmpy.simulate_fmu(
        str(path), validate=False, fmi_type=WAYS[way], start_time=start, stop_time=start + step * steps,
        output_interval=step, record_events=False, timeout=FMPY_LIMIT,
        **({} if description.fmiVersion == "1.0" else {"logger": lambda *_: None}),
    )  # fmt: skip


def ours(path: Path, way: str, start: float, step: float, steps: int, recorded: Any) -> Any:
    """Results of `cosim` for the FMU alone."""
    scenario = {
        "name": "alone", "start_time": start, "duration": step * steps, "step": step,
        "record": [f"x.{name}" for name in recorded], "components": {"x": {"fmu": str(path), "interface": way}},
    }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "alone.json"
        file.write_text(json.dumps(scenario))
        read = ScenarioFile(file)
        try:
            return simulate(build_system(read), read.scenario.steps, step)
        except StoppedRun as stopped:
            raise RuntimeError(str(stopped.error)) from None


def difference(results: Any, reference: Any, step: float) -> float:
    """Return the largest |a − b| / max(1, |b|) of all columns recorded by FMPy, at common times."""
    worst = 0.0
    at = {round(t / step * 1e6): k for k, t in enumerate(results.time.tolist())}
    last = {round(t / step * 1e6): k for k, t in enumerate(reference["time"].tolist())}  # of several rows the last
    shared = sorted(at.keys() & last.keys())
    for name in reference.dtype.names[1:]:
        columns = [*results.exact, *(column for column in results.columns if column not in results.exact)]
        columns = [c for c in columns if c == f"x.{name}" or c.startswith(f"x.{name}[")]  # a scalar, or elements
        wanted = reference[name].reshape(len(reference), -1)
        if len(columns) != wanted.shape[1]:
            return math.inf
        for column, of_fmpy in zip(columns, wanted.T, strict=True):
            values = results.exact[column] if column in results.exact else results[column]
            for k in shared:
                a, b = values[at[k]], of_fmpy[last[k]].item()
                if a != b and (a == a or b == b):
                    off = abs(float(a) - float(b)) / max(1.0, abs(float(b)))
                    worst = off if not off <= worst else worst
    return worst


def measured(path: Path, way: str) -> dict[str, Any]:
    """Return the result of `one` from a separate process."""
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"
        command = [sys.executable, "-m", "tests.foreign", "--one", str(path.resolve()), way, str(answer)]
        try:
            done = subprocess.run(command, stdin=subprocess.DEVNULL, capture_output=True, timeout=LIMIT)
            why = f"process ended with {done.returncode}"
        except subprocess.TimeoutExpired:
            why = f"not done in {LIMIT} s"
        found = json.loads(answer.read_text()) if answer.is_file() else {"fmpy": why, "cosim": why}
    return {"way": way, **found}


def ways_of(path: Path) -> list[str]:
    """Return the interfaces of the FMU according to its description."""
    with zipfile.ZipFile(path) as archive:
        text = archive.read("modelDescription.xml").decode("utf-8", "replace")
    if re.search(r"fmiVersion\s*=\s*.1\.0", text):  # which has an element for co-simulation alone
        return ["co-simulation" if "<Implementation" in text else "model-exchange"]
    return [way for way, tag in WAYS.items() if f"<{tag}" in text] or ["co-simulation"]


def outcome(row: dict[str, Any] | None) -> str:
    """Return the text of a table cell."""
    if row is None:
        return "–"
    if "difference" in row:
        return "equal" if row["difference"] == 0 else f"{row['difference']:.0e}"
    if row["cosim"] == "runs":
        return "runs, FMPy does not"
    why = re.sub(r"\S+\.json:\d+:\d+: |\S*/\S*/|\S+\.fmu |\|", "", row["cosim"].removeprefix("fails: "))
    return f"{'LOST' if row['fmpy'] == 'runs' else 'refused'}: {' '.join(why.split())[:140]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--one", nargs=3, metavar=("FMU", "WAY", "ANSWER"))
    given = parser.parse_args()
    if given.one:
        path, way, answer = given.one
        Path(answer).write_text(json.dumps(one(Path(path), way)))
        return 0
    print("| FMU | made by | FMI | co-simulation | model exchange |", "|---|---|---|---|---|", sep="\n")
    rows: list[dict[str, Any]] = []
    for digest, fmu in fmus_in(given.folders).items():
        runs = {way: measured(fmu, way) for way in ways_of(fmu)}
        rows += runs.values()
        first = rows[-1]
        cells = [f"{fmu.stem} {digest[:6]}", first.get("tool", "?")[:34], first.get("fmi", "?")]
        cells += [outcome(runs.get(way)) for way in WAYS]
        print("|", " | ".join(" ".join(cell.replace("|", "/").split()) for cell in cells), "|", flush=True)
    print(f"\nFMPy {version('fmpy')}, Python {sys.version.split()[0]}, {sys.platform}; {len(rows)} runs")
    for way in WAYS:
        part = [row["difference"] for row in rows if row["way"] == way and "difference" in row]
        equal, near = sum(d == 0 for d in part), sum(d <= NEAR for d in part)
        print(f"{way}: {len(part)} compared, {equal} equal bit for bit, {near} within 1e-9·max(1, |b|).")
    return int(any(row["fmpy"] == "runs" != row["cosim"] for row in rows))


if __name__ == "__main__":
    sys.exit(main())
