"""A connection to a server of FMUs, from the master's side."""

from __future__ import annotations

import socket
import time
from contextlib import suppress
from typing import Any, ClassVar, Self

from cosim.base.errors import Crashed, FmuError, SimulationError
from cosim.base.messages import Message
from cosim.blocks import messages
from cosim.blocks.channel import Broken, Channel, has_message
from cosim.blocks.component import EarlyEnd
from cosim.blocks.wire import (
    HEAD,
    MOST_VALUES,
    VERSION,
    Keys,
    LinkError,
    Operation,
    client_keys,
    decode,
    encode,
    split_address,
    zeromq,
)

HANDSHAKE_FAILED = (
    "what listens at {at} refuses the connection: it is no server of cosim, or the keys here (COSIM_SERVER_KEY, "
    "COSIM_CLIENT_KEY) and there do not match"
)

CONNECTING, ANSWERING, STARTING = 5.0, 5.0, 60.0  # times [s] for a handshake, an answer, a new process of the server
ERROR = int(Operation.ERROR)
LIVENESS = 1.0  # time [s] without answer after which the server is asked whether the session goes on
GONE = messages.CONNECTION_LOST.code, messages.SERVER_SILENT.code


def _connect(context: Any, at: str, keys: Keys | None) -> tuple[Any, Any]:
    """Return a connected socket and its monitor.

    Raises:
        LinkError: No server answers, or the keys do not match.
    """
    zmq = zeromq()
    from zmq.utils.monitor import recv_monitor_message

    socket = context.socket(zmq.DEALER)
    socket.linger, socket.maxmsgsize, socket.connect_timeout = 0, MOST_VALUES, int(1000 * CONNECTING)
    # A silent server is noticed by its missing answer; the heartbeat ends connections on which nothing is asked.
    socket.heartbeat_ivl, socket.heartbeat_timeout = int(1000 * LIVENESS), int(2000 * ANSWERING)
    if keys is not None:
        socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = keys.public, keys.secret, keys.server
    watch = socket.get_monitor_socket()
    failure, connected, end = (
        f"no server answers at {at}; start one there: cosim serve FOLDER --port PORT",
        False,
        time.monotonic() + CONNECTING,
    )
    try:
        socket.connect(f"tcp://{at}")
        while watch.poll(max(0, int(1000 * (end - time.monotonic())))):
            event = recv_monitor_message(watch)["event"]
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                return socket, watch
            connected = connected or event == zmq.EVENT_CONNECTED
            if event in (zmq.EVENT_CLOSED, zmq.EVENT_DISCONNECTED, *_failures(zmq)):
                break
        else:
            if connected:
                connected, failure = False, f"the server at {at} has not answered for {CONNECTING:g} s"
    except zmq.ZMQError as error:
        failure = f"{at} cannot be used: {error!s}"
    _close(socket, watch)
    if connected:
        raise LinkError(HANDSHAKE_FAILED.format(at=at), exit_code=2)
    raise LinkError(failure)


def _close(socket: Any, watch: Any) -> None:
    socket.disable_monitor()
    watch.close(0)
    socket.close(0)


def _failures(zmq: Any) -> tuple[int, ...]:
    """Return the events of a failed handshake."""
    return (
        zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,
        zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL,
        zmq.EVENT_HANDSHAKE_FAILED_AUTH,
    )


def _connect_session(host: str, port: int) -> socket.socket:
    """Return a connection to a session; raise LinkError if there is none."""
    try:
        return socket.create_connection((host, port), CONNECTING)
    except OSError as error:
        place = f"{host}:{port}"
        raise LinkError(f"{place} cannot be used: {error.strerror or str(error)}") from None


class Control:
    """The control connection to a server; a context manager."""

    def __init__(self, at: str) -> None:
        self.at, self.keys = at, client_keys(at)
        self.context = zeromq().Context()
        try:
            self._socket, self._watch = _connect(self.context, at, self.keys)
        except BaseException:
            self.context.term()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        _close(self._socket, self._watch)
        self.context.term()

    def ask(self, do: str, wait: float = ANSWERING, since: float | None = None, **content: Any) -> dict[str, Any]:
        """Return the server's answer.

        Args:
            wait: Longest time without an answer [s].
            since: Beginning of this time, by the monotonic clock; None for now.

        Raises:
            LinkError: The server refuses, is silent, or has another version of the protocol.
        """
        self._socket.send(encode({"protocol": VERSION, "do": do, **content}))
        end = (time.monotonic() if since is None else since) + wait
        while not self._socket.poll(int(1000 * max(0.0, min(LIVENESS, end - time.monotonic())))):
            if self._has_ended():
                raise LinkError(f"the connection to {self.at} is lost: the server has ended or is out of reach")
            if time.monotonic() >= end:
                raise LinkError(f"the server at {self.at} has not answered for {wait:g} s")
        try:
            answer: dict[str, Any] = decode(self._socket.recv())
            version = answer["protocol"]
        except (ValueError, KeyError, TypeError):
            raise LinkError(HANDSHAKE_FAILED.format(at=self.at), exit_code=2) from None
        if version != VERSION:
            raise LinkError(
                f"the server at {self.at} has version {version} of the protocol, this side version {VERSION}; "
                "install the same cosim on both"
            )
        if (error := answer.get("error")) is not None:
            message = Message(f"{self.at}: {error['text']}", error["code"])
            raise LinkError(message, error.get("key", "at"), error.get("exit_code", 3))
        return answer

    def _has_ended(self) -> bool:
        """Return whether the connection ended since the last call."""
        from zmq.utils.monitor import recv_monitor_message

        events = set()
        while self._watch.poll(0):
            events.add(recv_monitor_message(self._watch)["event"])
        return zeromq().EVENT_DISCONNECTED in events


class Session:
    """A session with one FMU in a process of the server.

    Args:
        name: Component, for messages.
        job: Content of the request to open it.
    """

    _gone: ClassVar[set[str]] = set()  # addresses of servers that have ended or do not answer any more

    def __init__(self, at: str, name: str, job: dict[str, Any]) -> None:
        self.at, self.name, self.time = at, name, 0.0
        self._control = Control(at)
        try:
            opened = self._control.ask("open", STARTING, **job)
            self.number = opened["session"]
            connection = _connect_session(split_address(at)[0], opened["port"])
            self._channel = Channel(connection, opened["token"], is_server=False)
        except BaseException:
            self._control.close()
            raise
        self._gone.discard(at)
        self._channel.socket.settimeout(LIVENESS)
        self._send, self._receive = self._channel.send, self._channel.receive

    def call(self, message: bytes) -> bytes:
        """Send a message; return its answer.

        Raises:
            SimulationError: The FMU failed, its process crashed, or the connection broke.
        """
        try:
            self._send(message)
            while True:
                try:
                    answer = self._receive()
                    break
                except TimeoutError:
                    self._check()
        except Broken as end:
            raise self._end(str(end)) from None
        if len(answer) < HEAD.size or answer[0] != VERSION:
            raise self._lost("its answer has another version")
        if answer[1] == ERROR:
            self._raise(decode(answer[HEAD.size :]))
        return answer

    def _check(self) -> None:
        """Raise Crashed unless the server says that the session goes on."""
        silent_since = time.monotonic() - LIVENESS
        if self._state(silent_since)["state"] != "running" and not has_message(self._channel.socket):
            raise self._end("the server has ended the session")

    def _end(self, reason: str) -> Crashed:
        """Return the error of a session that has ended; the server knows why its process has."""
        end = time.monotonic() + ANSWERING
        while (state := self._state())["state"] == "running" and time.monotonic() < end:
            time.sleep(0.05)
        if ended := state.get("ended"):
            message = Message(f"on {self.at}: {ended['text']}", ended["code"])
            return Crashed(self.name, self.time, message)
        return self._lost(reason)

    def _state(self, since: float | None = None) -> dict[str, Any]:
        try:
            return self._control.ask("status", since=since, session=self.number)
        except LinkError as error:
            if error.message.code in GONE:
                self._gone.add(self.at)
                raise Crashed(self.name, self.time, error.message) from None
            raise self._lost(str(error)) from None

    def _lost(self, reason: str) -> Crashed:
        return Crashed(self.name, self.time, f"the connection to {self.at} is lost: {reason}")

    def _raise(self, error: dict[str, Any]) -> None:
        """Raise the error that an answer reports."""
        message = Message(error["text"], error["code"])
        if error["kind"] == "end":
            raise EarlyEnd(self.name, error["time"], message, readable=error["readable"])
        if error["kind"] == "fmu":
            raise FmuError(message.after(f"{self.name} on {self.at}: "))
        raise SimulationError(self.name, error["time"], message)

    @property
    def is_gone(self) -> bool:
        """Return whether the server does not answer any more."""
        return self.at in self._gone

    def close(self) -> None:
        """Close the connection; the server ends its process."""
        with suppress(Exception):  # A closed socket is closed.
            self._channel.close()
            self._control.close()
