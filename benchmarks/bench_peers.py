"""Benchmarks against FMPy of the waiting time beside the steps: start of a run, check, sweep, many FMUs.

The FMU is C written by hand (`bench_fmu.c`) and has nothing of cosim in it. docs/performance.md shows both sides.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from statistics import median

from benchmarks.measure import median_ratio
from cosim.fmi.native.compiler import compiler

H, STEPS = 0.02, 100  # of the start
SWEEP_STEPS, RUNS, INSTANCES, ROUNDS = 200, 1000, 1000, 3
FIGURES = (
    "start_over_fmpy_simulate",
    "check_over_import",
    "sweep_over_fmpy",
    "sweep_over_fmpy_cpu",
    "sweep_with_variables_over_fmpy_cpu",
    "many_over_fmpy",
)
SWEEP = """scenario: lags{steps}.yaml
runs: {runs}
vary: {{a.rate: {{uniform: [1, 2]}}}}
"""
FMPY_MANY = """
import os
import sys
import tempfile
from fmpy import extract, read_model_description
from fmpy.fmi2 import FMU2Slave

path, count, h = sys.argv[1], int(sys.argv[2]), float(sys.argv[3])
description, place = read_model_description(path), extract(path, tempfile.mkdtemp(dir=os.getcwd()))
about = {"guid": description.guid, "modelIdentifier": "lags", "unzipDirectory": place}
parts = [FMU2Slave(instanceName=f"m{k}", **about) for k in range(count)]
for part in parts:
    part.instantiate()
    part.setupExperiment(startTime=0.0)
    part.enterInitializationMode()
    part.exitInitializationMode()
values = [part.getReal([*range(5, 10)]) for part in parts]
for part, given in zip(parts, [values[-1], *values]):
    part.setReal([*range(5)], given)
    part.doStep(0.0, h)
values = [part.getReal([*range(5, 10)]) for part in parts]
"""


def peer_figures(place: Path) -> dict[str, float | str]:
    """Return each ratio by name, or the reason for a missing one."""
    if compiler() is None:
        return dict.fromkeys(FIGURES, "no C compiler")
    return {
        "start_over_fmpy_simulate": start_over_fmpy_simulate(place),
        "check_over_import": check_over_import(place),
        **sweep_over_fmpy(place),
        "sweep_with_variables_over_fmpy_cpu": sweep_with_variables_over_fmpy(place),
        "many_over_fmpy": many_over_fmpy(place),
    }


def lags_fmu(place: Path, *options: str) -> Path:
    """Return the FMU of lags, built by the C compiler only, with further options of the compiler."""
    import fmpy

    path, library = place / "lags.fmu", place / "lags.so"
    flags = [*options, "-O2", "-shared", "-fPIC", "-o", str(library), str(Path(__file__).with_name("bench_fmu.c"))]
    subprocess.run([*(compiler() or ()), *flags], check=True, capture_output=True)
    numbers = [(f"u{k}", k, "input", ' start="0"') for k in range(5)]
    numbers += [(f"y{k}", 5 + k, "output", "") for k in range(5)]
    numbers += [("rate", 10, 'parameter" variability="fixed', ' start="1.1"')]
    variables = [
        f'<ScalarVariable name="{name}" valueReference="{vr}" causality="{causality}"><Real{start}/></ScalarVariable>'
        for name, vr, causality, start in numbers
    ]
    unknowns = "".join(f'<Unknown index="{k}" dependencies=""/>' for k in range(6, 11))
    description = (
        '<fmiModelDescription fmiVersion="2.0" modelName="lags" guid="lags">'
        '<CoSimulation modelIdentifier="lags" canHandleVariableCommunicationStepSize="true"/>'
        f"<ModelVariables>{''.join(variables)}</ModelVariables>"
        f"<ModelStructure><Outputs>{unknowns}</Outputs></ModelStructure></fmiModelDescription>"
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library, f"binaries/{fmpy.platform}/lags{fmpy.sharedLibraryExtension}")
    return path


def lags_scenario(place: Path, steps: int, h: float, names: Sequence[str] = "ab") -> Path:
    """Write a scenario of FMUs of lags, of which each gets the outputs of the one before; return its file."""
    if not (place / "lags.fmu").is_file():
        lags_fmu(place)
    parts = "".join(f"  {name}: {{fmu: lags.fmu}}\n" for name in names)
    pairs = zip(names, [*names[1:], names[0]], strict=True)
    links = [f"  - {{from: {a}.y{k}, to: {b}.u{k}}}\n" for a, b in pairs for k in range(5)]
    path = place / f"lags{steps}.yaml"
    path.write_text(
        f"name: lags\nduration: {steps * h}\nstep: {h}\nalgorithm: jacobi\ncomponents:\n{parts}"
        f"connections:\n{''.join(links)}"
    )
    return path


def cpu_seconds(command: Sequence[str], place: Path) -> float:
    """Return the processor time of a command with all its processes."""
    # As installed: with this variable set, each run would compile this package's modules, but no others.
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    before = os.times()
    subprocess.run([sys.executable, *command], check=True, capture_output=True, env=environment, cwd=place)
    after = os.times()
    return after.children_user + after.children_system - before.children_user - before.children_system


def start_over_fmpy_simulate(place: Path) -> float:
    """Compare a run of two coupled FMUs with report with `fmpy simulate` of one of them, which takes no more."""
    scenario = lags_scenario(place, STEPS, H)
    ours = ["-m", "cosim", "run", str(scenario), "--force", "--out", "start"]
    peer = ["-m", "fmpy", "simulate", "lags.fmu", "--stop-time", str(STEPS * H), "--output-interval", str(H)]
    peer += ["--output-file", "fmpy.csv"]
    return median_ratio(partial(cpu_seconds, ours, place), partial(cpu_seconds, peer, place))


def check_over_import(place: Path) -> float:
    """Compare the check of the same scenario with the import of FMPy and numpy."""
    ours = ["-m", "cosim", "check", str(lags_scenario(place, STEPS, H))]
    return median_ratio(partial(cpu_seconds, ours, place), lambda: cpu_seconds(["-c", "import fmpy, numpy"], place))


def sweep_over_fmpy(place: Path) -> dict[str, float]:
    """Compare a sweep on all cores with a parameter study in FMPy on one, by time and by processor time."""
    lags_scenario(place, SWEEP_STEPS, H)
    (place / "sweep.yaml").write_text(SWEEP.format(steps=SWEEP_STEPS, runs=RUNS))
    ours = ["-m", "cosim", "sweep", "sweep.yaml", "--force", "--out", "sweep", "--no-report"]
    peer = [str(Path(__file__).with_name("fmpy_sweep.py")), "lags.fmu", str(RUNS), str(SWEEP_STEPS), str(H)]
    pairs: list[tuple[float, float]] = []
    for _ in range(ROUNDS):
        times = []
        for command in (ours, peer):
            begin = time.perf_counter()
            used = cpu_seconds(command, place)
            times.append((time.perf_counter() - begin, used))
        pairs.append((times[0][0] / times[1][0], times[0][1] / times[1][1]))
    elapsed, used = map(median, zip(*pairs, strict=True))
    return {"sweep_over_fmpy": elapsed, "sweep_over_fmpy_cpu": used}


def sweep_with_variables_over_fmpy(place: Path) -> float:
    """Compare the processor time of the same sweep for a library with a global variable, which each run loads."""
    apart = place / "variables"
    apart.mkdir()
    lags_fmu(apart, "-DWITH_VARIABLE")
    return sweep_over_fmpy(apart)["sweep_over_fmpy_cpu"]


def many_over_fmpy(place: Path) -> float:
    """Compare the first step of a scenario of many FMUs with that of as many instances in FMPy."""
    scenario = lags_scenario(place, 1, H, [f"m{k}" for k in range(INSTANCES)])
    ours = ["-m", "cosim", "run", str(scenario), "--no-report", "--force", "--out", "many"]
    peer = ["-c", FMPY_MANY, "lags.fmu", str(INSTANCES), str(H)]
    return median_ratio(partial(cpu_seconds, ours, place), partial(cpu_seconds, peer, place), ROUNDS)
