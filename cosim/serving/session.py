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
from cosim.blocks.wire import HEAD, MOST_VALUES, VERSION, Keys, LinkError, Operation, decode, pack, unpack, zeromq
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
        self._watch = socket.get_monitor_socket(zmq.EVENT_ACCEPTED | zmq.EVENT_DISCONNECTED)
        self.port = self._bind(zmq)
        self._client: int | None = None  # descriptor of the client's connection, once it has opened the session
        self._closed = threading.Event()
        self._block: Any = None
        self._step: Callable[[float, float], None]

    def _bind(self, zmq: Any) -> int:
        first, last = self.job.ports
        for port in range(first, last + 1):
            try:
                self._socket.bind(f"tcp://{self.job.host}:{port or '*'}")
            except zmq.ZMQError:
                continue
            return int(self._socket.last_endpoint.decode().rpartition(":")[2])
        raise LinkError(messages.NO_PORT(first=first, last=last))

    def serve(self) -> None:
        """Answer messages until the session is closed."""
        guarding = threading.Thread(target=self._end_without_client, daemon=True)
        guarding.start()
        socket, is_over = self._socket, False
        while not is_over:
            message = socket.recv() if self._client is not None else self._first_message()
            try:
                is_over = message[1] == Operation.CLOSE
                answer = self._answer(message)
            except Exception as error:
                answer = pack(Operation.ERROR, content=self._about(error))
            if is_over:
                self._closed.set()
            socket.send(answer)
        guarding.join()
        socket.close()
        self._context.destroy(1000)

    def _first_message(self) -> bytes:
        """Return a message before the session is open; remember its connection."""
        frame = self._socket.recv(copy=False)
        self._sender = frame.get(zeromq().SRCFD)
        return bytes(frame.bytes)

    def _end_without_client(self) -> None:
        """End the process when its client is gone, also in a hung FMU.

        Other peers that connect come and go without effect.
        """
        zmq = zeromq()
        from zmq.utils.monitor import recv_monitor_message

        gone: set[int] = set()  # descriptors; one that is used again is not gone
        end = time.monotonic() + OPENING
        while not self._closed.is_set():
            if self._watch.poll(200):
                event = recv_monitor_message(self._watch)
                (gone.add if event["event"] == zmq.EVENT_DISCONNECTED else gone.discard)(event["value"])
            is_alone = time.monotonic() > end if self._client is None else self._client in gone
            if is_alone and not self._closed.wait(0.5):
                here.progress.words = messages.CLIENT_GONE().encode()
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

    def _answer(self, message: bytes) -> bytes:
        version, operation, t, h = HEAD.unpack_from(message)
        if version != VERSION:
            raise LinkError(messages.OTHER_VERSION(here=VERSION, there=version))
        if operation == Operation.OPEN:
            return self._open(decode(message[HEAD.size :]))
        if self._block is None:
            raise LinkError(messages.BAD_REQUEST(reason="the session is not open"))
        if operation == Operation.STEP:
            self._take(message)
            self._step(t, h)
            return self._shown()
        block = self._block
        if operation == Operation.EXCHANGE:
            self._take(message)
            block.put()
            block.get()
            return self._shown()
        if operation == Operation.START:
            block.start()
            self._step = block.stepping(here.progress.doing, 0)
            here.progress.made[0] = 1
            return pack(Operation.TEXT, content="")
        if operation == Operation.CHANGE:
            content = unpack(message, self._inputs, True)
            self._set_exact(content["exact"])
            block.change(content["values"])
            return self._signals()
        if operation == Operation.CLOSE:
            here.progress.doing[0] = OTHER
            block.close()
            return pack(Operation.TEXT, content=list(block.log))
        raise LinkError(messages.BAD_REQUEST(reason=f"operation {operation}"))

    def _open(self, content: Mapping[str, Any]) -> bytes:
        job = self.job
        if self._block is not None or not secrets.compare_digest(str(content["token"]), job.token):
            raise LinkError(messages.BAD_REQUEST(reason="wrong token"))
        self._client = self._sender
        self._block = block = FmuBlock(
            job.name,
            job.path,
            read_description(job.path),
            job.values,
            job.connected,
            recorded=job.recorded,
            compiles=False,
            **job.settings,
        )
        here.share_log(block)
        self._row = (ctypes.c_double * max(1, len(block.inputs) + len(block.outputs)))()
        self._beside: list[Any] = [None] * (len(block.exact_inputs) + len(block.exact_outputs))
        count, self._exact = 8 * len(block.inputs), len(block.exact_inputs)
        self._all = memoryview(self._row).cast("B")[: count + 8 * len(block.outputs)]
        self._inputs, self._outputs = self._all[:count], self._all[count:]
        block.bind(self._row, 0, self._beside, 0)
        block.open(float(content["start"]), float(content["stop"]))
        return self._signals()

    def _take(self, message: bytes) -> None:
        """Write the inputs of a message."""
        exact = unpack(message, self._inputs, bool(self._beside))
        if self._beside:
            self._set_exact(exact)

    def _set_exact(self, exact: Sequence[Any]) -> None:
        if len(exact) != self._exact:
            raise LinkError(messages.BAD_REQUEST(reason="another number of exact values"))
        self._beside[: self._exact] = exact

    def _shown(self) -> bytes:
        """Return the answer with the outputs."""
        return pack(Operation.OUTPUTS, 0.0, 0.0, self._outputs, self._beside[self._exact :] if self._beside else None)

    def _signals(self) -> bytes:
        """Return the answer with inputs and outputs."""
        return pack(Operation.SIGNALS, 0.0, 0.0, self._all, self._beside or None)
