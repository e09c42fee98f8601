"""Benchmarks of the native craft loop against FMPy, manual C and ecos, as ratios of CPU time.

All are Jacobi without noise and record the same 20 variables; `cosim run` also records inputs and performs its checks.
CPU time of the thread is used, because these loops never wait, and other work on the machine must not count.
"""

from __future__ import annotations

import ctypes
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from cosim.fmi.building.build import build_native
from cosim.fmi.native.compiler import compiler, load_library
from cosim.master.master import PROGRESS_EVERY, simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import System, build_system

H, STEPS, ROUNDS = 0.02, 5000, 9
DRIVER = Path(__file__).with_name("bench_native.c")
START = {"plant": {"x_start": 1.0, "psi_start": 1.0}, "controller": {"x_hat_start": 1.0, "psi_hat_start": 1.0}}
INPUTS = {
    "plant": ("duty_right", "duty_left", "tilt_right", "tilt_left"),
    "controller": ("psi", "psi_dot", "ax"),
}
OUTPUT_COUNT = {"plant": 15, "controller": 5}  # number of first outputs read: the controller's commands and x_hat
PSI, PSI_DOT, AX = 4, 8, 10  # indices among the plant's outputs
SCENARIO = """name: native
duration: {duration}
step: 0.02
algorithm: jacobi
components:
  plant: {{fmu: plant-native.fmu, start: {{x_start: 1, psi_start: 1}}}}
  controller: {{fmu: controller-native.fmu, start: {{x_hat_start: 1, psi_hat_start: 1}}}}
connections:
{links}"""
LINKS = [("plant", name, "controller") for name in INPUTS["controller"]]
LINKS += [("controller", name, "plant") for name in INPUTS["plant"]]
FIGURES = (
    "native_fmpy_over_ours",
    "native_fmpy_over_ours_without_compiler",
    "native_over_c",
    "ecos_over_ours",
    "python_over_native_plant",
)
Seconds = Callable[[], float]


def native_figures(place: Path) -> dict[str, float | str]:
    """Return each ratio by name, or the reason for a missing one."""
    if compiler() is None:
        return dict.fromkeys(FIGURES, "no C compiler")
    scenario = native_scenario(place, STEPS * H)
    system = build_system(ScenarioFile(scenario))
    craft = {name: UnpackedFmu(place / f"{name}-native.fmu", name) for name in INPUTS}
    ours, python_loop = (partial(loop_seconds, system, in_c=in_c) for in_c in (True, False))
    fmpy_loop = partial(fmpy_seconds, craft)
    figures: dict[str, float | str] = {
        "native_fmpy_over_ours": median_ratio(fmpy_loop, ours),
        "native_fmpy_over_ours_without_compiler": median_ratio(fmpy_loop, python_loop),
        "native_over_c": median_ratio(ours, partial(c_seconds, craft)),
        "python_over_native_plant": python_over_native_plant(place, craft["plant"]),
        "ecos_over_ours": ecos_over_ours(craft, ours),
    }
    return {name: figures[name] for name in FIGURES}


def native_scenario(place: Path, duration: float) -> Path:
    """Build the native craft and write the scenario of its loop; return its file."""
    build_native(place, "hovercraft")
    links = "".join(f"  - {{from: {a}.{name}, to: {b}.{name}}}\n" for a, name, b in LINKS)
    scenario = place / "native.yaml"
    scenario.write_text(SCENARIO.format(duration=duration, links=links))
    return scenario


def median_ratio(one: Seconds, other: Seconds) -> float:
    """Return the median ratio of two times.

    Each function returns its own seconds.
    """
    one(), other()
    return median(one() / other() for _ in range(ROUNDS))


def loop_seconds(system: System, *, in_c: bool) -> float:
    """Return the seconds of the master's steps."""
    marks: list[float] = []
    results = simulate(system, STEPS, H, lambda k: marks.append(time.thread_time()), in_c=in_c)
    assert results.loop.startswith("C" if in_c else "Python"), results.loop
    return (marks[-1] - marks[0]) * STEPS / (STEPS - PROGRESS_EVERY)


# -- FMPy -------------------------------------------------------------------------------------------


class UnpackedFmu:
    """An FMU unpacked by FMPy, for several instances."""

    def __init__(self, path: Path, name: str) -> None:
        import fmpy

        self.path, self.name, self.description = path, name, fmpy.read_model_description(str(path))
        self.folder = fmpy.extract(str(path), tempfile.mkdtemp(dir=path.parent))
        self.place = {v.name: v.valueReference for v in self.description.modelVariables}
        outputs = [v for v in self.description.modelVariables if v.causality == "output"]
        self.output_variables = outputs[: OUTPUT_COUNT[name]]
        self.inputs = [self.place[n] for n in INPUTS[name]]
        self.outputs = [v.valueReference for v in self.output_variables]

    @contextmanager
    def run(self) -> Iterator[Any]:
        """Yield an instance after initialization."""
        import fmpy

        fmu = fmpy.instantiate_fmu(self.folder, self.description, "CoSimulation")
        fmu.setupExperiment(startTime=0.0)
        fmu.enterInitializationMode()
        for name, value in START[self.name].items():
            fmu.setReal([self.place[name]], [value])
        fmu.exitInitializationMode()
        yield fmu
        fmu.terminate()
        fmu.freeInstance()


def fmpy_seconds(craft: Mapping[str, UnpackedFmu]) -> float:
    """Return the seconds of setReal, doStep, getReal in FMPy."""
    plant, controller = craft["plant"], craft["controller"]
    table = np.zeros((STEPS + 1, 20))
    with plant.run() as a, controller.run() as b:
        y, u = a.getReal(plant.outputs), b.getReal(controller.outputs)
        begin = time.thread_time()
        for k in range(STEPS):
            t = k * H
            a.setReal(plant.inputs, u[:4])
            b.setReal(controller.inputs, [y[PSI], y[PSI_DOT], y[AX]])
            a.doStep(t, H)
            b.doStep(t, H)
            y, u = a.getReal(plant.outputs), b.getReal(controller.outputs)
            table[k + 1] = (*y, *u)
        return time.thread_time() - begin


# -- C by hand --------------------------------------------------------------------------------------


class _Part(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in ("instance", "set", "get", "step", "inputs", "outputs"))


def c_seconds(craft: Mapping[str, UnpackedFmu]) -> float:
    """Return the seconds of an independent C loop."""
    drive = load_library(DRIVER.read_text(encoding="utf-8")).drive
    drive.argtypes = [*[ctypes.POINTER(_Part)] * 2, ctypes.c_long, ctypes.c_double, ctypes.c_void_p]
    table = np.zeros((STEPS + 1, 20))
    with craft["plant"].run() as plant, craft["controller"].run() as controller:
        parts, arrays = [], []
        for unpacked, fmu in ((craft["plant"], plant), (craft["controller"], controller)):
            references = [(ctypes.c_uint * len(r))(*r) for r in (unpacked.inputs, unpacked.outputs)]
            names = ("fmi2SetReal", "fmi2GetReal", "fmi2DoStep")
            functions = [ctypes.cast(getattr(fmu.dll, name), ctypes.c_void_p).value for name in names]
            parts.append(_Part(fmu.component, *functions, *map(ctypes.addressof, references)))
            arrays.append(references)  # must outlive the loop
        begin = time.thread_time()
        drive(*map(ctypes.byref, parts), STEPS, H, table.ctypes.data)
        return time.thread_time() - begin


# -- ecos -------------------------------------------------------------------------------------------


def ecos_over_ours(craft: Mapping[str, UnpackedFmu], ours: Seconds) -> float | str:
    """Compare ecos with the master.

    The loop calls `step(1)`, then `get_real` of the 20 variables.
    """
    for library in sorted((Path(sys.prefix) / "lib").glob("libtbb.so*")):
        with suppress(OSError):
            ctypes.CDLL(str(library), ctypes.RTLD_GLOBAL)  # required by ecos, outside the search path
    try:
        from ecospy import EcosSimulation, EcosSimulationStructure
        from ecospy.lib import EcosLib
    except (ImportError, OSError) as error:
        return f"no ecos: {error}"
    EcosLib.set_log_level("err")
    with EcosSimulationStructure() as structure:
        for name, fmu in craft.items():
            structure.add_model(name, str(fmu.path))
        for a, name, b in LINKS:
            structure.make_real_connection(f"{a}::{name}", f"{b}::{name}")
        starts = {f"{name}::{key}": value for name, values in START.items() for key, value in values.items()}
        structure.add_parameter_set("start", starts)
        with EcosSimulation(structure=structure, step_size=H) as simulation:
            simulation.init(parameter_set="start")
            outputs = [f"{name}::{v.name}" for name, fmu in craft.items() for v in fmu.output_variables]

            def ecos() -> float:
                begin = time.process_time()  # ecos uses its own threads
                for _ in range(STEPS):
                    simulation.step(1)
                    for name in outputs:
                        simulation.get_real(name)
                return time.process_time() - begin

            return median_ratio(ecos, ours)


# -- the plant in Python ----------------------------------------------------------------------------


def python_over_native_plant(place: Path, native: UnpackedFmu) -> float:
    """Compare fmi2DoStep of the Python and the native plant."""
    in_python = UnpackedFmu(place / "plant.fmu", "plant")

    def seconds(plant: UnpackedFmu, steps: int) -> float:
        with plant.run() as fmu:
            begin = time.thread_time()
            for k in range(steps):
                fmu.fmi2DoStep(fmu.component, k * H, H, 1)
            return (time.thread_time() - begin) / steps

    return median_ratio(lambda: seconds(in_python, STEPS // 5), lambda: seconds(native, STEPS))
