"""Links to partners: datagrams by UDP, and topics of an MQTT broker. Nothing here waits once a link is open."""

from __future__ import annotations

import socket
import threading
from collections import deque
from collections.abc import Collection, Sequence
from contextlib import suppress
from typing import Any

from cosim.partners import messages

MOST = 1000  # messages kept between two looks; the last ones count
LONGEST = 65536  # bytes of a message
PATIENCE = 5.0  # [s] for a broker's answer at the start


class NoLink(Exception):
    """A reason why a link does not open."""


def host_and_port(address: str) -> tuple[str, int]:
    """Return the parts of `host:port`."""
    host, _, port = address.rpartition(":")
    return host.strip("[]"), int(port)


def resolved(address: str) -> tuple[int, Any]:
    """Return the family and the socket address of `host:port`; raise NoLink for an unknown host."""
    host, port = host_and_port(address)
    try:
        found = socket.getaddrinfo(host, port, type=socket.SOCK_DGRAM)
    except (OSError, UnicodeError) as error:  # a label of a host name may be too long
        reason = getattr(error, "strerror", None) or error
        raise NoLink(messages.NO_HOST(address=address, reason=reason)) from None
    family, _, _, _, place = min(found, key=lambda each: each[0] != socket.AF_INET)
    return family, place


class UdpReceiver:
    """Datagrams that arrive at a port of this machine."""

    def __init__(self, address: str) -> None:
        host, port = host_and_port(address)
        self._socket = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise NoLink(messages.NO_PORT(address=address, reason=error.strerror or error)) from None
        self._socket.setblocking(False)

    def receive(self) -> Sequence[bytes]:
        """Return the datagrams since the last call."""
        received: list[bytes] = []
        with suppress(OSError):
            while len(received) < MOST:
                received.append(self._socket.recv(LONGEST))
        return received

    def close(self) -> None:
        """Close the port."""
        self._socket.close()


class UdpSender:
    """Datagrams to an address."""

    def __init__(self, address: str) -> None:
        family, self._address = resolved(address)  # once, since each look-up may wait
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def send(self, content: bytes) -> str:
        """Send a datagram; return the reason if it does not leave, else ""."""
        try:
            self._socket.sendto(content, self._address)
        except OSError as error:
            return str(error.strerror or error)
        return ""

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class Broker:
    """A connection to an MQTT broker, renewed after it is lost."""

    def __init__(self, address: str, topics: Collection[str]) -> None:
        try:
            from paho.mqtt.client import Client
            from paho.mqtt.enums import CallbackAPIVersion
        except ImportError:
            raise NoLink(messages.NO_MQTT()) from None
        self._received: dict[str, deque[bytes]] = {topic: deque(maxlen=MOST) for topic in topics}
        self._answered, self._refusal = threading.Event(), ""
        self._client = client = Client(CallbackAPIVersion.VERSION2)
        client.on_connect, client.on_message = self._connected, self._arrived
        client.reconnect_delay_set(1, 5)
        host, port = host_and_port(address)
        client.connect_timeout = PATIENCE
        try:
            client.connect(host, port)
            client.loop_start()
            if not self._answered.wait(PATIENCE):
                self._refusal = f"no answer within {PATIENCE:g} s"
        except OSError as error:
            self._refusal = str(error.strerror or error)
        if self._refusal:
            self.close()
            raise NoLink(messages.NO_BROKER(address=address, reason=self._refusal))

    def receive(self, topic: str) -> Sequence[bytes]:
        """Return the messages of a topic since the last call."""
        queue, received = self._received[topic], list[bytes]()
        with suppress(IndexError):
            while len(received) < MOST:
                received.append(queue.popleft())
        return received

    def send(self, topic: str, content: bytes) -> str:
        """Publish a message; return the reason if it does not leave, else ""."""
        if not self._client.is_connected():
            return "the broker is gone"
        self._client.publish(topic, content)
        return ""

    def close(self) -> None:
        """Disconnect."""
        self._client.disconnect()
        self._client.loop_stop()

    def _connected(self, client: Any, _data: Any, _flags: Any, reason: Any, _properties: Any) -> None:
        self._refusal = str(reason) if reason.is_failure else ""
        if not reason.is_failure:
            for topic in self._received:
                client.subscribe(topic)
        self._answered.set()

    def _arrived(self, _client: Any, _data: Any, message: Any) -> None:
        queue = self._received.get(message.topic)
        if queue is not None:
            queue.append(bytes(message.payload))
