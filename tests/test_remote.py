"""FMUs behind `cosim serve`: the same bytes as here, and an answer for everything that can go wrong."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

import cosim
from cosim.base.errors import Crashed, InputError, SimulationError
from cosim.blocks import link, wire
from cosim.blocks.channel import Broken, Channel
from cosim.blocks.link import Control, Session
from cosim.blocks.wire import LinkError, Operation
from cosim.master.master import simulate
from cosim.scenario.scenario_file import ScenarioFile
from cosim.serving.fmu_server import FmuServer, _State, make_key
from cosim.storage.results import Results
from cosim.system.system import build_system
from examples.coupling.build import build_all
from tests.coupled import CHASSIS, LINEAR, TRUCK, WHEEL, coupled_fmu
from tests.native import NEEDS_COMPILER
from tests.walker import walker_fmu, walker_scenario

pytest.importorskip("zmq")
pytest.importorskip("cryptography")
ROOT = Path(__file__).resolve().parents[1]


@contextmanager
def serving(folder: Path, *words: str) -> Iterator[tuple[str, subprocess.Popen[str]]]:
    """Address and process of a server of a folder."""
    command = [sys.executable, "-m", "cosim", "serve", str(folder), *words]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    with subprocess.Popen(command, stdout=pipe, stderr=subprocess.STDOUT, text=True, env=environment) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            match = re.search(r"at ([\d.]+:\d+) for", line)
            assert match, line + process.stdout.read()
            yield match[1], process
        finally:
            process.kill()


@pytest.fixture(scope="module")
def there(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of the server: FMUs of FMI 2.0 and 3.0, with and without texts."""
    folder = tmp_path_factory.mktemp("there")
    walker_scenario(folder, python=True)
    return folder


@pytest.fixture(scope="module")
def at(there: Path) -> Iterator[str]:
    """The address of a server without keys."""
    with serving(there) as (address, _):
        yield address


def small(folder: Path, at: str, fmu: str = "other.fmu", duration: float = 0.1, **more: object) -> Path:
    """A scenario with one FMU of a server."""
    content = {
        "name": "small", "duration": duration, "step": 0.01,
        "components": {"walker": {"fmu": fmu, "at": at, **more}},
    }  # fmt: skip
    path = folder / "small.yaml"
    path.write_text(json.dumps(content))
    return path


def children_of(number: int) -> list[int]:
    """Processes that a process started; skip the test without /proc."""
    tasks = Path(f"/proc/{number}/task")
    if not tasks.exists():
        pytest.skip("no /proc")
    return [int(child) for task in tasks.iterdir() for child in (task / "children").read_text().split()]


def refusal(path: Path) -> InputError:
    with pytest.raises(InputError) as caught:
        cosim.run(path, report=False)
    assert len(caught.value.faults) == 1
    return caught.value


@pytest.mark.parametrize("python", [True, pytest.param(False, marks=pytest.mark.thorough)])
def test_a_run_with_fmus_elsewhere_has_the_same_bytes(there: Path, at: str, tmp_path: Path, python: bool) -> None:
    path = walker_scenario(tmp_path, python=python)
    if not python:  # of the same name, but without texts
        walker_fmu(there / "plain.fmu", saves=False)
    cosim.run(path, tmp_path / "here", report=False)
    text = path.read_text()
    for name in ("saving", "other", "three"):
        file = "plain" if name == "other" and not python else name
        text = text.replace(f"fmu: {name}.fmu", f"fmu: {file}.fmu, at: '{at}'")
        (tmp_path / f"{name}.fmu").unlink()
    path.write_text(text)
    cosim.run(path, tmp_path / "remote", report=False)
    rows = (tmp_path / "here/results.csv").read_bytes()
    assert rows == (tmp_path / "remote/results.csv").read_bytes()
    manifest = json.loads((tmp_path / "remote/manifest.json").read_text())
    component = manifest["scenario"]["components"]["three"]
    assert (component["fmu"], component["at"]) == ("three.fmu", at)
    assert component["sha256"] == wire_sha256(there / "three.fmu")
    cosim.run(tmp_path / "remote/manifest.json", tmp_path / "again", report=False)
    assert rows == (tmp_path / "again/results.csv").read_bytes()


def wire_sha256(path: Path) -> str:
    from cosim.scenario.pinned import sha256

    return sha256(path)


def test_keys_of_both_sides_are_needed(there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    keys = {name: make_key(tmp_path / name) for name in ("server", "friend", "stranger")}
    assert keys["server"][1].stat().st_mode & 0o077 == 0
    clients = tmp_path / "clients"
    clients.mkdir()
    (clients / "friend.key").write_bytes(keys["friend"][0].read_bytes())
    with serving(there, "--key", str(keys["server"][1]), "--clients", str(clients)) as (at, _):
        path = small(tmp_path, at)
        assert "do not match" in str(refusal(path))  # without keys
        for server, client in (("server", "stranger"), ("stranger", "friend")):
            monkeypatch.setenv(wire.SERVER_KEY, str(keys[server][0]))
            monkeypatch.setenv(wire.CLIENT_KEY, str(keys[client][1]))
            error = refusal(path)
            assert "do not match" in str(error)
            assert error.exit_code == 2
        monkeypatch.setenv(wire.SERVER_KEY, str(keys["server"][0]))
        monkeypatch.setenv(wire.CLIENT_KEY, str(keys["friend"][1]))
        assert len(cosim.run(path, report=False).time) == 11
    monkeypatch.setenv(wire.CLIENT_KEY, str(keys["friend"][0]))
    error = refusal(path)
    assert f"{keys['friend'][0]}" in str(error)
    assert "it has no secret key of 40 characters" in str(error)
    assert error.exit_code == 2
    monkeypatch.setenv(wire.CLIENT_KEY, str(keys["friend"][1]))
    keys["friend"][1].chmod(0o644)
    assert "others may read" in str(refusal(path))
    monkeypatch.delenv(wire.CLIENT_KEY)
    assert wire.CLIENT_KEY in str(refusal(path))


def test_another_machine_is_refused_without_keys(there: Path, tmp_path: Path) -> None:
    error = refusal(small(tmp_path, "192.0.2.1:5600"))
    assert error.exit_code == 2
    assert wire.SERVER_KEY in str(error)
    with pytest.raises(InputError, match="a key is needed"):
        FmuServer([there], host="0.0.0.0")


@pytest.mark.parametrize("fmu", ["none.fmu", "../there0/other.fmu", "/etc/passwd", "link.fmu", "walk.yaml"])
def test_only_fmus_within_the_folders_are_offered(there: Path, at: str, tmp_path: Path, fmu: str) -> None:
    link = there / "link.fmu"
    if not link.is_symlink():
        link.symlink_to(walker_fmu(tmp_path / "outside.fmu", saves=False))
    error = refusal(small(tmp_path, at, fmu))
    assert error.exit_code == 2
    assert "other.fmu" in str(error)
    assert "link.fmu," not in str(error)


def test_another_content_or_version_is_named(at: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "another one" in str(refusal(small(tmp_path, at, sha256="0" * 64)))
    monkeypatch.setattr("cosim.blocks.link.VERSION", wire.VERSION + 1)
    error = refusal(small(tmp_path, at))
    assert error.exit_code == 3
    assert "version" in str(error)


def test_a_server_that_is_not_there_and_a_port_in_use(there: Path, tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port = taken.getsockname()[1]
        error = refusal(small(tmp_path, f"127.0.0.1:{port}"))
        assert error.exit_code == 3
        assert "no server answers" in str(error)
        with pytest.raises(InputError, match="in use"):
            FmuServer([there], port=port)


def test_a_server_that_ends_before_it_answers_is_not_waited_for() -> None:
    import zmq

    with zmq.Context() as context, context.socket(zmq.ROUTER) as server:
        port = server.bind_to_random_port("tcp://127.0.0.1")
        with Control(f"127.0.0.1:{port}") as control:
            server.close(0)
            with pytest.raises(LinkError, match="the server has ended") as caught:
                control.ask("open", 3600.0)
    assert caught.value.code == "E-BLK-082"


@pytest.mark.thorough
def test_a_server_that_disappears_leaves_the_rows(there: Path, tmp_path: Path) -> None:
    with serving(there) as (at, process):
        path = small(tmp_path, at, "saving.fmu", 600.0, start={"pause": 1000.0})

        def end(done: int, steps: int) -> None:
            if done > 20:
                process.kill()

        with pytest.raises(Crashed, match="connection to") as caught:
            cosim.run(path, tmp_path / "out", report=False, progress=end)
    assert caught.value.exit_code == 4
    assert len((tmp_path / "out/results.csv").read_text().splitlines()) > 20


def test_a_server_that_stands_still_is_named_once_and_asked_nothing_more(
    there: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two FMUs of one server that is stopped (SIGSTOP) with its processes: one wait, and the rows are kept."""
    monkeypatch.setattr(link, "LIVENESS", 0.2)
    monkeypatch.setattr(link.Control.ask, "__defaults__", (1.0, None))
    asked: list[str] = []
    monkeypatch.setattr(
        Control, "ask", lambda self, do, *a, _ask=Control.ask, **k: asked.append(do) or _ask(self, do, *a, **k)
    )
    with serving(there) as (at, process):
        path = small(tmp_path, at, "saving.fmu", 600.0, start={"pause": 1000.0})
        content = json.loads(path.read_text())
        content["components"]["other"] = content["components"]["walker"]
        path.write_text(json.dumps(content))

        def stop(done: int, steps: int) -> None:
            if done > 20:
                for number in (process.pid, *children_of(process.pid)):
                    os.kill(number, signal.SIGSTOP)

        with pytest.raises(Crashed, match=rf"the server at {at} has not answered for 1 s") as caught:
            cosim.run(path, tmp_path / "out", report=False, progress=stop, in_process=True)
        for number in children_of(process.pid):
            os.kill(number, signal.SIGKILL)
    assert caught.value.exit_code == 4
    assert str(caught.value).count(at) == 1
    assert asked.count("status") == 1
    assert len((tmp_path / "out/results.csv").read_text().splitlines()) > 20


@pytest.mark.thorough
def test_a_crash_there_is_reported_here(there: Path, tmp_path: Path) -> None:
    with serving(there) as (at, process):
        path = small(tmp_path, at, "saving.fmu", 600.0, start={"pause": 1000.0})

        def crash(done: int, steps: int) -> None:
            if done > 20:
                for child in children_of(process.pid):
                    os.kill(child, signal.SIGSEGV)

        with pytest.raises(SimulationError, match="SIGSEGV") as caught:
            cosim.run(path, tmp_path / "out", report=False, progress=crash)
        assert str(caught.value).count(" at t = ") == 1
        assert len(cosim.run(small(tmp_path, at), report=False).time) == 11  # The server goes on.


@pytest.mark.thorough
def test_a_session_ends_with_its_client(there: Path, tmp_path: Path) -> None:
    with serving(there, "--once") as (at, process):
        path = small(tmp_path, at, "saving.fmu", 600.0, start={"pause": 1000.0})
        client = subprocess.Popen(
            [sys.executable, "-m", "cosim", "run", str(path), "--no-report", "--in-process"], cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": str(ROOT)}, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        assert process.stdout is not None
        assert "saving.fmu" in process.stdout.readline()
        time.sleep(2.0)
        client.kill()
        client.wait()
        assert process.wait(100) == 0  # 30 s where the client had not come yet


JOB: dict[str, object] = {
    "fmu": "other.fmu", "sha256": None, "name": "w", "values": {}, "connected": [], "recorded": [],
    "settings": {"way": "co-simulation"},
}  # fmt: skip


def opened(session: Session) -> None:
    session.call(wire.pack(Operation.OPEN, content={"start": 0.0, "stop": 1.0}))


def test_another_peer_neither_holds_nor_ends_a_session(there: Path) -> None:
    with serving(there, "--once") as (at, process):
        session = Session(at, "w", JOB)
        place = session._channel.socket.getpeername()
        peers = [socket.create_connection(place, 5.0) for _ in range(2)]
        peers[0].sendall(b"GET / HTTP/1.1\r\n\r\n")  # names a length that is not allowed
        assert peers[0].recv(1) == b""
        stranger = Channel(peers[1], "0" * 64, is_server=False)
        stranger.send(wire.pack(Operation.OPEN, content={"start": 0.0, "stop": 1.0}))
        with pytest.raises(Broken):  # without the session's key
            stranger.receive()
        opened(session)
        with pytest.raises(ConnectionRefusedError):  # The session has its client.
            socket.create_connection(place, 5.0)
        session.call(wire.pack(Operation.START))
        session._channel.close()  # as a client that is killed
        assert process.wait(20) == 0
        session.close()
        for peer in peers:
            peer.close()


def pair(key: str = "a0" * 32, other: str = "a0" * 32) -> tuple[Channel, Channel]:
    """Both ends of a connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        ends = socket.create_connection(listener.getsockname()), listener.accept()[0]
    return Channel(ends[0], key, is_server=False), Channel(ends[1], other, is_server=True)


@pytest.mark.parametrize("fault", ["changed", "repeated", "other key"])
def test_a_message_that_is_changed_or_repeated_ends_the_connection(fault: str) -> None:
    here, there = pair(other=("a1" if fault == "other key" else "a0") * 32)
    with here.socket, there.socket:
        sent: list[bytes] = []
        here._send = sent.append
        here.send(b"values")
        content = bytearray(sent[0])
        assert b"values" not in content
        if fault == "repeated":
            there._begun += content
            assert there.receive() == b"values"
        content[-1] ^= fault == "changed"
        there._begun += content
        with pytest.raises(Broken, match="changed"):
            there.receive()


def test_long_messages_arrive_in_parts() -> None:
    here, there = pair()
    with here.socket, there.socket:
        message = bytes(range(256)) * 10_000
        thread = threading.Thread(target=here.send, args=(message,))
        thread.start()
        assert there.receive() == message
        thread.join()
        there.most = 1000
        here.send(bytes(1000))
        with pytest.raises(Broken, match="1000 are allowed"):
            there.receive()


def test_a_server_forgets_ended_sessions(there: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cosim.serving.fmu_server.MOST_ENDED", 1)
    with FmuServer([there]) as server:
        server._sessions |= {number: _State("", running=number == -3) for number in range(-3, 1)}
        monkeypatch.setattr(server, "_serve", lambda *_: None)
        server._open(b"", "", JOB)
        assert sorted(server._sessions) == [-3, 0, 1]


@NEEDS_COMPILER
def test_steps_are_taken_back_and_repeated_at_a_server(tmp_path: Path) -> None:
    for name, law in (("a", LINEAR), ("b", LINEAR), ("chassis", CHASSIS), ("wheel", WHEEL)):
        coupled_fmu(tmp_path / f"{name}.fmu", law, slopes=law == LINEAR)
    starts: dict[str, dict[str, float]] = {
        "a": {"p0": 5.0, "p1": 1.0, "late": 1.0},
        "b": {"p0": 1.0},
        "chassis": TRUCK[CHASSIS],
        "wheel": TRUCK[WHEEL],
    }

    def ran(names: tuple[str, str], at: dict[str, str], **more: object) -> Results:
        parts = {name: {"fmu": f"{name}.fmu", "start": starts[name], **at} for name in names}
        one, other = names
        wires = [{"from": f"{one}.y0", "to": f"{other}.u0"}, {"from": f"{other}.y0", "to": f"{one}.u0"}]
        path = tmp_path / "scenario.yaml"
        path.write_text(json.dumps({"name": "s", "components": parts, "connections": wires, **more}))
        file = ScenarioFile(path)
        return simulate(build_system(file), file.scenario.steps, file.scenario.step)

    loop: dict[str, object] = {"duration": 0.3, "step": 0.1}
    truck: dict[str, object] = {"duration": 1.12, "step": {"max": 0.02, "min": 1e-4, "tolerance": 1e-3}}
    with serving(tmp_path) as (at, _):
        for names, more in ((("a", "b"), loop), (("chassis", "wheel"), truck)):
            here, there = ran(names, {}, **more), ran(names, {"at": at}, **more)
            assert here.values.tobytes() == there.values.tobytes()
            assert here.details == there.details
            if names == ("a", "b"):
                assert here.details["loops"][0]["repeated"] == ["a"]
                assert here.details["loops"][0]["derivatives"]["b"] == "directional"
            else:
                assert here.details["steps"]["rejected"] > 0


@NEEDS_COMPILER
def test_the_example_with_a_wheel_behind_a_server_runs(tmp_path: Path) -> None:
    for name in ("coupling", "remote"):
        shutil.copytree(ROOT / "examples" / name, tmp_path / name)
    build_all(tmp_path / "coupling", ("chassis", "wheel"))
    path = tmp_path / "remote" / "truck.yaml"
    with serving(tmp_path / "coupling", "--once") as (at, process):
        path.write_text(path.read_text().replace("127.0.0.1:5600", at))
        ran = cosim.run(path, tmp_path / "out", ["duration=1.5", "step=0.002"], report=False)
        assert process.wait(20) == 0
    assert not ran.missed
    assert ran["wheel.force"].max() > 1000.0


def test_nonsense_is_answered(at: str) -> None:
    with Control(at) as control:
        for do in ("nothing", "open", "describe"):
            with pytest.raises(LinkError, match="does not understand"):
                control.ask(do)
        assert control.ask("status", session=99)["state"] == "unknown"
