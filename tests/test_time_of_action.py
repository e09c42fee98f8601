"""A value of a known signal acts from its time until the next; the outputs of a row belong to its inputs."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

import cosim
from tests.follow import FOLLOWS, WAYS, follow_fmu
from tests.instants import CONSTANT, instants_fmu

H, STEPS = 0.1, 20
TIME = np.arange(STEPS + 1) * H
JUMP = (TIME > 0.95).astype(float)  # u: 1 from 1 s on
KINDS = [f"{way}_{follows}" for way in WAYS for follows in FOLLOWS]
JUMP_CSV = "time,u\n0,0\n1,1\n2,1\n"


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of FMUs: co-simulation and model exchange; declared, measured and no feedthrough."""
    folder = tmp_path_factory.mktemp("follow")
    for way, follows in itertools.product(WAYS, FOLLOWS):
        follow_fmu(folder / f"{way}_{follows}.fmu", way, follows)
    follow_fmu(folder / "forgets.fmu", saves=False)
    follow_fmu(folder / "whole.fmu", whole=True)
    instants_fmu(folder / "clock.fmu", CONSTANT)
    (folder / "in.csv").write_text(JUMP_CSV)
    return folder


def scenario_of(fmus: Path, source: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return a scenario in which a source drives all kinds of FMUs."""
    kinds = more.pop("kinds", KINDS)
    components = {"r": source, **{kind: {"fmu": str(fmus / f"{kind}.fmu")} for kind in kinds}}
    return {
        "name": "follow",
        "duration": more.pop("duration", STEPS * H),
        "step": H,
        "components": components | more.pop("components", {}),
        "connections": [{"from": "r.u", "to": f"{kind}.u"} for kind in kinds] + more.pop("connections", []),
        **more,
    }


def source_of(fmus: Path, kind: str) -> dict[str, Any]:
    """Return a source of u: 1 from 1 s on."""
    if kind == "playback":
        return {"block": "playback", "file": str(fmus / "in.csv")}
    return {"block": "reference", "signals": {"u": {"changes": [{"at": 1, "to": 1}]}}}


def check_follows(run: Any, name: str, *, step: float = H) -> None:
    """Check x' = u + w with inputs that are held from row to row, and y = x + u + w in each row."""
    signals = {n: run[f"{name}.{n}"] for n in ("u", "w", "x", "y") if f"{name}.{n}" in run}
    driven = signals["u"] + signals["w"]
    np.testing.assert_allclose(np.diff(signals["x"]), step * driven[:-1], rtol=0, atol=1e-9)
    if "y" in signals:
        np.testing.assert_allclose(signals["y"], signals["x"] + driven, rtol=0, atol=1e-9)


def looped(fmus: Path) -> dict[str, Any]:
    """Return an algebraic loop whose members a source drives, too."""
    return {
        "components": {name: {"fmu": str(fmus / f"{kind}_declared.fmu")} for name, kind in (("a", "cs"), ("b", "me"))},
        "connections": [
            {"from": "r.u", "to": "a.w"},
            {"from": "r.u", "to": "b.w"},
            {"from": "a.y", "to": "b.u", "factor": 0.5},
            {"from": "b.y", "to": "a.u", "factor": -0.5},
        ],
    }


LOOPS: dict[str, tuple[str, Callable[[Path], dict[str, Any]]]] = {
    "compiled": ("C", lambda fmus: {"kinds": [kind for kind in KINDS if kind.startswith("cs")]}),
    "exchange": ("Python: me_", lambda fmus: {}),
    "python": (
        "Python: sensor",
        lambda fmus: {
            "components": {
                "sensor": {"block": "fix", "rate": 10, "signals": {"u": {}}},
                "fixed": {"fmu": str(fmus / "cs_declared.fmu")},
            },
            "connections": [{"from": "r.u", "to": "sensor.u"}, {"from": "sensor.u_meas", "to": "fixed.u"}],
        },
    ),
    "loop": ("Python: algebraic loops", lambda fmus: looped(fmus)),
    "controlled": ("Python: steps", lambda fmus: {"step": {"max": H, "min": 0.01, "tolerance": 1e-3}}),
    "halving": (
        "Python: steps",
        lambda fmus: {
            "step": {"max": H, "min": 0.01, "tolerance": 1e-3, "estimator": "halving"},
            "kinds": [kind for kind in KINDS if kind.startswith("cs")],
        },
    ),
    "courses": ("Python: inputs", lambda fmus: {"extrapolate": "linear", "interpolate": "linear"}),
    "events": (
        "Python: event mode",
        lambda fmus: {"components": {"clock": {"fmu": str(fmus / "clock.fmu")}}},
    ),
}


@pytest.mark.parametrize("algorithm", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("kind", ["playback", "reference"])
@pytest.mark.parametrize("loop", LOOPS)
def test_a_source_acts_from_its_time(fmus: Path, loop: str, kind: str, algorithm: str) -> None:
    if (loop, algorithm) == ("loop", "jacobi"):
        pytest.skip("Jacobi leaves a loop open")
    begins, more = LOOPS[loop]
    scenario = scenario_of(fmus, source_of(fmus, kind), algorithm=algorithm, **more(fmus))
    run = cosim.run(scenario, in_process=True)
    assert run.manifest["loop"].startswith(begins)
    for name in [column.removesuffix(".x") for column in run.names if column.endswith(".x") and "clock" not in column]:
        check_follows(run, name)
        if name not in ("a", "b"):
            np.testing.assert_array_equal(run[f"{name}.u"], JUMP)
            assert run[f"{name}.x"][-1] == pytest.approx(1.0, abs=1e-9)
    if loop == "loop":  # y_a = x_a + u + u_a and u_a = −y_b/2, of the same time
        np.testing.assert_allclose(run["a.u"], -0.5 * run["b.y"], rtol=0, atol=1e-9)
        np.testing.assert_allclose(run["b.u"], 0.5 * run["a.y"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("algorithm", ["gauss-seidel", "jacobi"])
def test_noise_and_faults_of_a_connection_act_at_their_row(fmus: Path, algorithm: str) -> None:
    scenario = scenario_of(fmus, source_of(fmus, "reference"), algorithm=algorithm, seed=3)
    for connection in scenario["connections"]:
        connection["noise"] = {"variance": 0.01}
    faults = [{"on": "cs_declared.u", "kind": "bias", "value": 2.0, "from": 0.5, "to": 1.5}]
    faults += [{"on": "me_declared.u", "kind": "delay", "delay": 0.3}]
    run = cosim.run({**scenario, "faults": faults}, in_process=True)
    for kind in KINDS:
        check_follows(run, kind)
    biased = run["cs_declared.u"] - JUMP
    assert np.abs(biased[5:16] - 2.0).max() < 0.6 > np.abs(np.delete(biased, slice(5, 16))).max()
    assert np.abs(run["me_declared.u"][:13]).max() < 0.6 < run["me_declared.u"][13:].min()


@pytest.mark.parametrize("checkpoint", [True, False])
@pytest.mark.parametrize("fmu", ["cs_declared", "forgets", "me_declared"])
def test_a_run_goes_on_with_the_values_of_its_row(fmus: Path, tmp_path: Path, fmu: str, checkpoint: bool) -> None:
    """Restored from a checkpoint, or by a replay of the recorded inputs, in C or in Python."""
    content = scenario_of(fmus, source_of(fmus, "reference"), kinds=[fmu, "cs_measured"])
    content["events"] = [{"at": 0.5, "set": {f"{fmu}.w": 3}}]
    content["components"]["r"]["signals"]["u"]["changes"] += [{"at": 1.5, "to": 0, "rate": 4}]
    content |= {"checkpoint": "1 h"} if checkpoint else {}
    scenario = tmp_path / "follow.yaml"
    scenario.write_text(yaml.safe_dump(content))
    whole = cosim.run(scenario, tmp_path / "whole", report=False)
    cosim.run(scenario, tmp_path / "part", {"duration": 1.2}, report=False)
    run = cosim.run(tmp_path / "part", until=STEPS * H, report=False)
    for name in whole.names:  # A solver's longest step depends on the end of the run.
        np.testing.assert_allclose(run[name], whole[name], rtol=0, atol=1e-13 if fmu.startswith("me") else 0)
    check_follows(whole, fmu)


@pytest.mark.parametrize("kind", KINDS)
def test_a_replay_reads_outputs_for_the_command_of_their_row(fmus: Path, tmp_path: Path, kind: str) -> None:
    x = np.concatenate([[0.0], np.cumsum(H * JUMP[:-1])])
    outputs = {"x": x} if kind.endswith("none") else {"x": x, "y": x + JUMP}
    rows = np.column_stack([TIME, JUMP, 0.0 * TIME, *outputs.values()])
    header = ",".join(["time", "u", "w", *outputs])
    np.savetxt(tmp_path / "log.csv", rows, "%.15g", ",", header=header, comments="")
    replayed = cosim.replay(tmp_path / "log.csv", fmu=fmus / f"{kind}.fmu", in_process=True)
    for name, values in outputs.items():
        np.testing.assert_allclose(replayed[f"plant.{name}"], values, rtol=0, atol=1e-9)


# -- between the rows of an input -----------------------------------------------------------------


def test_integers_are_held_where_reals_are_interpolated(fmus: Path, tmp_path: Path) -> None:
    (tmp_path / "in.csv").write_text("time,u,n\n0,0,0\n1,1,4\n2,1,5\n")
    run = cosim.simulate(fmus / "whole.fmu", input=tmp_path / "in.csv", interpolation="linear", in_process=True)
    np.testing.assert_array_equal(run["whole.m"], np.select([TIME > 1.95, TIME > 0.95], [5, 4], 0))
    np.testing.assert_allclose(run["whole.u"], np.minimum(TIME, 1.0), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("interpolation", "before"), [("held", 0.0), ("linear", 0.9)])
def test_equal_times_are_a_jump(fmus: Path, tmp_path: Path, interpolation: str, before: float) -> None:
    """The last of equal rows acts from their time on; a line before them ends at the first."""
    (tmp_path / "in.csv").write_text("time,u\n0,0\n1,1\n1,7\n1,5\n2,5\n")
    run = cosim.simulate(
        fmus / "cs_declared.fmu", input=tmp_path / "in.csv", interpolation=interpolation, in_process=True
    )
    assert run["cs_declared.u"][9] == pytest.approx(before)
    np.testing.assert_array_equal(run["cs_declared.u"][10:], 5.0)
    check_follows(run, "cs_declared")


# -- times as large as those since 1970 -------------------------------------------------------------

EPOCH = 1_700_000_000


@pytest.mark.parametrize("h", [0.1, 0.01])
def test_rows_of_large_times_are_those_of_their_points(fmus: Path, tmp_path: Path, h: float) -> None:
    """Playback, an input file, a reference, an event and a fault act at their points; a replay agrees."""
    count = 200
    times = [f"{EPOCH + round(k * h * 100) // 100}.{round(k * h * 100) % 100:02d}" for k in range(count + 1)]
    (tmp_path / "in.csv").write_text("time,u\n" + "".join(f"{t},{k}\n" for k, t in enumerate(times)))
    (tmp_path / "steps.csv").write_text("time,u\n" + "".join(f"{t},1\n" for t in times))
    scenario = scenario_of(
        fmus,
        {"block": "playback", "file": str(tmp_path / "in.csv")},
        kinds=["cs_declared", "cs_none", "me_declared"],
        duration=count * h,
        components={"ref": {"block": "reference", "signals": {"w": {"changes": [{"at": float(times[57]), "to": 1}]}}}},
        connections=[{"from": "ref.w", "to": "cs_declared.w"}],
        events=[{"at": float(times[k]), "set": {"cs_none.w": k}} for k in (33, 74)],
        faults=[
            {"on": "me_declared.u", "kind": "bias", "value": 1000, "from": float(times[49]), "to": float(times[99])}
        ],
    )
    run = cosim.run({**scenario, "start_time": EPOCH, "step": h}, in_process=True)
    k = np.arange(count + 1)
    np.testing.assert_array_equal(run["r.u"], k)
    np.testing.assert_array_equal(run["cs_declared.w"], (k >= 57).astype(float))
    np.testing.assert_array_equal(run["cs_none.w"], np.select([k >= 74, k >= 33], [74, 33], 0))
    np.testing.assert_array_equal(run["me_declared.u"] - k, np.where((k >= 49) & (k <= 99), 1000, 0))
    alone = cosim.simulate(
        fmus / "cs_declared.fmu", tmp_path / "alone", input=tmp_path / "in.csv", step=h, in_process=True
    )
    np.testing.assert_array_equal(alone["cs_declared.u"], k)
    rows = np.column_stack([alone["cs_declared.u"], alone["cs_declared.x"]])
    lines = (f"{t},{u!r},0,{x!r}\n" for t, (u, x) in zip(times, rows.tolist(), strict=True))
    (tmp_path / "log.csv").write_text("time,u,w,x\n" + "".join(lines))
    replayed = cosim.replay(tmp_path / "log.csv", fmu=fmus / "cs_declared.fmu", in_process=True)
    np.testing.assert_allclose(replayed["plant.x"], rows[:, 1], rtol=0, atol=1e-3 * h * count)
