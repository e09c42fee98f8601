"""SSPs: read and run as the scenario says that means the same, written for importers of other makers, and refused."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fmpy.ssp.ssd import read_ssd, read_ssv

from cosim import check
from cosim.authoring.export import export_ssp
from cosim.core.errors import InputError
from cosim.files import archive as archive_rules
from cosim.files.results import Results
from cosim.simulation.workflow import run
from tests.lag import bound, component, connection, lag_fmu, real, ssp
from tests.test_fmu_hosts import AGREEMENT, LIBRARIES, MISSING, ROOT
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


def test_a_mapping_renames_converts_and_leaves_out_what_it_does_not_name(tmp_path: Path) -> None:
    units = '<ssv:Units><ssc:Unit name="ms"><ssc:BaseUnit s="1" factor="0.001"/></ssc:Unit></ssv:Units>'
    values = f"""<ssv:ParameterSet version="1.0" name="s"
 xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon"><ssv:Parameters>
<ssv:Parameter name="time constant">{real(500.0, "ms")}</ssv:Parameter>
<ssv:Parameter name="a.bias">{real(9.0)}</ssv:Parameter>
<ssv:Parameter name="g">{real(3.0)}</ssv:Parameter></ssv:Parameters>{units}</ssv:ParameterSet>"""
    mapping = """<ssm:ParameterMapping version="1.0" xmlns:ssm="http://ssp-standard.org/SSP1/SystemStructureParameterMapping"
 xmlns:ssc="http://ssp-standard.org/SSP1/SystemStructureCommon">
<ssm:MappingEntry source="time constant" target="a.T"/><ssm:MappingEntry source="g" target="a.gain">
<ssc:LinearTransformation factor="2" offset="-1"/></ssm:MappingEntry><ssm:MappingEntry source="g" target="b.gain"/>
</ssm:ParameterMapping>"""
    mapped = '<ssd:ParameterMapping source="resources/m.ssm"/>'
    binding = f'<ssd:ParameterBinding source="resources/v.ssv">{mapped}</ssd:ParameterBinding>'
    ran(pair(tmp_path, binding, v_ssv=values, m_ssm=mapping), tmp_path)
    written = json.loads((tmp_path / "ran" / "system" / "scenario.json").read_text())
    assert written["components"]["a"]["start"] == {"T": 0.5, "gain": 5.0}
    assert written["components"]["b"]["start"] == {"gain": 3.0}


def test_a_parameter_is_converted_at_each_connector_on_its_way(tmp_path: Path) -> None:
    fmu = lag_fmu(tmp_path / "lag.fmu", ("rad", ""))
    units = """<ssd:Units><ssc:Unit name="deg"><ssc:BaseUnit rad="1" factor="0.017453292519943295"/></ssc:Unit>
<ssc:Unit name="turn"><ssc:BaseUnit rad="1" factor="6.283185307179586"/></ssc:Unit></ssd:Units>"""
    entry = '<ssm:MappingEntry source="half" target="drive"><ssc:LinearTransformation offset="90"/></ssm:MappingEntry>'
    mapping = f'<ssm:ParameterMapping version="1.0">{entry}</ssm:ParameterMapping>'
    mapping = f"<ssd:ParameterMapping>{mapping}</ssd:ParameterMapping>"
    system = f"""<ssd:System name="root"><ssd:Connectors>
<ssd:Connector name="drive" kind="input"><ssc:Real unit="deg"/></ssd:Connector></ssd:Connectors>
<ssd:ParameterBindings>{bound({"half": real(0.5, "turn")}, mapping)}</ssd:ParameterBindings>
<ssd:Elements>{component("a")}</ssd:Elements><ssd:Connections>{connection("drive", "a.u")}</ssd:Connections>
</ssd:System>{units}"""
    ours = ran(ssp(tmp_path / "one.ssp", system, {"resources/lag.fmu": fmu}), tmp_path)
    assert ours["a.u"][0] == pytest.approx(1.5 * np.pi)  # 0.5 turn = 180 deg, + 90 deg


def test_the_step_is_that_of_an_annotation_and_what_is_not_said_is_warned_of(tmp_path: Path) -> None:
    fmu = lag_fmu(tmp_path / "lag.fmu")
    system = f'<ssd:System name="root"><ssd:Elements>{component("a")}</ssd:Elements></ssd:System>'
    said = """<ssd:DefaultExperiment stopTime="1"><ssd:Annotations><ssc:Annotation type="com.opensimulationplatform">
<osp:Algorithm xmlns:osp="o"><osp:FixedStepAlgorithm baseStepSize="0.25"/></osp:Algorithm></ssc:Annotation>
</ssd:Annotations></ssd:DefaultExperiment>"""
    outcome = run(
        ssp(tmp_path / "x.ssp", system, {"resources/lag.fmu": fmu}, said), tmp_path / "r", report=False, force=True
    )
    assert outcome.results.time.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert not [w for w in outcome.manifest["warnings"] if "names no" in w]
    silent = ssp(tmp_path / "y.ssp", system, {"resources/lag.fmu": fmu}, "<ssd:DefaultExperiment/>")
    outcome = run(silent, tmp_path / "r", report=False, force=True, in_process=True)
    assert len([w for w in outcome.manifest["warnings"] if "names no" in w]) == 2


# -- refused ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("times", "step", "words"),
    [
        ('startTime="1" stopTime="0.5"', "0.25", "stopTime 0.5 s is not after startTime 1 s"),
        ('stopTime="0"', "0.25", "stopTime 0 s is not after startTime 0 s"),
        ('stopTime="1"', "0", "baseStepSize 0 s: a communication step is more than 0 s"),
        ('stopTime="1"', "-1", "baseStepSize -1 s: a communication step is more than 0 s"),
    ],
)
def test_times_that_are_none_are_refused_and_not_replaced(tmp_path: Path, times: str, step: str, words: str) -> None:
    fmu = lag_fmu(tmp_path / "lag.fmu")
    system = f'<ssd:System name="root"><ssd:Elements>{component("a")}</ssd:Elements></ssd:System>'
    said = f"""<ssd:DefaultExperiment {times}><ssd:Annotations><ssc:Annotation type="com.opensimulationplatform">
<osp:Algorithm xmlns:osp="o"><osp:FixedStepAlgorithm baseStepSize="{step}"/></osp:Algorithm></ssc:Annotation>
</ssd:Annotations></ssd:DefaultExperiment>"""
    (told,) = faults_of(ssp(tmp_path / "x.ssp", system, {"resources/lag.fmu": fmu}, said))
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
    path = pair(tmp_path, bindings, connections, a="<ssd:Oddity/>")
    told = faults_of(path)
    for words in (
        "ssv:Real: value 'many': it is a finite number",
        "b.stuck is 0.5; it is true or false",
        'no file "resources/none.ssv" in it',
        "endElement 'c' is not in its system",
        "a has no connector 'yy'; did you mean \"y\"?",
        "two sources for a.u: b.y and b.y; keep one",
        "ssc:BooleanMappingTransformation: is not run here",
        "breaks the schema of SSP: Element 'ssd:Oddity'",
    ):
        assert any(words in line for line in told), (words, told)
    assert all(line.startswith(f"{path}:") and line.removeprefix(f"{path}:").split(":")[0].isdigit() for line in told)


@pytest.mark.parametrize(
    ("kind", "words"),
    [
        ('type="application/x-ssp-definition" source="resources/x.ssp"', "nested systems lie in this file"),
        ("", "it has no source"),
        ('source="../../etc/passwd"', "leads out of the package"),
        ('source="http://somewhere/lag.fmu"', "is not in the package"),
        ('source="resources/Lag.fmu"', 'no file "resources/Lag.fmu" in it'),
        ('source="a%00b"', "is no name of a file"),
        ('source="resources/lag.fmu" implementation="ScheduledExecution"', "is not run here"),
        ('source="resources/lag.fmu" implementation="ModelExchange"', "offers co-simulation only"),
        ('source="resources/bad.fmu"', "is no FMU"),
    ],
)
def test_a_component_that_cannot_be_run_is_refused(tmp_path: Path, kind: str, words: str) -> None:
    fmu = lag_fmu(tmp_path / "lag.fmu")
    system = f'<ssd:System name="root"><ssd:Elements><ssd:Component name="a" {kind}/></ssd:Elements></ssd:System>'
    path = ssp(tmp_path / "x.ssp", system, {"resources/lag.fmu": fmu, "resources/bad.fmu": "no"})
    with pytest.raises(InputError, match=re.escape(words)) as caught:
        check(path)
    assert caught.value.exit_code == (3 if "bad" in kind else 2)
    assert {fault.line for fault in caught.value.faults} == {7}
    assert "/tmp/cosim" not in str(caught.value)


def test_a_hostile_archive_is_refused_before_it_is_unpacked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(archive_rules, "MOST_UNPACKED", 50_000_000)
    path = tmp_path / "x.ssp"
    for name, content, words in (
        ("../outside.txt", b"", "outside its folder"),
        ("resources/bomb", bytes(60_000_000), "zip bomb"),
        ("resources/v.ssv", b"<!DOCTYPE a [<!ENTITY b 'c'>]><a>&b;</a>", "DOCTYPE, which SSP knows nothing of"),
        ("resources/v.ssm", b"<a>" * 100, "nested too deep"),
        ("resources/v.ssb", b"<a", "is not XML"),
    ):
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("SystemStructure.ssd", "<a/>")
            archive.writestr(name, content)
        assert words in "".join(faults_of(path)), words
    for content, words in ((b"no", "not a zip archive"), (None, "has no SystemStructure.ssd")):
        if content is None:
            with zipfile.ZipFile(path, "w") as archive:
                archive.writestr("a", "b")
        else:
            path.write_bytes(content)
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
    assert (tmp_path / "one.ssp").read_bytes() == (tmp_path / "two.ssp").read_bytes()
    assert not read_ssd(str(tmp_path / "one.ssp")).system.connectors  # raises where the schema is broken
    start = {p.name: p.value for p in read_ssv(str(tmp_path / "one.ssp"), "resources/start.ssv").parameters}
    assert start == {
        "a.T": "0.25",
        "a.bias": "0.125",
        "b.gain": "-3.0",
        "b.T": "0.5",
    }  # what differs from the FMU's own
    assert check(tmp_path / "one.ssp") == []


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"faults": [{"on": "a.u", "kind": "bias", "value": 1}]}, "faults cannot be exported"),
        ({"events": [{"at": 1, "set": {"a.gain": 2}}]}, "events cannot be exported"),
        ({"connections": [{"from": "r.drive", "to": "b.u", "factor": 2}]}, "the connection converts"),
    ],
)
def test_what_an_ssp_cannot_hold_is_refused_with_the_cure(tmp_path: Path, changed: dict[str, Any], words: str) -> None:
    source = lags(tmp_path, **changed)
    with pytest.raises(InputError, match=words) as caught:
        export_ssp(source, tmp_path / "x.ssp")
    assert caught.value.exit_code == 2
    assert not (tmp_path / "x.ssp").exists()


@pytest.mark.parametrize(
    ("component", "link", "words"),
    [
        ({"fmu": "typed3.fmu"}, ("x.twice", "x.a"), "is FMI 3.0"),
        ({"fmu": "typed3.fmu"}, ("x.twice", "x.a"), "arrays are not what SSP 1.0 can connect"),
        ({"fmu": "typed2.fmu", "interface": "model-exchange"}, ("x.r_out", "a.u"), "is run by model exchange"),
        ({"fmu": "typed2.fmu", "step": 0.125}, ("x.r_out", "a.u"), "give the scenario step 0.125"),
        (
            {"fmu": "typed2.fmu"},
            ("x.e_out", "y.e_in"),
            "x.e_out is Enumeration; importers connect Real, Integer, Boolean",
        ),
        ({"fmu": "typed2.fmu"}, ("x.s_out", "y.s_in"), "x.s_out is String"),
        ({"fmu": "typed2.fmu"}, ("x.i_out", "a.u"), "importers of SSPs convert no types"),
    ],
)
def test_what_importers_do_not_run_is_refused(
    tmp_path: Path, component: dict[str, Any], link: tuple[str, str], words: str
) -> None:
    typed_fmu(tmp_path, 2, "typed2")
    typed_fmu(tmp_path, 3, "typed3")
    others = {"a": {"fmu": "lag.fmu"}, "y": {"fmu": "typed2.fmu"}}
    ends = [{"from": link[0], "to": link[1]}]
    source = lags(tmp_path, components={"x": component, **others}, connections=ends)
    with pytest.raises(InputError, match=re.escape(words)):
        export_ssp(source, tmp_path / "x.ssp")


def test_values_of_every_type_that_importers_take_are_written(tmp_path: Path) -> None:
    typed_fmu(tmp_path, 2, "typed2")
    start = {"r_in": 2.5, "i_in": -3, "b_in": True, "s_in": "<&>", "e_in": "second"}
    source = lags(tmp_path, components={"x": {"fmu": "typed2.fmu", "start": start}}, connections=[])
    again = run(
        export_ssp(source, tmp_path / "x.ssp").path, tmp_path / "r", report=False, force=True, in_process=True
    ).results
    assert [again[f"x.{n}"][0].item() for n in ("r_out", "i_out", "b_out", "e_out")] == [2.5, -3, 1, 2]
    assert again.exact["x.s_out"][0] == "<&>"


# -- in other hosts -----------------------------------------------------------------------------------


def run_in(host: str, job: dict[str, Any]) -> np.ndarray:
    """Rows in a process of its own."""
    done = subprocess.run(
        [sys.executable, "-m", f"tests.hosts_{host}"],
        input=json.dumps(job), capture_output=True, text=True, cwd=ROOT, check=False,
        env={**os.environ, "LD_LIBRARY_PATH": str(LIBRARIES)},
    )  # fmt: skip
    assert done.returncode == 0, (done.returncode, done.stderr)
    return np.array(json.JSONDecoder().raw_decode(done.stdout[done.stdout.index("[[") :])[0])


HOSTS = [
    pytest.param(host, marks=pytest.mark.skipif(MISSING.get(host, False), reason=f"needs {host}"))
    for host in ("libcosim", "ecos", "fmpy_ssp")
]


def agrees(host: str, path: Path, folder: Path, step: float, steps: int) -> Results:
    """An SSP moves in a host as it does here; FMPy exchanges nothing before its first step, inputs are zero in it."""
    overrides = [f"step={step}", f"duration={step * steps}"]
    out = folder / f"here-{host}"
    ours = run(path, out, overrides, report=False, force=True, in_process=True).results
    fed = [c["to"] for c in json.loads((out / "system" / "scenario.json").read_text())["connections"]]
    if host == "fmpy_ssp":
        none = [{"on": signal, "kind": "stuck", "value": 0, "from": 0, "to": 0} for signal in fed]
        ours = run(
            path, out, [*overrides, f"faults={json.dumps(none)}"], report=False, force=True, in_process=True
        ).results
    columns = [c for c in ours.columns if c not in fed]
    job = {"ssp": str(path), "columns": columns, "step": step, "steps": steps, "parameters": "start"}
    got, want = run_in(host, job), np.column_stack([ours[c] for c in columns])
    np.testing.assert_allclose(got[1:], want[1:], rtol=0, atol=AGREEMENT)
    return ours


@pytest.mark.thorough
@pytest.mark.hosts
@pytest.mark.parametrize("host", HOSTS)
def test_lags_move_in_other_hosts_as_here(host: str, tmp_path: Path) -> None:
    ours = agrees(host, export_ssp(lags(tmp_path), tmp_path / "lags.ssp").path, tmp_path, 0.0625, 32)
    assert np.ptp(ours["b.y"]) > 0.1
