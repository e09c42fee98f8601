"""SSPs: read and run as the scenario says that means the same, written for importers of other makers, and refused."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import pytest
from fmpy.ssp.ssd import read_ssd, read_ssv

from cosim import check
from cosim.authoring.export import export_ssp
from cosim.core.errors import InputError
from cosim.files import archive as archive_rules
from cosim.files.results import Results
from cosim.simulation.workflow import run
from tests.lag import bound, component, connection, lag_fmu, real, ssp
from tests.typed import typed_fmu

STEP = "step=0.0625"  # s; a power of two, so that sums of it are exact in hosts that add


def ran(source: Path, folder: Path, *overrides: str) -> Results:
    return run(source, folder / "ran", [STEP, *overrides], report=False, force=True, in_process=True).results


def scenario(folder: Path, **content: Any) -> Path:
    path = folder / "same.json"
    whole = {"name": "same", "duration": 2, "step": 0.0625, "algorithm": "jacobi", **content}
    path.write_text(json.dumps(whole))
    return path


# -- read -------------------------------------------------------------------------------------------

LOOP = "".join((connection("a.y", "b.u"), connection("b.y", "a.u")))


def pair(folder: Path, bindings: str = "", connections: str = LOOP, a: str = "", b: str = "", **files: str) -> Path:
    """Two lags in a loop, with bindings of the system."""
    fmu = lag_fmu(folder / "lag.fmu")
    outer = f"<ssd:ParameterBindings>{bindings}</ssd:ParameterBindings>" if bindings else ""
    system = f"""<ssd:System name="root">{outer}<ssd:Elements>{component("a", inside=a)}{component("b", inside=b)}
</ssd:Elements><ssd:Connections>{connections}</ssd:Connections></ssd:System>"""
    named = {f"resources/{name.replace('_', '.')}": text for name, text in files.items()}
    return ssp(folder / "pair.ssp", system, {"resources/lag.fmu": fmu, **named})


def one(path: Path, inside: str = "", experiment: str = "", fmu: Path | None = None) -> Path:
    """Return an SSP of one lag, with further content of the system."""
    system = f'<ssd:System name="root">{inside}<ssd:Elements>{component("a")}</ssd:Elements></ssd:System>'
    return ssp(path, system, {"resources/lag.fmu": fmu or lag_fmu(path.parent / "lag.fmu")}, experiment)


def said(times: str, step: float) -> str:
    return f"""<ssd:DefaultExperiment {times}><ssd:Annotations><ssc:Annotation type="com.opensimulationplatform">
<osp:Algorithm xmlns:osp="o"><osp:FixedStepAlgorithm baseStepSize="{step}"/></osp:Algorithm></ssc:Annotation>
</ssd:Annotations></ssd:DefaultExperiment>"""


def test_the_step_is_that_of_an_annotation_and_what_is_not_said_is_warned_of(tmp_path: Path) -> None:
    for experiment, warnings in ((said('stopTime="1"', 0.25), 0), ("<ssd:DefaultExperiment/>", 2)):
        path = one(tmp_path / "x.ssp", experiment=experiment)
        outcome = run(path, tmp_path / "r", report=False, force=True, in_process=True)
        about_times = [
            text for text in outcome.manifest["warnings"] if "--set step" in text or "--set duration" in text
        ]
        assert len(about_times) == warnings
        if not warnings:
            assert outcome.results.time.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]


# -- refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "step", "words"),
    [
        ('startTime="1" stopTime="0.5"', 0.25, "stopTime 0.5 s is not after startTime 1 s"),
        ('stopTime="1"', 0, "baseStepSize 0 s: "),
    ],
)
def test_times_that_are_none_are_refused_and_not_replaced(tmp_path: Path, times: str, step: float, words: str) -> None:
    (told,) = faults_of(one(tmp_path / "x.ssp", experiment=said(times, step)))
    assert words in told


def faults_of(path: Path) -> list[str]:
    with pytest.raises(InputError) as caught:
        check(path)
    assert caught.value.exit_code == 2
    return [str(fault) for fault in caught.value.faults]


def test_every_fault_is_told_at_once_with_its_place_and_cure(tmp_path: Path) -> None:
    bindings = bound({"a.gain": '<ssv:Real value="many"/>', "b.stuck": real(0.5)})
    bindings += '<ssd:ParameterBinding source="resources/none.ssv"/>'
    connections = connection("a.y", "c.u") + connection("a.yy", "b.u") + connection("b.y", "a.u")
    connections += connection("b.y", "a.u") + connection("a.y", "b.u", "<ssc:BooleanMappingTransformation/>")
    path = pair(tmp_path, bindings, connections)
    told = faults_of(path)
    for words in (
        "ssv:Real: value 'many': ",
        "b.stuck is 0.5; ",
        'no file "resources/none.ssv" in it',
        "endElement 'c' is not in its system",
        "a has no connector 'yy'; did you mean \"y\"?",
        "two sources for a.u: b.y and b.y; keep one",
        "ssc:BooleanMappingTransformation: is not supported",
    ):
        assert any(words in line for line in told), (words, told)
    assert all(line.startswith(f"{path}:") and line.removeprefix(f"{path}:").split(":")[0].isdigit() for line in told)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ('type="application/x-ssp-definition" source="resources/x.ssp"', "nested systems in this file"),
        ("", "it has no source"),
        ('source="../../etc/passwd"', "is outside the package"),
        ('source="http://somewhere/lag.fmu"', "is outside the package"),
        ('source="a%00b"', "is not a file name"),
        ('source="resources/lag.fmu" implementation="ScheduledExecution"', "is not supported"),
        ('source="resources/bad.fmu"', "is not an FMU"),
    ],
)
def test_a_component_that_cannot_be_run_is_refused(tmp_path: Path, kind: str, words: str) -> None:
    fmu = lag_fmu(tmp_path / "lag.fmu")
    system = f'<ssd:System name="root"><ssd:Elements><ssd:Component name="a" {kind}/></ssd:Elements></ssd:System>'
    path = ssp(tmp_path / "x.ssp", system, {"resources/lag.fmu": fmu, "resources/bad.fmu": "no"})
    with pytest.raises(InputError, match=words) as caught:
        check(path)
    assert caught.value.exit_code == (3 if "bad" in kind else 2)
    assert {fault.line for fault in caught.value.faults} == {7}
    assert "/tmp/cosim" not in str(caught.value)


def test_a_hostile_archive_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive_rules, "MOST_UNPACKED", 50_000_000)
    path = tmp_path / "x.ssp"
    path.write_bytes(b"no")
    assert "not a zip archive" in "".join(faults_of(path))
    for name, content, words in (
        ("../outside.txt", b"", "outside its folder"),
        ("resources/bomb", bytes(60_000_000), "zip bomb"),
        ("resources/v.ssv", b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "DOCTYPE"),
        ("resources/v.ssm", b"<a>" * 100, "nested"),
        ("resources/v.ssb", b"<a", "is not XML"),
    ):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("SystemStructure.ssd", "<a/>")
            archive.writestr(name, content)
        assert words in "".join(faults_of(path)), words


def test_doubled_connections_through_many_levels_are_told_in_no_time(tmp_path: Path) -> None:
    ends = '<ssd:Connectors><ssd:Connector name="a" kind="input"/></ssd:Connectors>'
    inner, link = component("lag"), connection("a", "lag.u")
    for level in range(24):  # 2^24 ways
        system = f"<ssd:Elements>{inner}</ssd:Elements><ssd:Connections>{link}{link}</ssd:Connections>"
        inner, link = f'<ssd:System name="s{level}">{ends}{system}</ssd:System>', connection("a", f"s{level}.a")
    values = f"<ssd:ParameterBindings>{bound({'s23.a': real(1.0)})}</ssd:ParameterBindings>"
    whole = f'<ssd:System name="root">{values}<ssd:Elements>{inner}</ssd:Elements></ssd:System>'
    path = ssp(tmp_path / "deep.ssp", whole, {"resources/lag.fmu": lag_fmu(tmp_path / "lag.fmu")})
    assert sum("two sources" in line for line in faults_of(path)) == 24


# -- written ----------------------------------------------------------------------------------------

WAVES = {"drive": {"unit": "deg", "changes": [{"at": 0.25, "to": 90}, {"at": 1, "to": -90, "rate": 200}]}}


def lags(folder: Path, **content: Any) -> Path:
    """A reference, a lag and a recording that feed another: steps, a ramp, a loop, start values of two types."""
    lag_fmu(folder / "lag.fmu")
    lag_fmu(folder / "in.fmu", ("rad", ""))
    (folder / "log.csv").write_text("time,push [deg]\n0,10\n0.5,-20\n1.25,40\n")
    whole: dict[str, Any] = {
        "components": {
            "a": {"fmu": "in.fmu", "start": {"T": 0.25, "bias": 0.125}},
            "b": {"fmu": "lag.fmu", "start": {"gain": -3, "T": 0.5, "stuck": False}},
            "c": {"fmu": "in.fmu"},
            "r": {"block": "reference", "signals": WAVES},
            "p": {"block": "playback", "file": "log.csv"},
        },
        "connections": [
            {"from": "r.drive", "to": "a.u"},
            {"from": "a.y", "to": "b.u"},
            {"from": "p.push", "to": "c.u"},
        ],
    }
    return scenario(folder, **{**whole, **content})


def test_what_is_exported_satisfies_the_schema_and_is_the_same_each_time(tmp_path: Path) -> None:
    source = lags(tmp_path)
    for name in ("one", "two"):
        export_ssp(source, tmp_path / f"{name}.ssp")
    path = tmp_path / "one.ssp"
    assert path.read_bytes() == (tmp_path / "two.ssp").read_bytes()
    assert not read_ssd(str(path)).system.connectors  # raises where the schema is broken
    start = {p.name: p.value for p in read_ssv(str(path), "resources/start.ssv").parameters}
    assert start == {"a.T": "0.25", "a.bias": "0.125", "b.gain": "-3.0", "b.T": "0.5", "b.stuck": "false"}
    assert check(path) == []


def other(component: dict[str, Any], start: str, end: str) -> dict[str, Any]:
    """Return what has a component x, and a connection of it."""
    components = {"x": component, "a": {"fmu": "lag.fmu"}, "y": {"fmu": "typed2.fmu"}}
    return {"components": components, "connections": [{"from": start, "to": end}]}


TYPED = {"fmu": "typed2.fmu"}


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"faults": [{"on": "a.u", "kind": "bias", "value": 1}]}, "faults cannot be exported"),
        ({"events": [{"at": 1, "set": {"a.gain": 2}}]}, "events cannot be exported"),
        (other({"fmu": "typed3.fmu"}, "x.twice", "x.a"), "is FMI 3.0"),
        (other(TYPED | {"interface": "model-exchange"}, "x.r_out", "a.u"), "uses model exchange"),
        (other(TYPED | {"step": 0.125}, "x.r_out", "a.u"), "0.125"),
        (other(TYPED, "x.e_out", "y.e_in"), "connects Enumeration"),
        (other(TYPED, "x.i_out", "a.u"), "connects Integer to Real"),
    ],
)
def test_what_an_ssp_cannot_hold_or_importers_do_not_run_is_refused(
    tmp_path: Path, changed: dict[str, Any], words: str
) -> None:
    for version in (2, 3):
        typed_fmu(tmp_path, version, f"typed{version}")
    with pytest.raises(InputError, match=words) as caught:
        export_ssp(lags(tmp_path, **changed), tmp_path / "x.ssp")
    assert caught.value.exit_code == 2
    assert not (tmp_path / "x.ssp").exists()


def test_values_of_every_type_that_importers_take_are_written(tmp_path: Path) -> None:
    typed_fmu(tmp_path, 2, "typed2")
    start = {"r_in": 2.5, "i_in": -3, "b_in": True, "s_in": "<&>", "e_in": "second"}
    source = lags(tmp_path, components={"x": TYPED | {"start": start}}, connections=[])
    again = ran(export_ssp(source, tmp_path / "x.ssp").path, tmp_path)
    assert [again[f"x.{n}"][0].item() for n in ("r_out", "i_out", "b_out", "e_out")] == [2.5, -3, 1, 2]
    assert again.exact["x.s_out"][0] == "<&>"
