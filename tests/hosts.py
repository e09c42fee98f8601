"""Which simulator runs which FMU: `python -m tests.hosts [FOLDER]` prints the table of docs/hosts.md.

FOLDER is where `cosim build` left its FMUs (build); what is not there is said so. Each FMU runs alone, its inputs held,
and the closed loop as an SSP that `cosim export-ssp` writes. A cell is the largest |a − b| / max(1, |b|) of the host's
rows from those of `cosim`, Jacobi, or why there are none. A host that is not here is a row with the reason.
"""

from __future__ import annotations

import argparse
import csv
import importlib.util
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cosim.authoring.export import export_ssp
from cosim.core.errors import CosimError
from cosim.simulation.workflow import run
from tests.hosts_fmpy import description_of

ROOT = Path(__file__).resolve().parent.parent
LIBRARIES = Path(sys.prefix) / "lib"  # where pip puts libtbb, which ecos is linked to
STEP, STEPS, LIMIT = 0.02, 200, 120
NEAR = 1e-9
PLANT = {"duty_right": 6.45, "duty_left": 6.2, "tilt_right": 0.1, "tilt_left": 0.05}
CONTROLLER = {"psi": 0.3, "x_ref": 1.0, "ax": 0.2}
FMUS = {  # column → file, inputs
    "plant (pythonfmu)": ("plant.fmu", PLANT),
    "plant, native": ("plant-native.fmu", PLANT),
    "refined plant, native": ("refined/plant-native.fmu", PLANT),
    "controller, native": ("controller-native.fmu", CONTROLLER),
}
LOOPS = {  # column → plant, controller
    "loop as SSP": ("plant.fmu", "controller.fmu"),
    "native loop as SSP": ("plant-native.fmu", "controller-native.fmu"),
}


@dataclass(frozen=True)
class Host:
    """A simulator: why it is not here, "" where it is; what it makes of a job, rows; whether it reads SSPs."""

    name: str
    missing: Callable[[], str]
    rows: Callable[[dict[str, Any]], np.ndarray] | None = None
    ssps: bool = True


class Refused(Exception):
    """Why a host did not run it."""


def in_process(module: str) -> Callable[[dict[str, Any]], np.ndarray]:
    """Return a function from a job to rows of a host in a separate process, since some hosts crash."""

    def rows(job: dict[str, Any]) -> np.ndarray:
        done = subprocess.run(
            [sys.executable, "-m", module], input=json.dumps(job), capture_output=True, text=True, cwd=ROOT,
            timeout=LIMIT, check=False, env={**os.environ, "LD_LIBRARY_PATH": str(LIBRARIES)},
        )  # fmt: skip
        lines = [line for line in done.stdout.splitlines() if "[[" in line]
        if not lines:
            raise Refused(reason(done.stderr or done.stdout) or f"ended with {done.returncode}")
        return np.array(json.JSONDecoder().raw_decode(lines[-1][lines[-1].index("[[") :])[0])

    return rows


def reason(text: str) -> str:
    """Return the line of a host's output with the reason of a failure, without paths."""
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith(" ")]  # those are code
    telling = [line for line in lines if re.search(r"error|undefined|fail|could not|fatal", line, re.IGNORECASE)]
    line = (telling or lines or [""])[0 if telling else -1]
    return " ".join(re.sub(r"\S*/(?=[^/\s]+)", "", line).replace("|", "/").split())[:110]


def checker() -> str | None:
    """Return the FMI compliance checker from the path or FMUCHECK."""
    named = os.environ.get("FMUCHECK")
    return named or next(filter(None, map(shutil.which, ("fmuCheck.linux64", "fmuCheck"))), None)


def checker_rows(job: dict[str, Any]) -> np.ndarray:
    """Rows of the compliance checker: a host of C without Python. Inputs come from a file."""
    ((name, fmu),) = job["fmus"].items()
    inputs = job["start"][name]
    with tempfile.TemporaryDirectory() as folder:
        given, made, said = (Path(folder) / n for n in ("in.csv", "out.csv", "log"))
        row = ",".join(map(repr, inputs.values()))
        names = ",".join(f'"{n}"' for n in inputs)
        given.write_text(f'"time",{names}\n0,{row}\n{job["steps"] * job["step"]},{row}\n')
        command = [str(checker()), "-k", "cs", "-n", "0", "-h", repr(job["step"])]
        command += ["-s", repr(job["step"] * job["steps"]), "-i", str(given), "-o", str(made), "-e", str(said), fmu]
        subprocess.run(command, capture_output=True, timeout=LIMIT, check=False)
        with made.open() as stream:
            rows = list(csv.DictReader(stream))
        if len(rows) <= job["steps"]:
            raise Refused(reason(said.read_text(errors="replace")))
    columns = [column.partition(".")[2] for column in job["columns"]]
    return np.array([[float(row[column]) for column in columns] for row in rows[: job["steps"] + 1]])


def needs(package: str) -> Callable[[], str]:
    return lambda: "" if importlib.util.find_spec(package) else f"not here: pip install {package}"


def ecos_needs() -> str:
    return needs("ecospy")() or ("" if list(LIBRARIES.glob("libtbb.so*")) else "not here: pip install tbb")


HOSTS = (
    Host("FMPy", needs("fmpy"), in_process("tests.hosts_fmpy_ssp")),
    Host("libcosim", needs("libcosimpy"), in_process("tests.hosts_libcosim")),
    Host("ecos", ecos_needs, in_process("tests.hosts_ecos")),
    Host(
        "FMUComplianceChecker",
        lambda: "" if checker() else "not here: it is built from source, with FMILibrary; FMUCHECK=… says where",
        checker_rows,
        ssps=False,
    ),
)
PACKAGES = {"FMPy": "fmpy", "libcosim": "libcosimpy", "ecos": "ecospy"}


def shown_version(host: Host) -> str:
    """A host's name with the version of its package."""
    if host.name not in PACKAGES or host.missing():
        return host.name
    package = PACKAGES[host.name]
    return f"{host.name} {version(package)}" if package == "fmpy" else f"{host.name} ({package} {version(package)})"


@cache
def ours(source: Path, faults: str = "[]") -> Any:
    """Results of a scenario or an SSP here."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [f"step={STEP}", f"duration={STEP * STEPS}", f"faults={faults}"]
        return run(source, folder, overrides, report=False).results


def alone(fmu: Path, inputs: Mapping[str, float], host: Host, folder: Path) -> float:
    """How far a host is off with an FMU alone."""
    file = folder / f"{fmu.parent.name}-{fmu.stem}.json"
    start = dict(inputs)
    components = {"x": {"fmu": str(fmu.resolve()), "start": start}}
    content = {"name": "x", "duration": STEP * STEPS, "step": STEP, "algorithm": "jacobi", "components": components}
    file.write_text(json.dumps(content))
    results = ours(file)
    outputs = {f"x.{v.name}" for v in description_of(fmu).modelVariables if v.causality == "output"}
    columns = [c for c in results.columns if c in outputs]
    job = {"fmus": {"x": str(fmu.resolve())}, "start": {"x": start}, "connections": [], "columns": columns}
    return distance(results, host, {**job, "step": STEP, "steps": STEPS})


def looped(ssp: Path, host: Host) -> float:
    """Return the distance of a host's results for an SSP; connected inputs are zero in FMPy's first step."""
    results = ours(ssp)
    with tempfile.TemporaryDirectory() as folder:
        run(ssp, folder, [f"duration={STEP}", f"step={STEP}"], report=False)
        scenario = json.loads((Path(folder) / "system" / "scenario.json").read_text())
    fed = [connection["to"] for connection in scenario["connections"]]
    if host.name == "FMPy":
        none = [{"on": signal, "kind": "stuck", "value": 0, "from": 0, "to": 0} for signal in fed]
        results = ours(ssp, json.dumps(none))
    columns = [c for c in results.columns if c not in fed]
    return distance(
        results, host, {"ssp": str(ssp), "columns": columns, "step": STEP, "steps": STEPS, "parameters": "start"}
    )


def distance(results: Any, host: Host, job: dict[str, Any]) -> float:
    """Return the largest |a − b| / max(1, |b|) after row 0, which some hosts omit."""
    assert host.rows is not None
    try:
        got = host.rows(job)
    except subprocess.TimeoutExpired:
        raise Refused(f"not done in {LIMIT} s") from None
    want = np.column_stack([results[column] for column in job["columns"]])
    assert np.ptp(want, axis=0).max() > 1e-3, "nothing moves"
    return float(np.max(np.abs(got[1:] - want[1:]) / np.maximum(1.0, np.abs(want[1:]))))


def cell(attempt: Callable[[], float], why: str = "") -> str:
    """Return the text of a table cell: the distance, or the reason for a missing result."""
    if why:
        return why
    try:
        off = attempt()
    except (Refused, CosimError) as error:
        return f"no: {reason(str(error))}"
    return "equal" if off == 0.0 else f"{off:.0e}" if off <= NEAR else f"**{off:.0e}**"


def loops(folder: Path, made: Path) -> dict[str, Path | None]:
    """Return the closed loop as an SSP for each available pair of FMUs; None for missing pairs."""
    found: dict[str, Path | None] = {}
    source = ROOT / "scenarios" / "manoeuvre.yaml"
    for name, (plant, controller) in LOOPS.items():
        found[name] = None
        if (folder / plant).is_file() and (folder / controller).is_file():
            files = {"plant": folder / plant, "controller": folder / controller}
            overrides = [f"components.{c}.fmu={json.dumps(str(f.resolve()))}" for c, f in files.items()]
            overrides += ["criteria={}", f"duration={STEP * STEPS}", f"step={STEP}"]
            path = made / f"{name.replace(' ', '-')}.ssp"
            found[name] = export_ssp(source, path, tuple(overrides)).path
    return found


def table(folder: Path) -> str:
    """The matrix in Markdown."""
    columns = [*FMUS, *LOOPS]
    lines = [f"| host | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    with tempfile.TemporaryDirectory() as name:
        made = Path(name)
        ssps = loops(folder, made)
        for host in HOSTS:
            cells: list[str] = []
            missing = host.missing()
            for file, inputs in FMUS.values():
                there = (folder / file).is_file()
                cells.append(cell(partial(alone, folder / file, inputs, host, made), missing if there else "not built"))
            for ssp in ssps.values():
                why = missing or ("" if host.ssps else "reads no SSP")
                cells.append("not built" if ssp is None else cell(partial(looped, ssp, host), why))
            if missing:
                cells = [missing, *[""] * (len(columns) - 1)]
            lines.append(f"| {shown_version(host)} | {' | '.join(cells)} |")
            print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "build")
    print(table(parser.parse_args().folder))
    print(f"\nPython {platform.python_version()}, {platform.system()} {platform.machine()}")


if __name__ == "__main__":
    main()
