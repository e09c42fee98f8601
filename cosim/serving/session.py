"""A session: one FMU in a process of its own, stepped by messages of its client."""

from __future__ import annotations

import ctypes
import os
import secrets
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, FmuError, SimulationError
from cosim.base.messages import code_of
from cosim.blocks.component import EarlyEnd
from cosim.blocks.description import read_description
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.wire import HEAD, MOST_VALUES, VERSION, Keys, LinkError, Operation, decode, doubles_of, pack, zeromq
from cosim.isolation import worker as here
from cosim.isolation.rows import OTHER
from cosim.serving import messages

OPENING = 30.0  # time [s] for the client to come
BEAT, SILENCE = 2000, 60_000  # interval of heartbeats and time without one that ends a session [ms]
LOST = 3  # exit code of a process that has lost its client


@dataclass(frozen=True)
class SessionJob:
    """A session's FMU, its address and who may connect.

    Attributes:
        ports: First and last port to try; (0, 0) for any free port.
        keys: Keys of the server, None without.
        client: Public key of the client.
        token: Secret that the client must know.
    """

    path: Path
    fmu: str
    name: str
    values: Mapping[str, Any]
    connected: frozenset[str]
    recorded: frozenset[str]
    settings: Mapping[str, Any]
    host: str
    ports: tuple[int, int] = (0, 0)
    keys: Keys | None = None
    client: bytes = b""
    token: str = field(default_factory=lambda: secrets.token_hex(32))


class KnownClients:
    """The clients that may connect, by their public keys in Z85."""

    def __init__(self, keys: Sequence[bytes]) -> None:
        self._keys = frozenset(keys)

    def callback(self, domain: str, key: bytes) -> bool:
        """Return whether a client may connect."""
        return key in self._keys


def guard(context: Any, clients: Sequence[bytes]) -> Any:
    """Start the check of clients' keys in a context."""
    from zmq.auth.thread import ThreadAuthenticator

    check = ThreadAuthenticator(context)
    check.start()
    check.configure_curve_callback(domain="*", credentials_provider=KnownClients(clients))
    return check


def secure(socket: Any, keys: Keys) -> None:
    """Make a socket accept known clients only."""
    socket.curve_server, socket.curve_publickey, socket.curve_secretkey = True, keys.public, keys.secret


# -- in the process of the session --------------------------------------------------------------------

_sessions: list[_Session] = []


def prepare(job: SessionJob) -> int:
    """Listen for the client; return the port."""
    session = _Session(job)
    _sessions.append(session)
    return session.port


def serve() -> None:
    """Obey the client until it closes the session."""
    _sessions[0].serve()


class _Session:
    def __init__(self, job: SessionJob) -> None:
        zmq = zeromq()
        self.job = job
        self._context = context = zmq.Context()
        self._guard = guard(context, [job.client]) if job.keys is not None else None
        self._socket = socket = context.socket(zmq.PAIR)
        socket.linger, socket.maxmsgsize = 1000, MOST_VALUES
        socket.heartbeat_ivl, socket.heartbeat_timeout = BEAT, SILENCE
        if job.keys is not None:
            secure(socket, job.keys)
        self._watch = socket.get_monitor_socket()
        self.port = self._bind(zmq)
        self._opened, self._closed = threading.Event(), threading.Event()
        self._block: Any = None
        self._step: Callable[[float, float], None]

    def _bind(self, zmq: Any) -> int:
        first, last = self.job.ports
        for port in range(first, last + 1):
            try:
                self._socket.bind(f"tcp://{self.job.host}:{port or '*'}")
            except zmq.ZMQError:
                continue
            self._endpoint = self._socket.last_endpoint
            return int(self._endpoint.decode().rpartition(":")[2])
        raise LinkError(messages.NO_PORT(first=first, last=last))

    def serve(self) -> None:
        """Answer messages until the session is closed."""
        guarding = threading.Thread(target=self._end_without_client, daemon=True)
        guarding.start()
        socket, is_over = self._socket, False
        while not is_over:
            frames = socket.recv_multipart()
            try:
                is_over = frames[0][1] == Operation.CLOSE
                answer = self._answer(frames)
            except Exception as error:
                answer = pack(Operation.ERROR, content=self._about(error))
            if is_over:
                self._closed.set()
            socket.send_multipart(answer)
        guarding.join()
        socket.close()
        self._context.destroy(1000)

    def _end_without_client(self) -> None:
        """End the process when its client is gone, also in a hung FMU."""
        zmq = zeromq()
        from zmq.utils.monitor import recv_monitor_message

        count, end = 0, time.monotonic() + OPENING
        while not self._closed.is_set():
            if self._watch.poll(200):
                event = recv_monitor_message(self._watch)["event"]
                count += (event == zmq.EVENT_ACCEPTED) - (event == zmq.EVENT_DISCONNECTED)
                continue
            is_alone = count <= 0 if self._opened.is_set() else time.monotonic() > end
            if is_alone and not self._closed.wait(0.5):
                os._exit(LOST)

    def _about(self, error: Exception) -> dict[str, Any]:
        """Return an error as JSON, without the place of the file."""
        at = getattr(self._block, "instance", None)
        about: dict[str, Any] = {"kind": "simulation", "time": getattr(error, "time", getattr(at, "time", 0.0))}
        text: str = error.reason if isinstance(error, SimulationError) else str(error)
        if isinstance(error, EarlyEnd):
            about |= {"kind": "end", "time": error.reached, "readable": error.readable}
        elif isinstance(error, FmuError):
            about["kind"] = "fmu"
        elif not isinstance(error, CosimError):
            text = messages.UNEXPECTED(error=type(error).__name__, reason=" ".join(text.split())[:500])
        return about | {"text": text.replace(str(self.job.path), self.job.fmu), "code": code_of(text) or code_of(error)}

    def _answer(self, frames: list[bytes]) -> list[bytes]:
        version, operation, t, h = HEAD.unpack_from(frames[0])
        if version != VERSION:
            raise LinkError(messages.OTHER_VERSION(here=VERSION, there=version))
        if operation == Operation.OPEN:
            return self._open(decode(frames[1]))
        if not self._opened.is_set():
            raise LinkError(messages.BAD_REQUEST(reason="the session is not open"))
        if operation == Operation.STEP:
            self._take(frames)
            self._step(t, h)
            return self._outputs()
        block = self._block
        if operation == Operation.EXCHANGE:
            self._take(frames)
            block.put()
            block.get()
            return self._outputs()
        if operation == Operation.START:
            block.start()
            self._step = block.stepping(here.progress.doing, 0)
            here.progress.made[0] = 1
            return pack(Operation.TEXT, content="")
        if operation == Operation.CHANGE:
            content = decode(frames[1])
            self._set(frames[0], content["exact"])
            block.change(content["values"])
            return self._signals()
        if operation == Operation.CLOSE:
            here.progress.doing[0] = OTHER
            block.close()
            return pack(Operation.TEXT, content=list(block.log))
        raise LinkError(messages.BAD_REQUEST(reason=f"operation {operation}"))

    def _open(self, content: Mapping[str, Any]) -> list[bytes]:
        job = self.job
        if self._opened.is_set() or not secrets.compare_digest(str(content["token"]), job.token):
            raise LinkError(messages.BAD_REQUEST(reason="wrong token"))
        self._opened.set()
        self._block = block = FmuBlock(
            job.name, job.path, read_description(job.path), job.values, job.connected,
            recorded=job.recorded, compiles=False, **job.settings,
        )  # fmt: skip
        here.share_log(block)
        self._row = (ctypes.c_double * max(1, len(block.inputs) + len(block.outputs)))()
        self._beside: list[Any] = [None] * (len(block.exact_inputs) + len(block.exact_outputs))
        self._view = memoryview(self._row).cast("B")
        self._count, self._exact = len(block.inputs), len(block.exact_inputs)
        self._end = 8 * (len(block.inputs) + len(block.outputs))
        block.bind(self._row, 0, self._beside, 0)
        block.open(float(content["start"]), float(content["stop"]))
        return self._signals()

    def _take(self, frames: list[bytes]) -> None:
        """Write the inputs of a message."""
        self._set(frames[0], decode(frames[1]) if self._beside else [])

    def _set(self, frame: bytes, exact: Sequence[Any]) -> None:
        self._row[: self._count] = [*doubles_of(frame, self._count)]
        if len(exact) != self._exact:
            raise LinkError(messages.BAD_REQUEST(reason="another number of exact values"))
        self._beside[: self._exact] = exact

    def _outputs(self) -> list[bytes]:
        exact = self._beside[self._exact :] if self._beside else None
        return pack(Operation.OUTPUTS, doubles=self._view[8 * self._count : self._end], content=exact)

    def _signals(self) -> list[bytes]:
        exact = self._beside if self._beside else None
        return pack(Operation.SIGNALS, doubles=self._view[: self._end], content=exact)
