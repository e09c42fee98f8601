"""Slow FMUs that need no output of each other step at the same time: which ones, and with which numbers."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest

from cosim import run
from cosim.isolation.limits import Limits
from cosim.master import c_loop, master, policies
from cosim.master.own_process import in_own_processes
from cosim.scenario.scenario_file import ScenarioFile
from cosim.system.system import build_system
from tests.compiled import rewritten
from tests.known.kit import Model
from tests.native import NEEDS_COMPILER
from tests.test_event_mode import scenario

pytestmark = NEEDS_COMPILER
# From its sixth step on an FMU waits in each step, once for up to 0.4 s, until the other one is in its step of that
# time, too. Output `met` counts the steps in which it was.
FUNCTIONS = """
#include <stdio.h>
#include <unistd.h>
static int meets(const char *own, const char *other, int step, int patience) {
    char name[4096];
    snprintf(name, sizeof name, "%s%d", own, step);
    fclose(fopen(name, "w"));
    snprintf(name, sizeof name, "%s%d", other, step);
    for (int k = 0; access(name, F_OK) && k < patience; k++) usleep(1000);
    return !access(name, F_OK);
}
"""
ROWS = 12


def meeting(own: str, other: str, folder: Path, **more: Any) -> Path:
    """Return an FMU that counts the steps in which it has met the other one."""
    names = ", ".join(f'"{folder / name}."' for name in (own, other))
    step = (
        "usleep(200); memory[0] += 1; y = 0.5 * u + h; "
        f"if (memory[0] > 5) {{ int found = meets({names}, (int)memory[0], memory[1] > 0 ? 0 : 400); "
        "met += found; memory[1] += !found; }"
    )
    return Model("input u = 0, y = 1, met = 0", step=step, functions=FUNCTIONS, name=own, **more).fmu()


def simulated(
    folder: Path,
    file: ScenarioFile,
    cores: int,
    patch: pytest.MonkeyPatch,
    *,
    apart: bool = False,
    in_c: bool = True,
) -> Any:
    for module in (c_loop, master, policies):
        patch.setattr(module, "cores", lambda: cores)
    system = build_system(file)
    system = in_own_processes(system, Limits()) if apart else system
    for mark in folder.glob("?.*[0-9]"):
        mark.unlink()
    return master.simulate(system, file.scenario.steps, file.scenario.step, in_c=in_c)


@pytest.mark.parametrize(("algorithm", "apart"), [("jacobi", False), ("gauss-seidel", False), ("jacobi", True)])
def test_slow_fmus_step_at_the_same_time_with_the_same_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, algorithm: str, apart: bool
) -> None:
    """Under Gauss-Seidel without feedthrough, too: no output of the same step is needed."""
    process = {"process": "own"} if apart else {}
    components = {
        "a": {"fmu": str(meeting("a", "b", tmp_path))} | process,
        "b": {"fmu": str(meeting("b", "a", tmp_path))} | process,
    }
    file = scenario(tmp_path, components, ["a.y → b.u", "b.y → a.u"], duration=ROWS, step=1, algorithm=algorithm)
    together = simulated(tmp_path, file, 2, monkeypatch, apart=apart)
    one_by_one = simulated(tmp_path, file, 1, monkeypatch, apart=apart)
    assert together.loop == ("Python: a has a process of its own" if apart else "C")
    for name in ("a", "b"):
        assert together[f"{name}.y"].tobytes() == one_by_one[f"{name}.y"].tobytes()
        assert together[f"{name}.met"][-1] == ROWS - 5
    assert one_by_one["a.met"][-1] == 0


@pytest.mark.parametrize("flag", ["canBeInstantiatedOnlyOncePerProcess", "needsExecutionTool"])
def test_fmus_with_common_data_step_one_after_the_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, flag: str
) -> None:
    first, second = meeting("a", "b", tmp_path), meeting("b", "a", tmp_path)
    single = rewritten(
        first,
        tmp_path / "single.fmu",
        lambda name, data: re.sub(rb"<CoSimulation ", rf'\g<0>{flag}="true" '.encode(), data),
    )
    file = scenario(
        tmp_path, {"a": {"fmu": str(single)}, "b": {"fmu": str(second)}}, [], duration=ROWS, step=1, algorithm="jacobi"
    )
    assert simulated(tmp_path, file, 2, monkeypatch)["a.met"][-1] == 0


def test_an_fmu_that_needs_an_output_of_the_same_step_waits_for_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    second = meeting("b", "a", tmp_path, depends={"y": ("u",)})
    components = {"a": {"fmu": str(meeting("a", "b", tmp_path))}, "b": {"fmu": str(second)}}
    file = scenario(tmp_path, components, ["a.y → b.u"], duration=ROWS, step=1)
    assert simulated(tmp_path, file, 2, monkeypatch)["a.met"][-1] == 0


@pytest.mark.parametrize("in_c", [True, False])
def test_the_first_error_in_stepping_order_is_raised(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, in_c: bool
) -> None:
    """The last one steps in the thread of the loop, because it is fast."""
    failing = [
        Model("input u = 0, y = 0", step=f"{wait} y = t > 7 ? NAN : t;", functions=FUNCTIONS, name=f"m{k}")
        for k, wait in enumerate(("usleep(200);", "usleep(200);", ""))
    ]
    good = Model("input u = 0, y = 0", step="usleep(200); y = t;", functions=FUNCTIONS, name="good")
    components = {name: {"fmu": str(m.fmu())} for name, m in zip("abcd", (good, *failing), strict=True)}
    file = scenario(tmp_path, components, [], duration=ROWS, step=1, algorithm="jacobi")
    with pytest.raises(master.StoppedRun) as end:
        simulated(tmp_path, file, 2, monkeypatch, in_c=in_c)
    assert end.value.error.component == "b.y"
    assert len(end.value.results.time) == 9


def test_an_fmu_that_handles_its_own_faults_does_so_beside_another(tmp_path: Path) -> None:
    handles = """
#define _GNU_SOURCE
#include <setjmp.h>
#include <signal.h>
#include <unistd.h>
static __thread sigjmp_buf back;
static void caught(int number) { siglongjmp(back, 1); }
static void guarded(void) {
    struct sigaction action = {0};
    action.sa_handler = caught;
    sigaction(SIGSEGV, &action, 0);
    if (!sigsetjmp(back, 1)) *(volatile int *)0 = 1;
}
"""
    plain = Model("input u = 0, y = 1", step="usleep(1000); y = t;", functions="#include <unistd.h>\n", name="plain")
    guards = Model("input u = 0, y = 1", step="usleep(500); guarded(); y = t;", functions=handles, name="guards")
    components = {"a": {"fmu": str(plain.fmu())}, "b": {"fmu": str(guards.fmu())}}
    file = scenario(tmp_path, components, [], duration=ROWS, step=1, algorithm="jacobi")
    assert run(file.path, tmp_path / "out", report=False).results["b.y"][-1] == ROWS - 1


def test_steps_that_end_at_the_same_instant_go_on(tmp_path: Path) -> None:
    """Each step lasts until the next but one multiple of 0.1 ms of the clock."""
    until = """
#include <math.h>
#include <time.h>
static double now(void) { struct timespec t; clock_gettime(CLOCK_MONOTONIC, &t); return t.tv_sec + 1e-9 * t.tv_nsec; }
static void spin(void) { double end = (floor(now() / 1e-4) + 2) * 1e-4; while (now() < end); }
"""
    steps = 5000
    models = [Model("input u = 0, y = 1", step="spin(); y = 0.5 * u + h;", functions=until, name=name) for name in "ab"]
    components = {m.name: {"fmu": str(m.fmu())} for m in models}
    file = scenario(tmp_path, components, ["a.y → b.u", "b.y → a.u"], duration=steps, step=1, algorithm="jacobi")
    assert run(file.path, tmp_path / "out", report=False).time[-1] == steps
