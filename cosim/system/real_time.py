"""What ties a run to the world outside: the clock, and partners that send and receive values."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

from cosim.base.errors import Fault
from cosim.scenario.diagnosis import Diagnosis
from cosim.scenario.scenario import Live, LiveValue, Scenario
from cosim.scenario.scenario_file import ScenarioFile
from cosim.storage.yaml_file import did_you_mean
from cosim.system.events import Targets


@dataclass(frozen=True)
class Port:
    """A signal that a partner sets or receives.

    Attributes:
        name: Signal as `component.variable`.
        address: `host:port`, or a topic of the MQTT broker.
        field: Name of the value in a message.
        takes_bare: Whether a message may be the value alone.
        place: Place in the scenario, for faults.
    """

    name: str
    is_mqtt: bool
    address: str
    field: str
    takes_bare: bool
    place: Fault

    @property
    def label(self) -> str:
        """Return the address in words."""
        return f"{'mqtt' if self.is_mqtt else 'udp'} {self.address}"


@dataclass(frozen=True)
class LivePlan:
    """Partners of a run.

    Attributes:
        every: Points between two messages to partners.
        lost: Time without message [s on the clock], after which a partner is lost.
        broker: `host:port` of the MQTT broker.
    """

    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    every: int
    lost: float
    broker: str


@dataclass(frozen=True)
class RealTime:
    """Pace of a run [simulated s/s], None for as fast as possible, and its partners."""

    pace: float | None = None
    live: LivePlan | None = None


def real_time_of(file: ScenarioFile) -> RealTime | None:
    """Return what ties a run to the world outside, if anything."""
    scenario = file.scenario
    if scenario.pace is None and scenario.live is None:
        return None
    return RealTime(scenario.pace, None if scenario.live is None else _plan(file, scenario, scenario.live))


def _plan(file: ScenarioFile, scenario: Scenario, live: Live) -> LivePlan:
    def ports(kind: str, values: Mapping[str, LiveValue]) -> tuple[Port, ...]:
        return tuple(_port(file, ("live", kind, name), name, value) for name, value in values.items())

    every = 1 if live.every is None else max(1, round(live.every / scenario.step))
    return LivePlan(ports("inputs", live.inputs), ports("outputs", live.outputs), every, live.lost, live.broker)


def _port(file: ScenarioFile, where: tuple[str, ...], name: str, value: LiveValue) -> Port:
    address = value.udp if value.udp is not None else str(value.mqtt)
    place = file.fault((*where, "mqtt" if value.udp is None else "udp"), "")
    field = value.field or name.partition(".")[2]
    return Port(name, value.udp is None, address, field, value.field is None, place)


def check_live(
    file: ScenarioFile, targets: Targets, columns: Collection[str], beside: Collection[str], diagnosis: Diagnosis
) -> None:
    """Note faults of inputs and outputs of partners."""
    live = file.scenario.live
    if live is None:
        return
    for kind, values in (("inputs", live.inputs), ("outputs", live.outputs)):
        fields: dict[Any, str] = {}
        for name, value in values.items():
            where = ("live", kind, name)
            if (value.udp is None) == (value.mqtt is None):
                diagnosis.note(where, f"{name} needs one of udp and mqtt")
            if kind == "inputs" and (misfit := targets.objection(name)):
                diagnosis.note(where, misfit)
            elif kind == "outputs" and name not in columns:
                hint = did_you_mean(name, columns)
                message = f"{name} is text or a 64-bit integer; only numbers are sent" if name in beside else None
                diagnosis.note(where, message or f'no signal "{name}"{hint}')
            key = value.udp, value.mqtt, value.field or name.partition(".")[2]
            if kind == "outputs" and (other := fields.setdefault(key, name)) != name:
                diagnosis.note(where, f"{name} and {other} would both be {key[2]} of one message; name their fields")
