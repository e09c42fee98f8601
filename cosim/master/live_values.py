"""Values from and to partners outside: received at communication points, recorded as changes, held when lost."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

from cosim.base.errors import InputError, refuse
from cosim.base.text import counted
from cosim.master.inbox import targets_of
from cosim.partners.links import Broker, NoLink, UdpReceiver, UdpSender, resolved
from cosim.scenario.start_values import Misfit
from cosim.system.real_time import LivePlan, Port, RealTime
from cosim.system.system import System

MOST_OUTAGES = 100  # of a partner in the record
LONGEST = 200  # characters of a reason


@dataclass
class Input:
    """An input that a partner sets.

    Attributes:
        heard: Clock [s] of the last valid message, or of the start.
        since: Simulated time [s] of that.
        value: Last value, None before the first.
        outages: Times without message: simulated `from` and `to`, and their length `seconds` on the clock.
        refused: Number of messages refused.
        reason: First reason.
    """

    port: Port
    heard: float
    since: float
    value: Any = None
    messages: int = 0
    outages: list[dict[str, Any]] = field(default_factory=list)
    lost: bool = False
    lost_count: int = 0
    longest: float = 0.0
    refused: int = 0
    reason: str = ""


@dataclass
class Output:
    """A destination of messages with the places of its values in the row."""

    port: Port
    send: Callable[[bytes], str]
    places: Mapping[str, tuple[int, bool]]  # field → place, and whether the value is a whole number
    sent: int = 0
    failed: int = 0
    reason: str = ""


def check_hosts(real_time: RealTime | None) -> None:
    """Raise InputError for hosts without address among the partners that receive datagrams."""
    faults = []
    outputs = () if real_time is None or real_time.live is None else real_time.live.outputs
    for port in (port for port in outputs if not port.is_mqtt):
        try:
            resolved(port.address)
        except NoLink as refusal:
            faults.append(replace(port.place, message=refusal.args[0]))
    refuse(faults)


class LiveValues:
    """Values that a run exchanges with its partners."""

    def __init__(self, system: System, plan: LivePlan, h: float) -> None:
        self._system, self._plan, self._h = system, plan, h
        self._targets = targets_of(system)
        self._stack = ExitStack()
        self._receivers: list[tuple[Callable[[], Sequence[bytes]], list[Input]]] = []
        self._outputs: list[Output] = []
        self._clock = time.perf_counter
        try:
            self._open()
        except BaseException:
            self._stack.close()
            raise

    def _open(self) -> None:
        plan, now = self._plan, self._clock()
        topics = [port.address for port in plan.inputs if port.is_mqtt]
        brokered = next((port for port in (*plan.inputs, *plan.outputs) if port.is_mqtt), None)
        broker = None if brokered is None else self._opened(brokered, partial(Broker, plan.broker, topics))
        for ports in _by_address(plan.inputs):
            first = ports[0]
            if broker is not None and first.is_mqtt:
                receive = partial(broker.receive, first.address)
            else:
                receive = self._opened(first, partial(UdpReceiver, first.address)).receive
            self._receivers.append((receive, [Input(port, now, self._system.start) for port in ports]))
        columns, signals = list(self._system.columns), self._system.signals
        for ports in _by_address(plan.outputs):
            first = ports[0]
            if broker is not None and first.is_mqtt:
                send = partial(broker.send, first.address)
            else:
                send = self._opened(first, partial(UdpSender, first.address)).send
            places = {p.field: (columns.index(p.name), signals[p.name].is_whole) for p in ports}
            self._outputs.append(Output(first, send, places))

    def _opened(self, port: Port, make: Callable[[], Any]) -> Any:
        try:
            link = make()
        except NoLink as refusal:
            raise InputError([replace(port.place, message=refusal.args[0])]) from None
        self._stack.callback(link.close)
        return link

    @property
    def sends(self) -> bool:
        """Return whether outputs are sent to partners."""
        return bool(self._outputs)

    def close(self) -> None:
        """Close all links."""
        self._stack.close()

    def receive(self, k: int) -> Mapping[str, Mapping[str, Any]]:
        """Return the values that are new at point k; others are held."""
        now, t = self._clock(), self._system.start + k * self._h
        changes: dict[str, dict[str, Any]] = {}
        for receive, inputs in self._receivers:
            contents = receive()
            for each in inputs:
                value = self._last_value(each, contents, t) if contents else None
                if value is None:
                    each.lost = each.lost or now - each.heard > self._plan.lost
                    continue
                self._end_outage(each, now, t)
                each.heard, each.since = now, t
                if value != each.value or type(value) is not type(each.value):
                    each.value = value
                    component, _, variable = each.port.name.partition(".")
                    changes.setdefault(component, {})[variable] = value
        return changes

    def send(self, k: int, row: Any) -> None:
        """Send the values of point k."""
        if k % self._plan.every:
            return
        for output in self._outputs:
            values = {name: _json_value(row[place], whole) for name, (place, whole) in output.places.items()}
            content = json.dumps({"time": self._system.start + k * self._h, **values})
            if reason := output.send(content.encode()):
                output.failed, output.reason = output.failed + 1, output.reason or reason
            else:
                output.sent += 1

    def finish(self, k: int) -> None:
        """End the outages that last at point k."""
        now, t = self._clock(), self._system.start + k * self._h
        for each in self._inputs:
            self._end_outage(each, now, t)

    def record(self) -> list[dict[str, Any]]:
        """Return what the partners did, for the manifest."""
        entries: list[dict[str, Any]] = []
        for each in self._inputs:
            entry = {"input": each.port.name, "from": each.port.label, "messages": each.messages}
            entry |= {"lost": each.outages, "refused": each.refused}
            entries.append(entry | ({"refusal": each.reason} if each.reason else {}))
        for output in self._outputs:
            entry = {"outputs": list(output.places), "to": output.port.label, "sent": output.sent}
            entries.append(entry | ({"not_sent": output.failed, "reason": output.reason} if output.failed else {}))
        return entries

    def notes(self) -> list[str]:
        """Return warnings on lost partners and refused messages."""
        notes: list[str] = []
        for each in self._inputs:
            fields = {"input": each.port.name, "partner": each.port.label}
            if each.lost_count:
                first, count = each.outages[0]["from"], counted(each.lost_count, "time")
                times = {"at": first, "longest": each.longest, "limit": self._plan.lost}
                notes.append(
                    (
                        "{input}: no message from {partner} for more than {limit:g} s, {count}, first from t = "
                        "{at:.6g} s on, at longest for {longest:.3g} s; its last value was held"
                    ).format(**fields, **times, count=count)
                )
            if each.refused:
                notes.append(
                    "{input}: {count} messages from {partner} refused and the value held; the first {reason}".format(
                        **fields, count=each.refused, reason=each.reason
                    )
                )
        notes += [f"{o.failed} messages to {o.port.label} not sent: {o.reason}" for o in self._outputs if o.failed]
        return notes

    @property
    def _inputs(self) -> list[Input]:
        return [each for _, inputs in self._receivers for each in inputs]

    def _end_outage(self, each: Input, now: float, t: float) -> None:
        if now - each.heard <= self._plan.lost and not each.lost:
            return
        each.lost, each.lost_count = False, each.lost_count + 1
        each.longest = max(each.longest, now - each.heard)
        if len(each.outages) < MOST_OUTAGES:
            each.outages.append({"from": each.since, "to": t, "seconds": round(now - each.heard, 6)})

    def _last_value(self, each: Input, contents: Sequence[bytes], t: float) -> Any:
        """Return the last valid value among messages; count those refused."""
        last = None
        for content in contents:
            value = self._value(each.port, content)
            if isinstance(value, Misfit):
                each.refused += 1
                each.reason = each.reason or f"at t = {t:.6g} s: {value.reason}"[:LONGEST]
            elif value is not None:
                last, each.messages = value, each.messages + 1
        return last

    def _value(self, port: Port, content: bytes) -> Any:
        """Return the value of a message, a misfit, or None without the field."""
        try:
            written = json.loads(content, parse_constant=_finite, parse_float=_finite)
            if isinstance(written, dict):
                if port.field not in written:
                    return None
                written = written[port.field]
            elif not port.takes_bare:
                return Misfit(f'it is no JSON object with "{port.field}"')
            return self._targets.value(port.name, written)
        except (ValueError, OverflowError, RecursionError, TypeError):
            shown = content[:40].decode("utf-8", "replace")
            return Misfit(f"it is no JSON with finite numbers: {' '.join(shown.split())}")


def _finite(text: str) -> float:
    """Return a finite number; raise ValueError for others."""
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(text)
    return number


def _json_value(value: float, whole: bool) -> float | int | None:
    if not math.isfinite(value):
        return None
    return int(value) if whole else value


def _by_address(ports: Sequence[Port]) -> list[list[Port]]:
    """Return ports grouped by their address, in the order of the first port of each."""
    groups: dict[tuple[bool, Any], list[Port]] = {}
    for port in ports:
        groups.setdefault((port.is_mqtt, port.address), []).append(port)
    return [*groups.values()]
