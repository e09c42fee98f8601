"""A server of FMUs: control messages, and a process for each session."""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Self

from cosim.base.errors import FmuError, InputError, SimulationError
from cosim.base.messages import code_of
from cosim.blocks.wire import (
    CIPHERS,
    LOOPBACK,
    MOST_CONTROL,
    VERSION,
    Keys,
    LinkError,
    decode,
    encode,
    read_key,
    split_address,
    zeromq,
)
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch, fmi_calls
from cosim.serving import messages
from cosim.serving.offer import Offer, invalid
from cosim.serving.session import SessionJob, prepare, serve

MOST_SESSIONS = 16
MOST_ENDED = 16  # ended sessions whose reason is kept for their clients
POLL = 20  # interval [ms] of a look at finished sessions
MODULES = ("cosim.serving.session", "fmpy.fmi2", "fmpy.fmi3", CIPHERS)


@dataclass
class _State:
    """A session of the server: its client, and its end."""

    client: str
    ended: Mapping[str, str] | None = None
    running: bool = True


class KnownClients:
    """The clients that may connect, by their public keys in Z85."""

    def __init__(self, keys: Sequence[bytes]) -> None:
        self._keys = frozenset(keys)

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client may connect."""
        return key in self._keys


def _guard_clients(context: Any, clients: Sequence[bytes]) -> Any:
    """Start the check of clients' keys in a context."""
    from zmq.auth.thread import ThreadAuthenticator

    check = ThreadAuthenticator(context)
    check.start()
    check.configure_curve_callback(domain="*", credentials_provider=KnownClients(clients))
    return check


def _secure(socket: Any, keys: Keys) -> None:
    """Make a socket accept known clients only."""
    socket.curve_server, socket.curve_publickey, socket.curve_secretkey = True, keys.public, keys.secret


class FmuServer:
    """A server on one port; a context manager.

    Args:
        port: Port; 0 for any free one. Sessions have the ports behind it, or any free ones.
        key: File of the server's secret key.
        clients: Folder with the public keys of all clients.

    Raises:
        InputError: A folder, key or port cannot be used.
    """

    def __init__(
        self,
        folders: Sequence[Path],
        *,
        host: str = LOOPBACK,
        port: int = 0,
        key: Path | None = None,
        clients: Path | None = None,
        say: Callable[[str], None] = lambda text: None,
    ) -> None:
        for folder in folders:
            if not folder.is_dir():
                raise InputError.at(folder, messages.NO_FOLDER())
        self.keys, self._known = _read_keys(host, key, clients)
        self.offer, self.host, self._say = Offer(folders), host, say
        zmq = zeromq("cosim serve")
        self._context = zmq.Context()
        self._guard = _guard_clients(self._context, self._known) if self.keys is not None else None
        self._socket = self._context.socket(zmq.ROUTER)
        self._socket.linger, self._socket.maxmsgsize = 1000, MOST_CONTROL
        if self.keys is not None:
            _secure(self._socket, self.keys)
        try:
            self._socket.bind(f"tcp://{host}:{port or '*'}")
        except zmq.ZMQError as error:
            self.close()
            is_used = error.errno == zmq.EADDRINUSE
            text = messages.PORT_REFUSED(host=host, port=port, reason=str(error))
            raise InputError.at(Path("--port"), messages.PORT_IN_USE(port=port) if is_used else text) from None
        place = self._socket.last_endpoint.decode().removeprefix("tcp://")
        self._address, self.port = split_address(place)
        self._ports = (port + 1, port + MOST_SESSIONS) if port else (0, 0)
        self._sessions: dict[int, _State] = {}
        self._numbers = count(1)
        self._answers: queue.SimpleQueue[tuple[bytes, dict[str, Any]]] = queue.SimpleQueue()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop listening. Sessions end with this process."""
        self._socket.close(0)
        if self._guard is not None:
            self._guard.stop()
        self._context.destroy(0)

    def run(self, *, once: bool = False) -> None:
        """Answer requests; with `once`, until the first session has ended."""
        while not (once and self._sessions and not any(s.running for s in self._sessions.values())):
            if self._socket.poll(POLL):
                self._receive()
            while not self._answers.empty():
                sender, answer = self._answers.get()
                self._send(sender, answer)

    def _receive(self) -> None:
        frames = self._socket.recv_multipart(copy=False)
        sender = frames[0].bytes
        client = frames[-1].get("User-Id") if self.keys is not None else ""
        try:
            request = decode(frames[-1].bytes)
            if request["protocol"] != VERSION:
                raise LinkError(messages.OTHER_VERSION(here=VERSION, there=request["protocol"]))
            answer = self._answer(sender, client, request)
        except LinkError as error:
            answer = _about(error)
        except (ValueError, KeyError, TypeError, AttributeError, OSError, RecursionError) as error:
            answer = _about(LinkError(messages.BAD_REQUEST(reason=f"{type(error).__name__} {error}"[:200])))
        if answer is not None:
            self._send(sender, answer)

    def _send(self, sender: bytes, answer: dict[str, Any]) -> None:
        self._socket.send_multipart([sender, encode({"protocol": VERSION, **answer})])

    def _answer(self, sender: bytes, client: str, request: Mapping[str, Any]) -> dict[str, Any] | None:
        do = request["do"]
        if do == "describe":
            return self.offer.describe(str(request["fmu"]), request["sha256"])
        if do == "open":
            self._open(sender, client, request)
            return None
        if do == "status":
            state = self._sessions.get(request["session"])
            if state is None or state.client != client:
                return {"state": "unknown"}
            return {"state": "running" if state.running else "ended", "ended": state.ended}
        raise LinkError(messages.BAD_REQUEST(reason=f"do {do!r}"))

    def _open(self, sender: bytes, client: str, request: Mapping[str, Any]) -> None:
        """Begin a session in a thread; its answer comes when its process listens."""
        running = sum(state.running for state in self._sessions.values())
        if running >= MOST_SESSIONS:
            raise LinkError(messages.BUSY(count=running))
        fmu = str(request["fmu"])
        path, _ = self.offer.find(fmu, request["sha256"])
        job = SessionJob(
            path,
            fmu,
            str(request["name"]),
            dict(request["values"]),
            frozenset(request["connected"]),
            frozenset(request["recorded"]),
            _settings(request["settings"]),
            self._address,
            self._ports,
        )
        ended = [number for number, state in self._sessions.items() if not state.running]
        for number in ended[:-MOST_ENDED]:
            del self._sessions[number]
        number = next(self._numbers)
        self._sessions[number] = state = _State(client)
        threading.Thread(target=self._serve, args=(sender, number, state, job), daemon=True).start()

    def _serve(self, sender: bytes, number: int, state: _State, job: SessionJob) -> None:
        """Hold the process of a session until its end."""
        watch = Watch([job.name], [fmi_calls(None)])
        self._say(f"session {number}: {job.fmu}")
        is_answered = False
        try:
            with Worker(*MODULES) as worker:
                port = worker.call(prepare, job, watch=watch, doing=OTHER)
                self._answers.put((sender, {"session": number, "port": port, "token": job.token}))
                is_answered = True
                worker.call(serve, watch=watch, doing=OTHER)
            self._say(f"session {number}: closed")
        except Exception as error:
            text = error.reason if isinstance(error, SimulationError) else str(error)
            state.ended = {"text": text.replace(str(job.path), job.fmu), "code": code_of(text) or code_of(error)}
            self._say(f"session {number}: {text}")
            if not is_answered:
                refusal = error if isinstance(error, LinkError) else None
                if isinstance(error, FmuError):
                    refusal = invalid(job.fmu, job.path, error)
                text = " ".join(str(error).split())[:500]
                unexpected = LinkError(messages.UNEXPECTED(error=type(error).__name__, reason=text))
                self._answers.put((sender, _about(refusal or unexpected)))
        finally:
            state.running = False


def _about(error: LinkError) -> dict[str, Any]:
    about = {"text": str(error.message), "code": error.message.code, "key": error.key, "exit_code": error.exit_code}
    return {"error": about}


def _settings(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of an FMU that a client may choose; others are dropped."""
    return {key: given.get(key) for key in ("way", "tolerance", "solver")} | {"logging": bool(given.get("logging"))}


def _read_keys(host: str, key: Path | None, clients: Path | None) -> tuple[Keys | None, list[bytes]]:
    """Return the server's keys and the clients' public keys; none for 127.0.0.1 without keys."""
    if key is None and clients is None and host == LOOPBACK:
        return None, []
    if key is None or clients is None:
        raise InputError.at(Path("--key"), messages.NO_KEYS(host=host))
    try:
        keys = Keys(*read_key(key, secret=True))
        known = [read_key(path, secret=False)[0] for path in sorted(clients.glob("*.key"))]
    except LinkError as error:
        raise InputError.at(key, error.message) from None
    if not known:
        raise InputError.at(clients, messages.NO_CLIENTS())
    return keys, known


def make_key(name: Path) -> tuple[Path, Path]:
    """Make the files NAME.key (public) and NAME.key_secret, which only this user can read.

    Raises:
        InputError: One of them is there already, or cannot be written.
    """

    zmq = zeromq("cosim serve")
    public, secret = (name.with_name(f"{name.name}{ending}") for ending in (".key", ".key_secret"))
    for path in (public, secret):
        if path.exists():
            raise InputError.at(path, messages.KEY_EXISTS())
    own, private = zmq.curve_keypair()
    head = f'# CURVE key of cosim\n\nmetadata\ncurve\n    public-key = "{own.decode()}"\n'
    for path, text, mode in ((public, head, 0o644), (secret, f'{head}    secret-key = "{private.decode()}"\n', 0o600)):
        with os.fdopen(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w", encoding="utf-8") as stream:
            stream.write(text)
    return public, secret
