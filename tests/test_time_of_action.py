"""A value of a known signal acts from its time until the next; the outputs of a row belong to its inputs."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from tests.follow import FOLLOWS, WAYS, follow_fmu
from tests.instants import CONSTANT, instants_fmu
from tests.logs import write_log
from tests.test_event_mode import scenario

H, STEPS = 0.1, 20
TIME = np.arange(STEPS + 1) * H
JUMP = (TIME > 0.95).astype(float)  # u: 1 from 1 s on
STEP = {"block": "reference", "signals": {"u": {"changes": [{"at": 1, "to": 1}]}}}
KINDS = [f"{way}_{follows}" for way in WAYS for follows in FOLLOWS]


@pytest.fixture(scope="module")
def fmus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of FMUs: co-simulation and model exchange; declared, measured and no feedthrough."""
    folder = tmp_path_factory.mktemp("follow")
    for way, follows in itertools.product(WAYS, FOLLOWS):
        follow_fmu(folder / f"{way}_{follows}.fmu", way, follows)
    follow_fmu(folder / "forgets.fmu", saves=False)
    follow_fmu(folder / "whole.fmu", whole=True)
    instants_fmu(folder / "clock.fmu", CONSTANT)
    (folder / "in.csv").write_text("time,u\n0,0\n1,1\n2,1\n")
    return folder


def followed(fmus: Path, source: Any = STEP, kinds: Sequence[str] = KINDS, wires: Any = (), **more: Any) -> Path:
    """Return a scenario in which a source of u drives these FMUs."""
    components = {"r": source, **{kind: {"fmu": f"{kind}.fmu"} for kind in kinds}, **more.pop("components", {})}
    ends = [f"r.u → {kind}.u" for kind in kinds]
    return scenario(fmus, components, [*ends, *wires], **{"duration": STEPS * H, **more}).path


def check_follows(run: Any, name: str, *, step: float = H) -> None:
    """Check x' = u + w with inputs that are held from row to row, and y = x + u + w in each row."""
    x, driven = run[f"{name}.x"], run[f"{name}.u"] + run[f"{name}.w"]
    np.testing.assert_allclose(np.diff(x), step * driven[:-1], rtol=0, atol=1e-9)
    if f"{name}.y" in run:
        np.testing.assert_allclose(run[f"{name}.y"], x + driven, rtol=0, atol=1e-9)


CONTROLLED = {"max": H, "min": 0.01, "tolerance": 1e-3}
COMPILED = [kind for kind in KINDS if kind.startswith("cs")]
SENSOR = {"sensor": {"block": "fix", "rate": 10, "signals": {"u": {}}}, "fixed": {"fmu": "cs_declared.fmu"}}


@pytest.mark.parametrize("algorithm", ["gauss-seidel", "jacobi"])
@pytest.mark.parametrize("source", [STEP, {"block": "playback", "file": "in.csv"}], ids=["reference", "playback"])
@pytest.mark.parametrize(
    ("begins", "more"),
    [
        ("C", {"kinds": COMPILED}),
        ("Python: me_", {}),
        ("Python: sensor", {"components": SENSOR, "wires": ["r.u → sensor.u", "sensor.u_meas → fixed.u"]}),
        ("Python: steps", {"step": CONTROLLED}),
        ("Python: steps", {"step": CONTROLLED | {"estimator": "halving"}, "kinds": COMPILED}),
        ("Python: inputs", {"extrapolate": "linear", "interpolate": "linear"}),
        ("Python: event mode", {"components": {"clock": {"fmu": "clock.fmu"}}}),
    ],
)
def test_a_source_acts_from_its_time(fmus: Path, begins: str, more: Any, source: Any, algorithm: str) -> None:
    run = cosim.run(followed(fmus, source, algorithm=algorithm, **more), in_process=True)
    assert run.manifest["loop"].startswith(begins)
    for name in [*more.get("kinds", KINDS), *(["fixed"] if "fixed.u" in run else [])]:
        check_follows(run, name)
        np.testing.assert_array_equal(run[f"{name}.u"], JUMP)
        assert run[f"{name}.x"][-1] == pytest.approx(1.0, abs=1e-9)


def test_a_source_acts_from_its_time_on_the_members_of_a_loop(fmus: Path) -> None:
    components = {"a": {"fmu": "cs_declared.fmu"}, "b": {"fmu": "me_declared.fmu"}}
    wires = ["r.u → a.w", "r.u → b.w", "a.y → b.u", "b.y → a.u"]
    factors = ["connections.2.factor=0.5", "connections.3.factor=-0.5"]
    run = cosim.run(followed(fmus, STEP, (), wires, components=components), set=factors, in_process=True)
    for name in "ab":
        check_follows(run, name)
    # y_a = x_a + u + u_a and u_a = −y_b/2, of the same time
    np.testing.assert_allclose(run["a.u"], -0.5 * run["b.y"], rtol=0, atol=1e-9)
    np.testing.assert_allclose(run["b.u"], 0.5 * run["a.y"], rtol=0, atol=1e-9)


@pytest.mark.parametrize("algorithm", ["gauss-seidel", "jacobi"])
def test_noise_and_faults_of_a_connection_act_at_their_row(fmus: Path, algorithm: str) -> None:
    faults = [{"on": "cs_declared.u", "kind": "bias", "value": 2.0, "from": 0.5, "to": 1.5}]
    faults += [{"on": "me_declared.u", "kind": "delay", "delay": 0.3}]
    noise = [f"connections.{k}.noise={{variance: 0.01}}" for k in range(len(KINDS))]
    run = cosim.run(followed(fmus, algorithm=algorithm, seed=3, faults=faults), set=noise, in_process=True)
    for kind in KINDS:
        check_follows(run, kind)
    biased = run["cs_declared.u"] - JUMP
    assert np.abs(biased[5:16] - 2.0).max() < 0.6 > np.abs(np.delete(biased, slice(5, 16))).max()
    assert np.abs(run["me_declared.u"][:13]).max() < 0.6 < run["me_declared.u"][13:].min()


@pytest.mark.parametrize("checkpoint", ["1 h", None])
@pytest.mark.parametrize("fmu", ["cs_declared", "forgets", "me_declared"])
def test_a_run_goes_on_with_the_values_of_its_row(fmus: Path, tmp_path: Path, fmu: str, checkpoint: Any) -> None:
    """Restored from a checkpoint, or by a replay of the recorded inputs, in C or in Python."""
    changes = [{"at": 1, "to": 1}, {"at": 1.5, "to": 0, "rate": 4}]
    source, events = (
        {"block": "reference", "signals": {"u": {"changes": changes}}},
        [{"at": 0.5, "set": {f"{fmu}.w": 3}}],
    )
    path = followed(fmus, source, [fmu, "cs_measured"], events=events, checkpoint=checkpoint)
    whole = cosim.run(path)
    cosim.run(path, tmp_path / "part", {"duration": 1.2}, report=False)
    run = cosim.run(tmp_path / "part", until=STEPS * H, report=False)
    for name in whole.names:  # A solver's longest step depends on the end of the run.
        np.testing.assert_allclose(run[name], whole[name], rtol=0, atol=1e-13 if fmu.startswith("me") else 0)
    check_follows(whole, fmu)


@pytest.mark.parametrize("kind", KINDS)
def test_a_replay_reads_outputs_for_the_command_of_their_row(fmus: Path, tmp_path: Path, kind: str) -> None:
    x = np.concatenate([[0.0], np.cumsum(H * JUMP[:-1])])
    outputs = {"x": x} if kind.endswith("none") else {"x": x, "y": x + JUMP}
    log = write_log(tmp_path / "log.csv", {"time": TIME, "u": JUMP, "w": 0.0 * TIME, **outputs})
    replayed = cosim.replay(log, fmu=fmus / f"{kind}.fmu", in_process=True)
    for name, values in outputs.items():
        np.testing.assert_allclose(replayed[f"plant.{name}"], values, rtol=0, atol=1e-9)


# -- between the rows of an input -----------------------------------------------------------------


@pytest.mark.parametrize(("interpolation", "before"), [("held", 0.0), ("linear", 0.9)])
def test_reals_alone_are_interpolated_and_equal_times_are_a_jump(
    fmus: Path, tmp_path: Path, interpolation: str, before: float
) -> None:
    """The last of equal rows acts from their time on; a line before them ends at the first."""
    (tmp_path / "in.csv").write_text("time,u,n\n0,0,0\n1,1,3\n1,7,6\n1,5,4\n2,5,5\n")
    run = cosim.simulate(fmus / "whole.fmu", input=tmp_path / "in.csv", interpolation=interpolation, in_process=True)
    assert run["whole.u"][9] == pytest.approx(before)
    np.testing.assert_array_equal(run["whole.u"][10:], 5.0)
    np.testing.assert_array_equal(run["whole.m"], np.select([TIME > 1.95, TIME > 0.95], [5, 4], 0))
    check_follows(run, "whole")


# -- times as large as those since 1970 -------------------------------------------------------------

EPOCH = 1_700_000_000


@pytest.mark.parametrize("h", [0.1, 0.01])
def test_rows_of_large_times_are_those_of_their_points(fmus: Path, tmp_path: Path, h: float) -> None:
    """Playback, a reference, an event and a fault act at their points; a replay agrees."""
    k = np.arange(201)
    times = [f"{EPOCH + hundredths // 100}.{hundredths % 100:02d}" for hundredths in (100 * h * k).round().astype(int)]
    at = [float(time) for time in times]
    (tmp_path / "in.csv").write_text("time,u\n" + "".join(f"{t},{n}\n" for n, t in enumerate(times)))
    path = followed(
        fmus,
        {"block": "playback", "file": str(tmp_path / "in.csv")},
        ["cs_declared", "cs_none", "me_declared"],
        ["ref.w → cs_declared.w"],
        components={"ref": {"block": "reference", "signals": {"w": {"changes": [{"at": at[57], "to": 1}]}}}},
        events=[{"at": at[n], "set": {"cs_none.w": n}} for n in (33, 74)],
        faults=[{"on": "me_declared.u", "kind": "bias", "value": 1000, "from": at[49], "to": at[99]}],
        start_time=EPOCH,
        step=h,
        duration=200 * h,
    )
    run = cosim.run(path, in_process=True)
    np.testing.assert_array_equal(run["r.u"], k)
    np.testing.assert_array_equal(run["cs_declared.w"], (k >= 57).astype(float))
    np.testing.assert_array_equal(run["cs_none.w"], np.select([k >= 74, k >= 33], [74, 33], 0))
    np.testing.assert_array_equal(run["me_declared.u"] - k, np.where((k >= 49) & (k <= 99), 1000, 0))
    x = run["cs_declared.x"]
    lines = (f"{t},{n},{int(n >= 57)},{x[n].item()!r}\n" for n, t in enumerate(times))
    (tmp_path / "log.csv").write_text("time,u,w,x\n" + "".join(lines))
    replayed = cosim.replay(tmp_path / "log.csv", fmu=fmus / "cs_declared.fmu", in_process=True)
    np.testing.assert_allclose(replayed["plant.x"], x, rtol=0, atol=1e-3 * h * 200)
