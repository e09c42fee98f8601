"""Values exchanged with partners by UDP, MQTT and functions: recorded, repeated to the byte, held when lost."""

from __future__ import annotations

import json
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cosim
from cosim.base.arrays import Array
from cosim.base.errors import InputError
from cosim.master.observer import ObservedRun, Observer
from cosim.verbs.check_verb import check
from tests.deeds import deeds_fmu

MOSQUITTO = shutil.which("mosquitto", path="/usr/sbin:/usr/bin:/usr/local/sbin:/opt/homebrew/sbin")
EXAMPLES = Path(__file__).resolve().parent.parent / "examples" / "live"


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def scenario(folder: Path, live: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Two FMUs of C: u0 and u1 are inputs, y0 and y1 outputs."""
    for name in ("good", "other"):
        if not (folder / f"{name}.fmu").exists():
            deeds_fmu(folder / f"{name}.fmu")
    parts = {name: {"fmu": str(folder / f"{name}.fmu")} for name in ("good", "other")}
    links = [{"from": "good.y1", "to": "other.u1"}]
    whole = {"name": "live", "duration": 2.0, "step": 0.02, "pace": 2, "components": parts, "connections": links}
    return {**whole, "live": dict(live), **more}


@contextmanager
def partner(work: Callable[[threading.Event], None]) -> Iterator[None]:
    """A partner in a thread, told when to end."""
    end = threading.Event()
    thread = threading.Thread(target=work, args=(end,), daemon=True)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join(10)


def sender(port: int, contents: Callable[[int], bytes], count: int = 1 << 30, pause: float = 0.01) -> Any:
    def send(end: threading.Event) -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for k in range(count):
                if end.is_set():
                    return
                out.sendto(contents(k), ("127.0.0.1", port))
                time.sleep(pause)

    return send


def repeated(folder: Path) -> Any:
    """Repeat the run in `o` without its partners; its rows are the same bytes."""
    again = cosim.run(folder / "o" / "manifest.json", folder / "again", report=False)
    assert (folder / "again" / "results.csv").read_bytes() == (folder / "o" / "results.csv").read_bytes()
    return again


def test_an_unknown_host_is_named_before_the_run_and_by_check(tmp_path: Path) -> None:
    outputs = {"good.y0": {"udp": "nowhere.invalid:5000"}, "good.u0": {"udp": "127.0.0.1:5000"}}
    file = tmp_path / "live.json"
    file.write_text(json.dumps(scenario(tmp_path, {"outputs": outputs})))
    for attempt in (lambda: cosim.run(file, tmp_path / "o"), lambda: check(file)):
        with pytest.raises(InputError, match=r"cannot send to nowhere\.invalid:5000: .*correct the host") as refused:
            attempt()
        assert (refused.value.exit_code, refused.value.code) == (2, "E-PRT-004")
        assert refused.value.faults[0].line > 0
    assert not (tmp_path / "o").exists()


@pytest.mark.parametrize("in_process", [False, True])
def test_values_arrive_and_leave_by_udp_and_the_manifest_repeats_them(tmp_path: Path, in_process: bool) -> None:
    port, back = free_port(), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    back.bind(("127.0.0.1", 0))
    back.settimeout(5)
    live = {
        "inputs": {"good.u0": {"udp": port, "field": "a"}, "other.u0": {"udp": port, "field": "b"}},
        "outputs": {"good.y0": {"udp": back.getsockname()[1]}, "good.u0": {"udp": back.getsockname()[1]}},
        "every": 0.1,
    }
    with back, partner(sender(port, lambda k: json.dumps({"a": k + 1, "b": 7}).encode())):
        ran = cosim.run(scenario(tmp_path, live), tmp_path / "o", in_process=in_process)
        sent = [json.loads(back.recv(4096)) for _ in range(21)]
    assert len({*ran["good.u0"]}) > 5
    assert ran["other.u0"][-1] == 7
    assert [each["time"] for each in sent] == pytest.approx([0.1 * k for k in range(21)])
    assert [each["u0"] for each in sent] == [*ran["good.u0"][::5]]
    first, second, out = ran.manifest["partners"]
    assert (first["input"], first["refused"], second["messages"] > 5) == ("good.u0", 0, True)
    assert (out["outputs"], out["sent"]) == (["y0", "u0"], 21)
    assert {"pace": 2.0}.items() <= ran.manifest["real_time"].items()
    assert not {"live", "pace"} & {*ran.manifest["scenario"]}
    assert ran.manifest["loop"] == "C"
    assert "udp 127.0.0.1" in (tmp_path / "o" / "report.html").read_text(encoding="utf-8")
    assert "partners" not in repeated(tmp_path).manifest


def test_a_lost_partner_is_held_flagged_and_reported(tmp_path: Path) -> None:
    port = free_port()
    live = {"inputs": {"good.u0": {"udp": port, "field": "a"}}, "lost": 0.2}
    with partner(sender(port, lambda k: json.dumps({"a": 3.5}).encode(), count=3)):
        ran = cosim.run(scenario(tmp_path, live), tmp_path / "o")
    (entry,) = ran.manifest["partners"]
    (outage,) = entry["lost"][-1:]
    assert outage["to"] == pytest.approx(2.0)
    assert outage["from"] < 2.0
    assert outage["seconds"] > 0.2
    assert any("no message from udp" in warning and "was held" in warning for warning in ran.warnings)
    repeated(tmp_path)


def test_wrong_messages_are_refused_counted_and_change_nothing(tmp_path: Path) -> None:
    port = free_port()
    wrong = (b"\xff{", b"[1", b"3.5", b"[]", b'{"a": NaN}', b'{"a": "x"}', b'{"a": true}', b'{"a": 1e999}',
             b'{"a": null}', b'{"a": [1]}', b"[" * 5000, b'{"a": ' + b"9" * 400 + b"}", b'{"b": 1}', b"")  # fmt: skip
    live = {"inputs": {"good.u0": {"udp": port, "field": "a"}}}
    with partner(sender(port, lambda k: wrong[k % len(wrong)], pause=0.005)):
        ran = cosim.run(scenario(tmp_path, live), tmp_path / "o")
    (entry,) = ran.manifest["partners"]
    assert {*ran["good.u0"]} == {0.0}
    assert entry["refused"] > 5
    assert entry["refusal"].startswith("at t = ")
    assert "changes" not in ran.manifest
    assert any("messages from udp" in warning and "refused" in warning for warning in ran.warnings)


def test_a_port_in_use_is_told_with_its_place_and_nothing_is_left(tmp_path: Path) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        path = tmp_path / "live.json"
        port = taken.getsockname()[1]
        path.write_text(json.dumps(scenario(tmp_path, {"inputs": {"good.u0": {"udp": port}}}), indent=1))
        with pytest.raises(InputError) as refused:
            cosim.run(path, tmp_path / "o")
    (fault,) = refused.value.faults
    assert (fault.exit_code, fault.line > 1, fault.code) == (2, True, "E-PRT-001")
    assert not (tmp_path / "o").exists() or not [*(tmp_path / "o").iterdir()]


@pytest.mark.parametrize(
    ("live", "words"),
    [
        ({"inputs": {"good.u9": {"udp": 5005}}}, 'no variable "u9"'),
        ({"inputs": {"other.u1": {"udp": 5005}}}, "is connected"),
        ({"inputs": {"good.u0": {"udp": 70000}}}, "it is a port"),
        ({"inputs": {"good.u0": {"udp": True}}}, "it is a port"),
        ({"inputs": {"good.u0": {"udp": "host"}}}, "it is a port"),
        ({"inputs": {"good.u0": {}}}, "one of udp and mqtt"),
        ({"inputs": {"good.u0": {"udp": 5005, "mqtt": "a"}}}, "one of udp and mqtt"),
        ({"inputs": {"good.u0": {"mqtt": "a/#"}}}, "mqtt"),
        ({"outputs": {"good.y7": {"udp": 5005}}}, 'no signal "good.y7"'),
        (
            {"outputs": {"good.y0": {"udp": 5005, "field": "y"}, "good.y1": {"udp": 5005, "field": "y"}}},
            "would both be",
        ),
        ({"lost": 0}, "lost"),
    ],
)
def test_wrong_settings_are_refused(tmp_path: Path, live: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words.replace("?", ".")) as refused:
        cosim.run(scenario(tmp_path, live))
    assert refused.value.exit_code == 2


@contextmanager
def broker(port: int) -> Iterator[subprocess.Popen[bytes]]:
    """A broker on this machine, up when it accepts connections."""
    if MOSQUITTO is None:
        pytest.skip("no MQTT broker (mosquitto)")
    pytest.importorskip("paho.mqtt.client")
    with subprocess.Popen(
        [MOSQUITTO, "-p", str(port)], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    ) as process:
        try:
            for _ in range(100):
                with socket.socket() as probe:
                    if not probe.connect_ex(("127.0.0.1", port)):
                        break
                time.sleep(0.05)
            yield process
        finally:
            process.kill()


def publisher(port: int) -> Callable[[threading.Event], None]:
    def publish(end: threading.Event) -> None:
        from paho.mqtt.client import Client
        from paho.mqtt.enums import CallbackAPIVersion

        client = Client(CallbackAPIVersion.VERSION2)
        client.connect("127.0.0.1", port)
        client.loop_start()
        for k in range(1 << 30):
            if end.is_set():
                break
            client.publish("lab/u0", json.dumps({"u0": k + 1}))
            time.sleep(0.01)
        client.loop_stop()

    return publish


def test_values_arrive_and_leave_by_mqtt_until_the_broker_disappears(tmp_path: Path) -> None:
    port = free_port(socket.SOCK_STREAM)
    live = {
        "inputs": {"good.u0": {"mqtt": "lab/u0"}},
        "outputs": {"good.y0": {"mqtt": "lab/y0"}},
        "broker": port,
        "lost": 0.2,
    }
    with broker(port) as process, partner(publisher(port)):

        class Ending(cosim.master.observer.Observer):  # type: ignore[name-defined, misc]
            def rows(self, time: Any, values: Any) -> None:
                if time[-1] > 1.0:
                    process.kill()

        ran = cosim.run(scenario(tmp_path, live), tmp_path / "o", observers=[Ending()], report=False)
    inputs, outputs = ran.manifest["partners"]
    assert len({*ran["good.u0"]}) > 3
    assert inputs["from"] == "mqtt lab/u0"
    assert inputs["lost"][-1]["to"] == pytest.approx(2.0)
    assert outputs["sent"] > 5
    assert outputs["not_sent"] > 0
    assert len(ran.time) == 101
    repeated(tmp_path)


def test_a_broker_that_is_not_there_is_told(tmp_path: Path) -> None:
    pytest.importorskip("paho.mqtt.client")
    live = {"inputs": {"good.u0": {"mqtt": "lab/u0"}}, "broker": free_port(socket.SOCK_STREAM)}
    with pytest.raises(InputError, match="no MQTT broker at") as refused:
        cosim.run(scenario(tmp_path, live))
    assert refused.value.exit_code == 2


def test_without_paho_one_message_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "paho.mqtt.client", None)
    live = {"inputs": {"good.u0": {"mqtt": "lab/u0"}}}
    with pytest.raises(InputError, match=r"pip install 'fmu-cosim\[mqtt\]'"):
        cosim.run(scenario(tmp_path, live), in_process=True)


def test_functions_set_inputs_and_the_manifest_repeats_them(tmp_path: Path) -> None:
    given = scenario(tmp_path, {})
    seen: list[float] = []

    def twice(time: float, values: Mapping[str, float]) -> float:
        seen.append(values["good.y0"])
        return 2.0 * time

    ran = cosim.run(given, tmp_path / "o", inputs={"good.u0": twice}, report=False)
    assert len({*ran["good.u0"]}) > 3
    assert seen
    assert ran.manifest["changes"]
    repeated(tmp_path)


def test_a_function_for_no_input_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match='no variable "u9"'):
        cosim.run(scenario(tmp_path, {}), inputs={"good.u9": lambda time, values: 1.0})
    with pytest.raises(InputError, match="give a function"):
        cosim.run(scenario(tmp_path, {}), inputs={"good.u0": 3})  # type: ignore[dict-item]


class Switching(Observer):
    """Ends a run when the thermostat has switched the heater on and off, however long this takes."""

    def begin(self, run: ObservedRun) -> None:
        self.place = run.columns.index("oven.power")
        self.seen: list[float] = []

    def rows(self, time: object, values: Array) -> bool:
        for power in values[:, self.place].tolist():
            if [power] != self.seen[-1:]:
                self.seen.append(power)
        return self.seen[-1] == 0.0


@pytest.fixture(scope="module")
def oven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the oven's FMU."""
    folder = tmp_path_factory.mktemp("oven")
    cosim.build(folder, model=f"{EXAMPLES / 'oven.py'}:Oven")
    return folder


def example(name: str, oven: Path) -> str:
    return (EXAMPLES / name).read_text(encoding="utf-8").replace("../../build/oven", str(oven))


def test_the_thermostat_of_the_example_switches_the_heater(oven: Path, tmp_path: Path) -> None:
    ports = free_port(), free_port()
    command = [sys.executable, str(EXAMPLES / "thermostat.py"), str(ports[1]), str(ports[0])]
    observer = Switching()
    with subprocess.Popen(command, stdout=subprocess.PIPE) as thermostat:
        try:
            assert thermostat.stdout is not None
            assert thermostat.stdout.readline().strip() == b"ready"
            text = example("oven_udp.yaml", oven).replace("pace: 10", "pace: 100")
            text = text.replace("udp: 5005", f"udp: {ports[0]}").replace("udp: 5006", f"udp: {ports[1]}")
            (tmp_path / "oven.yaml").write_text(text.replace("2 min", "2 h"), encoding="utf-8")
            ran = cosim.run(tmp_path / "oven.yaml", tmp_path / "o", observers=[observer], report=False)
        finally:
            thermostat.kill()
    assert observer.seen == [600.0, 1500.0, 0.0]  # its own start value, then what the thermostat sent
    off = int(np.argmax(ran["oven.power"] == 0.0))
    assert ran["oven.board"][:off].max() > 342.0  # GOAL + BAND, which the thermostat knows from the run
    assert ran["oven.board"][: off // 2].max() < 342.0
    sent, received = ran.manifest["partners"][1]["sent"], ran.manifest["partners"][0]["messages"]
    assert sent >= received >= 2
    assert [*ran.manifest["timings"]["components"]] == ["oven"]
    cosim.run(tmp_path / "o" / "manifest.json", tmp_path / "again", [f"duration={ran.time[-1]:g}"], report=False)
    assert (tmp_path / "again" / "results.csv").read_bytes() == (tmp_path / "o" / "results.csv").read_bytes()
