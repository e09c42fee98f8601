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
import time
import zipfile
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

MOST_STEPS = 1000
LIMIT, FMPY_LIMIT = 100, 20  # s, each
NEAR = 1e-9
PLATFORMS = ("binaries/linux64/", "binaries/x86_64-linux/")


def fmus_in(folders: list[Path]) -> list[Path]:
    """Return FMUs with a library for Linux, without duplicates."""
    seen: set[str] = set()
    found = []
    for path in sorted(p for folder in folders for p in folder.rglob("*.fmu")):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        if digest in seen or not zipfile.is_zipfile(path):
            continue
        seen.add(digest)
        with zipfile.ZipFile(path) as archive:
            if any(name.startswith(PLATFORMS) and not name.endswith("/") for name in archive.namelist()):
                found.append(path)
    return found


def plan(description: Any) -> tuple[float, float, int]:
    """Start, step and number of steps, as FMPy takes them from the default experiment."""
    experiment, cosimulation = description.defaultExperiment, description.coSimulation
    start = float(getattr(experiment, "startTime", None) or 0.0)
    stop = getattr(experiment, "stopTime", None)
    stop = start + 1.0 if stop is None else float(stop)
    step = getattr(cosimulation, "fixedInternalStepSize", None) or getattr(experiment, "stepSize", None)
    step = (stop - start) / 500 if not step else float(step)
    return start, step, min(MOST_STEPS, max(1, math.floor((stop - start) / step + 1e-9)))


def one(path: Path, way: str) -> dict[str, Any]:
    """Simulate an FMU with both programs and compare; called in a separate process."""
    import fmpy

    found: dict[str, Any] = {"fmu": path.name, "way": way, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    try:
        description = fmpy.read_model_description(str(path), validate=False)
        found["tool"], found["fmi"] = (description.generationTool or "?"), description.fmiVersion
        start, step, steps = plan(description)
    except Exception as error:
        description, start, step, steps = None, 0.0, 0.01, 100
        found["fmpy"] = f"fails: {error}"
    reference = None
    if description is not None:
        try:
            began = time.monotonic()
            reference = fmpys(path, way, description, start, step, steps)
            found["fmpy"], found["rows"] = "runs", len(reference)
            if time.monotonic() - began > FMPY_LIMIT and len(reference) <= steps:
                steps = len(reference) - 1  # a slow one: what it came to
            if len(reference) > steps + 1:
                found["fmpy"], reference = "fails: stands still at a step that is discarded", None
        except Exception as error:
            found["fmpy"] = f"fails: {error}"
    try:
        recorded = [] if reference is None else list(reference.dtype.names[1:])
        results = ours(path, way, start, step, steps, recorded)
        found["cosim"], found["rows_cosim"] = "runs", len(results.time)
    except Exception as error:
        found["cosim"] = f"fails: {error}"
        return found
    if reference is None:
        return found
    found |= compared(lambda name: columns_of(results, name), results.time, reference, step)
    if found["difference"] > NEAR:
        again = fmpys(path, way, description, start, step, steps)
        itself = compared(lambda name: [again[name]], again["time"], reference, step)
        found["itself"] = itself["difference"]
    return found


def fmpys(path: Path, way: str, description: Any, start: float, step: float, steps: int) -> Any:
    """Results of FMPy."""
    import fmpy

    return fmpy.simulate_fmu(
        str(path),
        validate=False,
        fmi_type="CoSimulation" if way == "co-simulation" else "ModelExchange",
        start_time=start,
        stop_time=start + step * steps,
        output_interval=step,
        record_events=False,
        timeout=FMPY_LIMIT,
        **({} if description.fmiVersion == "1.0" else {"logger": lambda *_: None}),
    )


def columns_of(results: Any, name: str) -> list[Any]:
    """Return the columns of a variable: one for a scalar, one per element for an array."""
    if f"x.{name}" in results.exact:
        return [results.exact[f"x.{name}"]]
    exact = [column for key, column in results.exact.items() if key.startswith(f"x.{name}[")]
    columns = [c for c in results.columns if c == f"x.{name}"]
    return exact or [results[c] for c in columns or results.columns if c in columns or c.startswith(f"x.{name}[")]


def compared(columns: Any, times: Any, reference: Any, step: float) -> dict[str, Any]:
    """Return the largest |a − b| / max(1, |b|) of all columns recorded by FMPy, at common times."""
    worst, where, count, missing = 0.0, "", 0, []
    at = {round(t / step * 1e6): k for k, t in enumerate(times.tolist())}
    last = {round(t / step * 1e6): k for k, t in enumerate(reference["time"].tolist())}  # of several rows the last
    shared = sorted(at.keys() & last.keys())
    for name in reference.dtype.names[1:]:
        values, wanted = columns(name), reference[name].reshape(len(reference), -1)
        if len(values) != wanted.shape[1]:
            missing.append(name)
            continue
        for value, column in zip(values, wanted.T, strict=True):
            count += 1
            for k in shared:
                b, a = column[last[k]].item(), value[at[k]]
                if a == b or (a != a and b != b):
                    continue
                difference = abs(float(a) - float(b)) / max(1.0, abs(float(b)))
                if not difference <= worst:
                    worst, where = difference, f"{name} at {times[at[k]]:g} s"
    return {"difference": worst, "where": where, "compared": count, "shared": len(shared), "missing": missing}


def ours(path: Path, way: str, start: float, step: float, steps: int, recorded: Sequence[str] = ()) -> Any:
    """Results of `cosim` for the FMU alone."""
    from cosim.master.master import StoppedRun, simulate
    from cosim.scenario.scenario_file import ScenarioFile
    from cosim.system.system import build_system

    scenario = {
        "name": "alone",
        "start_time": start,
        "duration": step * steps,
        "step": step,
        "record": [f"x.{name}" for name in recorded],
        "components": {"x": {"fmu": str(path), "interface": way}},
    }
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "alone.yaml"
        file.write_text(json.dumps(scenario))
        read = ScenarioFile(file)
        system = build_system(read)
        try:
            return simulate(system, read.scenario.steps, step)
        except StoppedRun as stopped:
            raise RuntimeError(str(stopped.error)) from None


def measured(path: Path, way: str) -> dict[str, Any]:
    """Return the result of `one` from a separate process."""
    found: dict[str, Any] = {"fmu": path.name, "way": way}
    with tempfile.TemporaryDirectory() as folder:
        answer = Path(folder) / "answer.json"
        command = [sys.executable, "-m", "tests.foreign", "--one", str(path.resolve()), way, str(answer)]
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=LIMIT
            )
            if answer.is_file():
                found |= json.loads(answer.read_text())
            else:
                found["fmpy"] = found["cosim"] = f"process ended with {done.returncode}"
            if done.returncode:
                found["exit"] = done.returncode
        except subprocess.TimeoutExpired:
            found["fmpy"] = found["cosim"] = f"not done in {LIMIT} s"
    return found


def ways_of(path: Path) -> list[str]:
    """Return the interfaces of the FMU according to its description."""
    try:
        with zipfile.ZipFile(path) as archive:
            text = archive.read("modelDescription.xml").decode("utf-8", "replace")
    except (KeyError, zipfile.BadZipFile):
        return []
    if re.search(r"fmiVersion\s*=\s*.1\.0", text):  # which has an element for co-simulation alone
        return ["co-simulation" if "<Implementation" in text else "model-exchange"]
    known = (("co-simulation", "<CoSimulation"), ("model-exchange", "<ModelExchange"))
    return [way for way, tag in known if tag in text] or ["co-simulation"]


def page(rows: list[dict[str, Any]]) -> str:
    """Return the table with a row per FMU; docs/foreign-fmus.md has the sums by tool."""
    lines = ["| FMU | made by | FMI | co-simulation | model exchange |", "|---|---|---|---|---|"]
    fmus: dict[str, dict[str, dict[str, Any]]] = {}
    for row in rows:
        fmus.setdefault(row["fmu"] + row.get("sha256", ""), {})[row["way"]] = row
    for each in fmus.values():
        first = next(iter(each.values()))
        name = first["fmu"].removesuffix(".fmu").rpartition("resources_")[2].rpartition("fmus_")[2].replace("|", "/")
        tool = " ".join(first.get("tool", "?").split())[:34]
        cells = (_outcome(each.get(way)) for way in ("co-simulation", "model-exchange"))
        lines.append(
            f"| {name} {first.get('sha256', '')[:6]} | {tool} | {first.get('fmi', '?')} | {' | '.join(cells)} |"
        )
    return "\n".join(lines)


def _outcome(row: dict[str, Any] | None) -> str:
    if row is None:
        return "–"
    runs, reference = row.get("cosim") == "runs", row.get("fmpy") == "runs"
    if runs and reference:
        itself = f", FMPy from itself {row['itself']:.0e}" if row.get("itself") else ""
        return "equal" if row["difference"] == 0 else f"{row['difference']:.0e}{itself}"
    if runs:
        return "runs, FMPy does not"
    why = re.sub(r"\S+\.yaml:\d+:\d+: |\S*/\S*/|\S+\.fmu |\|", "", str(row.get("cosim", "?")).removeprefix("fails: "))
    return f"{'refused' if not reference else 'LOST'}: {' '.join(why.split())[:140]}"


def summary(rows: list[dict[str, Any]]) -> str:
    """Return the number of FMUs that run, and their largest differences."""
    both = [r for r in rows if r.get("fmpy") == "runs"]
    ran = [r for r in both if r.get("cosim") == "runs"]
    lines = [
        f"{len({r['fmu'] + r.get('sha256', '') for r in rows})} FMUs, {len(rows)} runs; FMPy runs {len(both)}, "
        f"of these cosim {len(ran)}; cosim runs {sum(r.get('cosim') == 'runs' for r in rows)} in all."
    ]
    for way in ("co-simulation", "model-exchange"):
        part = [r["difference"] for r in ran if r["way"] == way]
        equal, near = sum(d == 0 for d in part), sum(d <= NEAR for d in part)
        lines.append(f"{way}: {len(part)} compared, {equal} equal bit for bit, {near} within 1e-9·max(1, |b|).")
    return "\n".join(lines)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--one", nargs=3, metavar=("FMU", "WAY", "ANSWER"))
    given = parser.parse_args()
    if given.one:
        path, way, answer = given.one
        Path(answer).write_text(json.dumps(one(Path(path), way)))
        return 0
    rows = []
    for path in fmus_in(given.folders):
        rows += [measured(path, way) for way in ways_of(path)]
        print(path.name, file=sys.stderr, flush=True)
    print(f"{page(rows)}\n\nFMPy {version('fmpy')}, Python {sys.version.split()[0]}, {sys.platform}\n{summary(rows)}")
    return int(any(r.get("fmpy") == "runs" and r.get("cosim") != "runs" for r in rows))


if __name__ == "__main__":
    sys.exit(main())
