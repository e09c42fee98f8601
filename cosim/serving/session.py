"""A session: one FMU in a process of its own, stepped by messages of its client."""

from __future__ import annotations

import ctypes
import os
import secrets
import select
import socket
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError, FmuError, SimulationError
from cosim.base.messages import code_of
from cosim.blocks.channel import Broken, Channel, has_ended
from cosim.blocks.component import EarlyEnd
from cosim.blocks.description import read_description
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.wire import HEAD, MOST_VALUES, VERSION, LinkError, Operation, decode, pack, unpack
from cosim.isolation import worker as here
from cosim.isolation.rows import OTHER
from cosim.serving import messages

OPENING = 30.0  # time [s] for the client to come
LOOK = 0.5  # interval [s] of a look at the connection
MOST_FIRST, MOST_STRANGERS = 1 << 16, 16  # size of a first message [bytes]; peers that have sent none
MOST_STATES = 100  # saved at once
STEP, CLOSE = int(Operation.STEP), int(Operation.CLOSE)
LOST = 3  # exit code of a process that has lost its client


@dataclass(frozen=True)
class SessionJob:
    """A session's FMU, its address and who may connect.

    Attributes:
        ports: First and last port to try; (0, 0) for any free port.
        token: Key of the session, which only its client receives.
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
    token: str = field(default_factory=lambda: secrets.token_hex(32))


# -- in the process of the session --------------------------------------------------------------------

_sessions: list[_Session] = []


def _end_process() -> None:
    here.progress.words = messages.CLIENT_GONE().encode()
    os._exit(LOST)


def _drop(strangers: list[Channel], peer: Channel) -> None:
    strangers.remove(peer)
    peer.close()


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
        self.job = job
        self._listener = self._bind()
        self.port: int = self._listener.getsockname()[1]
        self._closed = threading.Event()
        self._states: dict[int, Any] = {}  # saved ones by number
        self._numbers = count()
        self._block: Any = None
        self._step: Callable[[float, float], None]

    def _bind(self) -> socket.socket:
        first, last = self.job.ports
        for port in range(first, last + 1):
            with suppress(OSError):
                return socket.create_server((self.job.host, port))
        raise LinkError(messages.NO_PORT(first=first, last=last))

    def serve(self) -> None:
        """Answer messages until the session is closed."""
        try:
            channel, message = self._first_message()
            threading.Thread(target=self._end_without_client, args=(channel.socket,), daemon=True).start()
            is_over = False
            while not is_over:
                try:
                    is_over = message[1] == CLOSE
                    answer = self._answer(message)
                except Exception as error:
                    answer = pack(Operation.ERROR, content=self._about(error))
                if is_over:
                    self._closed.set()
                channel.send(answer)
                message = b"" if is_over else channel.receive()
        except Broken:
            if not self._closed.is_set():
                _end_process()
        else:
            channel.close()

    def _first_message(self) -> tuple[Channel, bytes]:
        """Return the connection of the client and its first message, which proves that it has the session's key.

        Other peers come and go without effect.

        Raises:
            Broken: The client has not come.
        """
        strangers: list[Channel] = []
        end = time.monotonic() + OPENING
        with self._listener as listener:
            while (left := end - time.monotonic()) > 0:
                ready = select.select([listener, *(peer.socket for peer in strangers)], [], [], left)[0]
                for peer in [peer for peer in strangers if peer.socket in ready]:
                    try:
                        message = peer.receive()
                    except (Broken, BlockingIOError) as reason:
                        if isinstance(reason, Broken):
                            _drop(strangers, peer)
                        continue
                    strangers.remove(peer)
                    while strangers:
                        _drop(strangers, strangers[0])
                    peer.socket.setblocking(True)
                    peer.most = MOST_VALUES
                    return peer, message
                if listener in ready:
                    connection, _ = listener.accept()
                    connection.setblocking(False)
                    strangers.append(Channel(connection, self.job.token, is_server=True, most=MOST_FIRST))
                    if len(strangers) > MOST_STRANGERS:
                        _drop(strangers, strangers[0])
        raise Broken("the client has not come")

    def _end_without_client(self, connection: socket.socket) -> None:
        """End the process when its client is gone, also in a hung FMU."""
        while not self._closed.wait(LOOK):
            if has_ended(connection) and not self._closed.wait(LOOK):
                _end_process()

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
        if operation == STEP and self._block is not None:
            self._take(message)
            self._step(t, h)
            return self._shown()
        if operation == Operation.OPEN:
            if self._block is not None:
                raise LinkError(messages.BAD_REQUEST(reason="the session is open"))
            return self._open(decode(message[HEAD.size :]))
        if self._block is None:
            raise LinkError(messages.BAD_REQUEST(reason="the session is not open"))
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
        if operation in (Operation.CHANGE, Operation.SLOPES):
            content = unpack(message, self._inputs, True)
            self._set_exact(content["exact"])
            if operation == Operation.CHANGE:
                block.change(content["values"])
                return self._signals()
            block.put()
            return pack(Operation.TEXT, content=block.slopes(content["outputs"], content["inputs"]))
        if operation in (Operation.SAVE, Operation.RESTORE, Operation.FREE):
            return pack(Operation.TEXT, content=self._keep(operation, decode(message[HEAD.size :] or b"null")))
        if operation == Operation.CLOSE:
            here.progress.doing[0] = OTHER
            block.close()
            return pack(Operation.TEXT, content=list(block.log))
        raise LinkError(messages.BAD_REQUEST(reason=f"operation {operation}"))

    def _keep(self, operation: int, content: Any) -> int | None:
        """Save, restore or free a state; return the number of a saved one."""
        instance = self._block.instance
        if operation == Operation.SAVE:
            if len(self._states) >= MOST_STATES:
                raise LinkError(messages.BAD_REQUEST(reason=f"more than {MOST_STATES} states"))
            number = next(self._numbers)
            self._states[number] = instance.save_state()
            return number
        state = self._states[content["state"]] if content.get("keep") else self._states.pop(content["state"])
        if operation == Operation.FREE:
            instance.free_state(state)
        else:
            instance.restore_state(state, keep=content["keep"])
        return None

    def _open(self, content: Mapping[str, Any]) -> bytes:
        job = self.job
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
        size, self._exact = 8 * len(block.inputs), len(block.exact_inputs)
        self._all = memoryview(self._row).cast("B")[: size + 8 * len(block.outputs)]
        self._inputs, self._outputs = self._all[:size], self._all[size:]
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
