"""The connection of a session: sealed messages over TCP, sent and received by the thread that steps.

A message of ZeroMQ passes through a thread of its own on either side; these wake-ups took most of a step's time.
The session's key comes through the control connection, which CURVE encrypts and authenticates.
"""

from __future__ import annotations

import hashlib
import select
import socket
import struct
from contextlib import suppress
from typing import Any

from cosim.base.extras import optional
from cosim.blocks.wire import CIPHERS, MOST_VALUES

SIZE = struct.Struct("<I")  # before each message: its sealed length [bytes]
NONCE = struct.Struct("<Qxxxx")  # number of a message in its direction
CHUNK = 1 << 16  # bytes per call of the system
QUIET, PROBES = 20, 4  # time [s] without a message until the other machine is probed, then each half; failing probes


class Broken(Exception):
    """A connection that has ended, or on which a message was changed; the text is the reason."""


class Channel:
    """A connection whose messages are sealed by ChaCha20-Poly1305.

    There is a key for each direction, derived from that of the session. The nonce counts the messages, so that none can
    be changed, repeated, left out or exchanged with another one.

    Args:
        connection: Connected socket.
        key: Key of the session.
        is_server: Whether this is the side of the server.
        most: Largest size of a message [bytes].
    """

    def __init__(self, connection: socket.socket, key: str, *, is_server: bool, most: int = MOST_VALUES) -> None:
        self.socket, self.most = connection, most
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        _probe(connection)
        to_server, to_client = (_cipher(key, name) for name in (b"to server", b"to client"))
        sealing, opening = (to_client, to_server) if is_server else (to_server, to_client)
        self._seal, self._unseal = sealing.encrypt, opening.decrypt
        self._sent = self._received = 0
        self._begun = bytearray()  # of a message that is not complete yet
        self._send, self._receive = connection.sendall, connection.recv

    def send(self, message: bytes) -> None:
        """Send a message; raise Broken if the connection has ended."""
        sealed = self._seal(NONCE.pack(self._sent), message, None)
        self._sent += 1
        wait = self.socket.gettimeout() if len(sealed) > CHUNK else None
        try:
            if wait:  # A long message may take longer than the wait for an answer.
                self.socket.settimeout(None)
            self._send(SIZE.pack(len(sealed)) + sealed)
            if wait:
                self.socket.settimeout(wait)
        except OSError as error:
            raise _broken(error) from None

    def receive(self) -> bytes:
        """Return the next message.

        Raises:
            Broken: The connection has ended, or a message was changed.
            TimeoutError: The time limit of the socket is over; call again to wait on.
            BlockingIOError: The socket does not block, and the message is not complete.
        """
        begun = self._begun
        while len(begun) < SIZE.size or len(begun) < (end := self._end(begun)):
            try:
                chunk = self._receive(CHUNK)
            except (TimeoutError, BlockingIOError):
                raise
            except OSError as error:
                raise _broken(error) from None
            if not chunk:
                raise Broken("the other side has ended it")
            begun += chunk
        try:
            message: bytes = self._unseal(NONCE.pack(self._received), begun[SIZE.size : end], None)
        except Exception:  # InvalidTag, of the library
            raise Broken("a message was changed on its way") from None
        del begun[:end]
        self._received += 1
        return message

    def _end(self, content: bytearray) -> int:
        """Return the length of a message with its size."""
        end: int = SIZE.size + SIZE.unpack_from(content)[0]
        if end > self.most:
            raise Broken(f"a message has {end} bytes; {self.most} are allowed")
        return end

    def close(self) -> None:
        """Close the connection."""
        self.socket.close()


def has_ended(connection: socket.socket) -> bool:
    """Return whether the other side has ended a connection that nobody reads now."""
    try:
        return has_message(connection) and not connection.recv(1, socket.MSG_PEEK)
    except (OSError, ValueError):
        return True


def has_message(connection: socket.socket) -> bool:
    """Return whether a connection has something to read, its end included."""
    return bool(select.select([connection], [], [], 0)[0])


def _broken(error: OSError) -> Broken:
    return Broken(error.strerror or str(error))


def _cipher(key: str, direction: bytes) -> Any:
    ciphers = optional(CIPHERS, "at")
    return ciphers.ChaCha20Poly1305(hashlib.blake2b(bytes.fromhex(key), digest_size=32, person=direction).digest())


def _probe(connection: socket.socket) -> None:
    """Let the system notice within about a minute that the other machine is gone."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    settings = {"TCP_KEEPIDLE": QUIET, "TCP_KEEPALIVE": QUIET, "TCP_KEEPINTVL": QUIET // 2, "TCP_KEEPCNT": PROBES}
    for name, value in settings.items():
        with suppress(AttributeError, OSError):  # not on every system
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)
