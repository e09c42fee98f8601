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
from tests.conftest import ROOT
from tests.hosts_fmpy import description_of

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
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith(" ")] or [""]  # those are code
    telling = [line for line in lines if re.search(r"error|undefined|fail|could not|fatal", line, re.IGNORECASE)]
    line = telling[0] if telling else lines[-1]
    return " ".join(re.sub(r"\S*/(?=[^/\s]+)", "", line).replace("|", "/").split())[:110]


def checker() -> str | None:
    """Return the FMI compliance checker from the path or FMUCHECK."""
    named = os.environ.get("FMUCHECK")
    return named or next(filter(None, map(shutil.which, ("fmuCheck.linux64", "fmuCheck"))), None)


def checker_rows(job: dict[str, Any]) -> np.ndarray:
    """Rows of the compliance checker: a host of C without Python. Inputs come from a file."""
    ((name, fmu),) = job["fmus"].items()
    inputs, steps, stop = job["start"][name], job["steps"], job["step"] * job["steps"]
    with tempfile.TemporaryDirectory() as folder:
        given, made, said = (Path(folder) / n for n in ("in.csv", "out.csv", "log"))
        row = ",".join(map(repr, inputs.values()))
        names = ",".join(f'"{n}"' for n in inputs)
        given.write_text(f'"time",{names}\n0,{row}\n{stop},{row}\n')
        command = f"{checker()} -k cs -n 0 -h {job['step']!r} -s {stop!r} -i {given} -o {made} -e {said} {fmu}"
        subprocess.run(command.split(), capture_output=True, timeout=LIMIT, check=False)
        with made.open() as stream:
            rows = list(csv.DictReader(stream))[: steps + 1]
        if len(rows) <= steps:
            raise Refused(reason(said.read_text(errors="replace")))
    return np.array([[float(row[column.partition(".")[2]]) for column in job["columns"]] for row in rows])


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


@cache
def ours(source: Path, faults: str = "[]") -> Any:
    """Results of a scenario or an SSP here."""
    with tempfile.TemporaryDirectory() as folder:
        overrides = [f"step={STEP}", f"duration={STEP * STEPS}", f"faults={faults}"]
        return run(source, folder, overrides, report=False).results


def alone(fmu: Path, inputs: Mapping[str, float], host: Host, folder: Path) -> float:
    """How far a host is off with an FMU alone."""
    file, start, fmus = folder / f"{fmu.parent.name}-{fmu.stem}.json", dict(inputs), {"x": str(fmu.resolve())}
    content = {"name": "x", "duration": STEP * STEPS, "step": STEP, "algorithm": "jacobi"}
    file.write_text(json.dumps(content | {"components": {"x": {"fmu": fmus["x"], "start": start}}}))
    results = ours(file)
    outputs = {f"x.{v.name}" for v in description_of(fmu).modelVariables if v.causality == "output"}
    columns = [c for c in results.columns if c in outputs]
    return distance(results, host, {"fmus": fmus, "start": {"x": start}, "connections": [], "columns": columns})


def looped(ssp: Path, host: Host) -> float:
    """Return the distance of a host's results for an SSP; connected inputs are zero in FMPy's first step."""
    with tempfile.TemporaryDirectory() as folder:
        run(ssp, folder, [f"duration={STEP}", f"step={STEP}"], report=False)
        scenario = json.loads((Path(folder) / "system" / "scenario.json").read_text())
    fed = [connection["to"] for connection in scenario["connections"]]
    none = [{"on": signal, "kind": "stuck", "value": 0, "from": 0, "to": 0} for signal in fed]
    results = ours(ssp, json.dumps(none if host.name == "FMPy" else []))
    return distance(results, host, {"ssp": str(ssp), "columns": [c for c in results.columns if c not in fed]})


def distance(results: Any, host: Host, job: dict[str, Any]) -> float:
    """Return the largest |a − b| / max(1, |b|) after row 0, which some hosts omit."""
    assert host.rows is not None
    try:
        got = host.rows({**job, "step": STEP, "steps": STEPS})
    except subprocess.TimeoutExpired:
        raise Refused(f"not done in {LIMIT} s") from None
    want = np.column_stack([results[column] for column in job["columns"]])
    assert np.ptp(want, axis=0).max() > 1e-3, "nothing moves"
    return float(np.max(np.abs(got[1:] - want[1:]) / np.maximum(1.0, np.abs(want[1:]))))


def cell(attempt: Callable[[], float]) -> str:
    """Return the text of a table cell: the distance, or the reason for a missing result."""
    try:
        off = attempt()
    except (Refused, CosimError) as error:
        return f"no: {reason(str(error))}"
    return "equal" if off == 0.0 else f"{off:.0e}" if off <= NEAR else f"**{off:.0e}**"


def loops(folder: Path, made: Path) -> list[Path | None]:
    """Return the closed loop as an SSP for each pair of FMUs; None for those that are not there."""
    found: list[Path | None] = []
    for number, pair in enumerate(LOOPS.values()):
        files = {name: (folder / file).resolve() for name, file in zip(("plant", "controller"), pair, strict=True)}
        overrides = [f"components.{name}.fmu={json.dumps(str(file))}" for name, file in files.items()]
        overrides += ["criteria={}", f"duration={STEP * STEPS}", f"step={STEP}"]
        is_there = all(file.is_file() for file in files.values())
        source, path = ROOT / "scenarios" / "manoeuvre.yaml", made / f"{number}.ssp"
        found.append(export_ssp(source, path, tuple(overrides)).path if is_there else None)
    return found


def table(folder: Path) -> str:
    """The matrix in Markdown."""
    columns = [*FMUS, *LOOPS]
    lines = [f"| host | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    with tempfile.TemporaryDirectory() as name:
        ssps = loops(folder, Path(name))
        for host in HOSTS:
            if host.missing():
                lines.append(f"| {host.name} | {host.missing()} |" + " |" * (len(columns) - 1))
                continue
            cells = [
                cell(partial(alone, folder / file, inputs, host, Path(name)))
                if (folder / file).is_file()
                else "not built"
                for file, inputs in FMUS.values()
            ]
            for ssp in ssps:
                there = "not built" if ssp is None else "" if host.ssps else "reads no SSP"
                cells.append(there or cell(partial(looped, ssp, host)))
            package = PACKAGES.get(host.name)
            shown = f"{host.name} ({package} {version(package)})" if package else host.name
            shown = shown.replace("(fmpy ", "").removesuffix(")") if package == "fmpy" else shown
            lines.append(f"| {shown} | {' | '.join(cells)} |")
            print(lines[-1], file=sys.stderr, flush=True)
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "build")
    print(table(parser.parse_args().folder))
    print(f"\nPython {platform.python_version()}, {platform.system()} {platform.machine()}")


if __name__ == "__main__":
    main()
