"""A connection to a server of FMUs, from the master's side."""

from __future__ import annotations

import time
from contextlib import suppress
from typing import Any, Self

from cosim.base.errors import Crashed, FmuError, SimulationError
from cosim.base.messages import Message
from cosim.blocks import messages
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

CONNECTING, ANSWERING, STARTING = 5.0, 5.0, 60.0  # times [s] for a handshake, an answer, a new process of the server
ERROR = int(Operation.ERROR)
LIVENESS = 1000  # time [ms] without answer after which the server is asked whether the session goes on


def connect(context: Any, kind: int, at: str, keys: Keys | None) -> Any:
    """Return a connected socket.

    Raises:
        LinkError: No server answers, or the keys do not match.
    """
    zmq = zeromq()
    from zmq.utils.monitor import recv_monitor_message

    socket = context.socket(kind)
    socket.linger, socket.maxmsgsize, socket.connect_timeout = 0, MOST_VALUES, int(1000 * CONNECTING)
    if keys is not None:
        socket.curve_publickey, socket.curve_secretkey, socket.curve_serverkey = keys.public, keys.secret, keys.server
    watch = socket.get_monitor_socket()
    failure, connected, end = messages.UNREACHABLE(at=at), False, time.monotonic() + CONNECTING
    try:
        socket.connect(f"tcp://{at}")
        while watch.poll(max(0, int(1000 * (end - time.monotonic())))):
            event = recv_monitor_message(watch)["event"]
            if event == zmq.EVENT_HANDSHAKE_SUCCEEDED:
                return socket
            connected = connected or event == zmq.EVENT_CONNECTED
            if event in (zmq.EVENT_CLOSED, zmq.EVENT_DISCONNECTED, *_failures(zmq)):
                break
    except zmq.ZMQError as error:
        failure = messages.UNUSABLE_ADDRESS(at=at, reason=str(error))
    finally:
        socket.disable_monitor()
        watch.close(0)
    socket.close(0)
    if connected:
        raise LinkError(messages.HANDSHAKE_FAILED(at=at), exit_code=2)
    raise LinkError(failure)


def _failures(zmq: Any) -> tuple[int, ...]:
    """Return the events of a failed handshake."""
    return (
        zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL,
        zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL,
        zmq.EVENT_HANDSHAKE_FAILED_AUTH,
    )


class Control:
    """The control connection to a server; a context manager."""

    def __init__(self, at: str) -> None:
        self.at, self.keys = at, client_keys(at)
        zmq = zeromq()
        self.context = zmq.Context()
        try:
            self._socket = connect(self.context, zmq.DEALER, at, self.keys)
        except BaseException:
            self.context.term()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._socket.close(0)
        self.context.term()

    def ask(self, do: str, wait: float = ANSWERING, **content: Any) -> dict[str, Any]:
        """Return the server's answer.

        Raises:
            LinkError: The server refuses, is silent, or has another version of the protocol.
        """
        self._socket.send(encode({"protocol": VERSION, "do": do, **content}))
        if not self._socket.poll(int(1000 * wait)):
            raise LinkError(messages.SERVER_SILENT(at=self.at, wait=wait))
        try:
            answer: dict[str, Any] = decode(self._socket.recv())
            version = answer["protocol"]
        except (ValueError, KeyError, TypeError):
            raise LinkError(messages.HANDSHAKE_FAILED(at=self.at), exit_code=2) from None
        if version != VERSION:
            raise LinkError(messages.OTHER_VERSION(at=self.at, there=version, here=VERSION))
        if (error := answer.get("error")) is not None:
            message = Message(f"{self.at}: {error['text']}", error["code"])
            raise LinkError(message, error.get("key", "at"), error.get("exit_code", 3))
        return answer


class Session:
    """A session with one FMU in a process of the server.

    Args:
        name: Component, for messages.
        job: Content of the request to open it.
    """

    def __init__(self, at: str, name: str, job: dict[str, Any]) -> None:
        self.at, self.name, self.time = at, name, 0.0
        self._control = Control(at)
        zmq = zeromq()
        try:
            opened = self._control.ask("open", STARTING, **job)
            self.number, self.token = opened["session"], opened["token"]
            place = f"{split_address(at)[0]}:{opened['port']}"
            self._socket = connect(self._control.context, zmq.PAIR, place, self._control.keys)
        except BaseException:
            self._control.close()
            raise
        self._socket.rcvtimeo, self._again = LIVENESS, zmq.Again

    def call(self, message: bytes) -> bytes:
        """Send a message of a session and return its answer.

        Raises:
            SimulationError: The FMU failed, its process crashed, or the connection broke.
        """
        socket = self._socket
        socket.send(message)
        while True:
            try:
                answer: bytes = socket.recv()
                break
            except self._again:
                self._check()
        if len(answer) < HEAD.size or answer[0] != VERSION:
            raise self._lost("its answer has another version")
        if answer[1] == ERROR:
            self._raise(decode(answer[HEAD.size :]))
        return answer

    def _check(self) -> None:
        """Raise Crashed unless the server says that the session goes on."""
        try:
            state = self._control.ask("status", session=self.number)
        except LinkError as error:
            raise self._lost(str(error)) from None
        if state["state"] == "running" or self._socket.poll(0):
            return
        if ended := state.get("ended"):
            message = Message(f"on {self.at}: {ended['text']}", ended["code"])
            raise Crashed(self.name, self.time, message)
        raise self._lost("the server has ended the session")

    def _lost(self, reason: str) -> Crashed:
        return Crashed(self.name, self.time, messages.CONNECTION_LOST(at=self.at, reason=reason))

    def _raise(self, error: dict[str, Any]) -> None:
        """Raise the error that an answer reports."""
        message = Message(error["text"], error["code"])
        if error["kind"] == "end":
            raise EarlyEnd(self.name, error["time"], message, readable=error["readable"])
        if error["kind"] == "fmu":
            raise FmuError(message.after(f"{self.name} on {self.at}: "))
        raise SimulationError(self.name, error["time"], message)

    def close(self) -> None:
        """Close the connection; the server ends its process."""
        with suppress(Exception):  # A closed socket is closed.
            self._socket.close(0)
            self._control.close()
