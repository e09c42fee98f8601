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
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from cosim.fmi.native.compiler import compiler, load_library
from cosim.loading.build_native import build_native
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
READ = {"plant": 15, "controller": 5}  # number of first outputs read: the controller's commands and x_hat
PSI, PSI_DOT, AX = 4, 8, 10  # indices among the plant's outputs
SCENARIO = """name: native
duration: {duration}
step: 0.02
algorithm: jacobi
design: {{estimator: appendix_f}}
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
    build_native(place)
    links = "".join(f"  - {{from: {a}.{name}, to: {b}.{name}}}\n" for a, name, b in LINKS)
    scenario = place / "native.yaml"
    scenario.write_text(SCENARIO.format(duration=STEPS * H, links=links))
    system = build_system(ScenarioFile(scenario))
    with two(place) as craft:

        def ours() -> float:
            return loop_seconds(system, in_c=True)

        figures: dict[str, float | str] = {
            "native_fmpy_over_ours": of_pairs(lambda: fmpy_seconds(craft), ours),
            "native_fmpy_over_ours_without_compiler": of_pairs(
                lambda: fmpy_seconds(craft), lambda: loop_seconds(system, in_c=False)
            ),
            "native_over_c": of_pairs(ours, lambda: c_seconds(craft)),
            "python_over_native_plant": python_over_native_plant(place, craft["plant"]),
        }
    figures["ecos_over_ours"] = ecos_over_ours(place, ours)
    return {name: figures[name] for name in FIGURES}


def of_pairs(one: Seconds, other: Seconds) -> float:
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


class Unpacked:
    """An FMU unpacked by FMPy, for several instances."""

    def __init__(self, path: Path, name: str) -> None:
        import fmpy

        self.name, self.description = name, fmpy.read_model_description(str(path))
        self.folder = fmpy.extract(str(path), tempfile.mkdtemp(dir=path.parent))
        self.place = {v.name: v.valueReference for v in self.description.modelVariables}
        outputs = [v.valueReference for v in self.description.modelVariables if v.causality == "output"]
        self.inputs, self.outputs = [self.place[n] for n in INPUTS[name]], outputs[: READ[name]]

    @contextmanager
    def started(self) -> Iterator[Any]:
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


@contextmanager
def two(place: Path) -> Iterator[Mapping[str, Unpacked]]:
    """Yield both FMUs."""
    yield {name: Unpacked(place / f"{name}-native.fmu", name) for name in INPUTS}


def fmpy_seconds(craft: Mapping[str, Unpacked]) -> float:
    """Return the seconds of setReal, doStep, getReal in FMPy."""
    plant, controller = craft["plant"], craft["controller"]
    table = np.zeros((STEPS + 1, 20))
    with plant.started() as a, controller.started() as b:
        y, u = a.getReal(plant.outputs), b.getReal(controller.outputs)
        began = time.thread_time()
        for k in range(STEPS):
            t = k * H
            a.setReal(plant.inputs, u[:4])
            b.setReal(controller.inputs, [y[PSI], y[PSI_DOT], y[AX]])
            a.doStep(t, H)
            b.doStep(t, H)
            y, u = a.getReal(plant.outputs), b.getReal(controller.outputs)
            table[k + 1] = (*y, *u)
        return time.thread_time() - began


# -- C by hand --------------------------------------------------------------------------------------


class _Part(ctypes.Structure):
    _fields_ = tuple((name, ctypes.c_void_p) for name in ("instance", "set", "get", "step", "inputs", "outputs"))


def c_seconds(craft: Mapping[str, Unpacked]) -> float:
    """Return the seconds of an independent C loop."""
    drive = load_library(DRIVER.read_text(encoding="utf-8")).drive
    drive.argtypes = [*[ctypes.POINTER(_Part)] * 2, ctypes.c_long, ctypes.c_double, ctypes.c_void_p]
    table = np.zeros((STEPS + 1, 20))
    with craft["plant"].started() as plant, craft["controller"].started() as controller:
        parts, kept = [], []
        for unpacked, fmu in ((craft["plant"], plant), (craft["controller"], controller)):
            references = [(ctypes.c_uint * len(r))(*r) for r in (unpacked.inputs, unpacked.outputs)]
            functions = [_address(fmu, name) for name in ("fmi2SetReal", "fmi2GetReal", "fmi2DoStep")]
            parts.append(_Part(fmu.component, *functions, *map(ctypes.addressof, references)))
            kept.append(references)
        began = time.thread_time()
        drive(*map(ctypes.byref, parts), STEPS, H, table.ctypes.data)
        return time.thread_time() - began


def _address(fmu: Any, name: str) -> int | None:
    return ctypes.cast(getattr(fmu.dll, name), ctypes.c_void_p).value


# -- ecos -------------------------------------------------------------------------------------------


def ecos_over_ours(place: Path, ours: Seconds) -> float | str:
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
        for name in INPUTS:
            structure.add_model(name, str(place / f"{name}-native.fmu"))
        for a, name, b in LINKS:
            structure.make_real_connection(f"{a}::{name}", f"{b}::{name}")
        starts = {f"{name}::{key}": value for name, values in START.items() for key, value in values.items()}
        structure.add_parameter_set("start", starts)
        with EcosSimulation(structure=structure, step_size=H) as simulation:
            simulation.init(parameter_set="start")
            unpacked = {name: Unpacked(place / f"{name}-native.fmu", name) for name in INPUTS}
            read = [
                f"{name}::{v.name}"
                for name, part in unpacked.items()
                for v in part.description.modelVariables
                if v.causality == "output" and v.valueReference in part.outputs
            ]

            def ecos() -> float:
                began = time.process_time()  # ecos uses its own threads
                for _ in range(STEPS):
                    simulation.step(1)
                    for name in read:
                        simulation.get_real(name)
                return time.process_time() - began

            return of_pairs(ecos, ours)


# -- the plant in Python ----------------------------------------------------------------------------


def python_over_native_plant(place: Path, native: Unpacked) -> float:
    """Compare fmi2DoStep of the Python and the native plant."""
    in_python = Unpacked(place / "plant.fmu", "plant")

    def seconds(plant: Unpacked, steps: int) -> float:
        with plant.started() as fmu:
            began = time.thread_time()
            for k in range(steps):
                fmu.fmi2DoStep(fmu.component, k * H, H, 1)
            return (time.thread_time() - began) / steps

    return of_pairs(lambda: seconds(in_python, STEPS // 5), lambda: seconds(native, STEPS))
