"""The protocol between a master and a server of FMUs, its version and its keys.

Control messages are JSON by ZeroMQ with CURVE: describe, open, status. In a session each message is a small head,
doubles, and JSON where doubles do not suffice; a step is one message and its answer (see `cosim.blocks.channel`).
"""

from __future__ import annotations

import json
import os
import stat
import struct
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path
from typing import Any

from cosim.base.errors import CosimError
from cosim.base.extras import optional
from cosim.base.messages import Message

NO_KEY_FILE = "{file} is no key file: {reason}; cosim serve --new-key NAME makes one"

VERSION = 3
LOOPBACK = "127.0.0.1"
CIPHERS = "cryptography.hazmat.primitives.ciphers.aead"
SERVER_KEY, CLIENT_KEY = "COSIM_SERVER_KEY", "COSIM_CLIENT_KEY"  # environment variables with files
MOST_CONTROL, MOST_VALUES = 4_000_000, 64_000_000  # sizes of messages [bytes]
HEAD = struct.Struct("<BBxxxxxxdd")  # version, operation, time [s], length [s]; doubles follow


class Operation(IntEnum):
    """Meaning of a message in a session."""

    OPEN = 1  # JSON: token, start and stop time
    START = 2
    EXCHANGE = 3  # set the inputs, get the outputs
    STEP = 4  # set the inputs, step, get the outputs
    CHANGE = 5  # inputs, and JSON: values of an event
    CLOSE = 6
    SAVE = 7  # save the state to go back to, get its number as JSON
    RESTORE = 8  # JSON: number of a state, and whether it is kept
    FREE = 9  # JSON: number of a state
    SLOPES = 10  # inputs, and JSON: outputs and inputs; get directional derivatives as JSON
    OUTPUTS = 16  # answer with outputs
    SIGNALS = 17  # answer with inputs and outputs
    TEXT = 18  # answer with JSON
    ERROR = 19  # answer with JSON: kind, code and text of an error


class LinkError(CosimError):
    """A server of FMUs that cannot be used.

    Attributes:
        message: Reason and remedy.
        key: Key of the component that is to blame.
    """

    def __init__(self, message: Message, key: str = "at", exit_code: int = 3) -> None:
        super().__init__(message)
        self.message, self.key, self.exit_code = message, key, exit_code

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.message, self.key, self.exit_code)


@dataclass(frozen=True)
class Keys:
    """CURVE keys of one side in Z85; the other side's public key is that of a server."""

    public: bytes
    secret: bytes
    server: bytes = b""


def pack(operation: int, t: float = 0.0, h: float = 0.0, doubles: Any = b"", content: Any = None) -> bytes:
    """Return a message: head, doubles, JSON."""
    message: bytes = HEAD.pack(VERSION, operation, t, h) + doubles
    return message if content is None else message + encode(content)


def unpack(message: bytes, place: memoryview, has_content: bool) -> Any:
    """Write the doubles of a message into their place; return the content behind them.

    Raises:
        ValueError: The message has another number of doubles.
    """
    end = HEAD.size + len(place)
    if len(message) != end and not (has_content and len(message) > end):
        raise ValueError(f"{len(message) - HEAD.size} bytes for {len(place)}")
    place[:] = message[HEAD.size : end]
    return decode(message[end:]) if has_content else None


def encode(content: Any) -> bytes:
    """Return content as JSON; bytes become {"$bytes": hexadecimal}."""
    return json.dumps(content, default=lambda value: {"$bytes": bytes(value).hex()}).encode()


def decode(frame: bytes) -> Any:
    """Return the content of JSON made by `encode`."""
    return json.loads(frame, object_hook=lambda d: bytes.fromhex(d["$bytes"]) if d.keys() == {"$bytes"} else d)


def zeromq(place: str = "at") -> Any:
    """Return the library pyzmq; raise InputError if it or the one of ciphers is not installed."""
    optional(CIPHERS, place)
    return optional("zmq", place)


def split_address(at: str) -> tuple[str, int]:
    """Return host and port."""
    host, _, port = at.rpartition(":")
    return host, int(port)


def read_key(path: Path, *, secret: bool) -> tuple[bytes, bytes]:
    """Return public and secret key of a file; the secret key is empty if not asked for.

    Raises:
        LinkError: The file is no key, or others may read a secret one.
    """
    zeromq(str(path))
    from zmq.auth import load_certificate

    try:
        public, private = load_certificate(path)
        if secret and private and os.name == "posix" and stat.S_IMODE(path.stat().st_mode) & 0o077:
            raise LinkError(f"{path} is a secret key that others may read; chmod 600 {path}", exit_code=2)
    except (OSError, ValueError) as error:
        raise LinkError(NO_KEY_FILE.format(file=path, reason=" ".join(str(error).split())), exit_code=2) from None
    if len(public) != 40 or (secret and len(private or b"") != 40):
        kind = "secret" if secret else "public"
        raise LinkError(NO_KEY_FILE.format(file=path, reason=f"it has no {kind} key of 40 characters"), exit_code=2)
    return public, private or b"" if secret else b""


def client_keys(at: str) -> Keys | None:
    """Return the keys that the environment names for a server, None for a server of this machine without keys.

    Raises:
        LinkError: Keys are missing for another machine, or cannot be read.
    """
    server, own = os.environ.get(SERVER_KEY, ""), os.environ.get(CLIENT_KEY, "")
    if server and own:
        public, secret = read_key(Path(own), secret=True)
        return Keys(public, secret, read_key(Path(server), secret=False)[0])
    if server or own or split_address(at)[0] != LOOPBACK:
        raise LinkError(
            (
                f"{at} is another machine, or keys are given in part: {SERVER_KEY} must name the file of the "
                f"server's public key, {CLIENT_KEY} the file of your secret key (cosim serve --new-key NAME makes "
                "both)"
            ),
            exit_code=2,
        )
    return None
