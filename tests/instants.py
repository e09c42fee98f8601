"""FMUs of C with event mode, clocks and scheduled execution, which refuse calls that FMI forbids; compiled once."""

from __future__ import annotations

from pathlib import Path

from tests.compiled import library, pack
from tests.corpus.inputs import FMU_SOURCES

HEAD = '<fmiModelDescription fmiVersion="3.0" modelName="instants" instantiationToken="g">'
CO_SIMULATION = (
    '<CoSimulation modelIdentifier="instants" hasEventMode="true" canHandleVariableCommunicationStepSize="{steps}" '
    'canGetAndSetFMUState="{states}" providesIntermediateUpdate="{updates}" '
    'canReturnEarlyAfterIntermediateUpdate="{updates}"/>'
)
SCHEDULED = '<ScheduledExecution modelIdentifier="instants"/>'
REALS = (
    '<Float64 name="time" valueReference="0" causality="independent"/>'
    '<Float64 name="u" valueReference="1" causality="input" start="0"/>'
    '<Float64 name="x" valueReference="2" causality="output"/>'
    '<Float64 name="level" valueReference="3" causality="parameter" variability="fixed" start="1"/>'
    '<Float64 name="floor" valueReference="4" causality="parameter" variability="fixed" start="0"/>'
    '<Float64 name="at" valueReference="5" causality="output" variability="discrete"/>'
    '<Float64 name="delay" valueReference="9" causality="parameter" variability="fixed" start="0.1"/>'
    '<Float64 name="announced" valueReference="10" causality="parameter" variability="fixed" start="0"/>'
    '<Float64 name="own_step" valueReference="11" causality="parameter" variability="fixed" start="0"/>'
    '<Float64 name="rung" valueReference="12" causality="output" variability="discrete"/>'
    '<Float64 name="gain" valueReference="8" causality="parameter" variability="tunable" start="1"/>'
    '<Int32 name="kick" valueReference="20" causality="input" start="0"/>'
    '<Int32 name="events" valueReference="21" causality="output"/>'
    '<Int32 name="timely" valueReference="22" causality="output"/>'
    '<Int32 name="echo" valueReference="23" causality="output"/>'
    '<Int32 name="plus" valueReference="24" causality="parameter" variability="fixed" start="0"/>'
    '<Int32 name="most" valueReference="25" causality="parameter" variability="fixed" start="1000000"/>'
    '<Int32 name="ticks" valueReference="26" causality="output"/>'
    '<Int32 name="triggered" valueReference="27" causality="output"/>'
    '<Int32 name="returns" valueReference="28" causality="output"/>'
    '<Int32 name="order" valueReference="29" causality="output"/>'
)
CLOCKED = (
    '<Float64 name="w" valueReference="6" causality="input" variability="discrete" clocks="40" start="0"/>'
    '<Float64 name="y" valueReference="7" causality="output" variability="discrete" clocks="40"/>'
    '<Clock name="sample" valueReference="40" causality="input" priority="2" {sample}/>'
    '<Clock name="trigger" valueReference="41" causality="input" priority="1" intervalVariability="triggered"/>'
    '<Clock name="crossed" valueReference="42" causality="output" intervalVariability="triggered"/>'
    '<Clock name="alarm" valueReference="43" causality="input" priority="0" intervalVariability="countdown"/>'
)
OUTPUTS = {2: "1", 5: "", 12: "", 21: "", 22: "", 23: "20", 26: "", 27: "", 28: "", 29: ""}
CONSTANT = 'intervalVariability="constant" intervalDecimal="0.1"'


def instants_fmu(
    path: Path,
    sample: str | None = None,
    *,
    scheduled: bool = False,
    steps: bool = True,
    states: bool = False,
    updates: bool = False,
) -> Path:
    """Build the FMU.

    Args:
        sample: XML attributes of the clock `sample`; None for an FMU without clocks.
        scheduled: Whether it is for scheduled execution.
        steps: Whether it takes steps of any length.
        states: Whether it gives its state.
        updates: Whether it calls back during a step.
    """
    flags = {"steps": steps, "states": states, "updates": updates}
    way = SCHEDULED if scheduled else CO_SIMULATION.format(**{k: str(v).lower() for k, v in flags.items()})
    outputs = OUTPUTS | ({} if sample is None else {7: "6 40", 42: ""})
    structure = "".join(f'<Output valueReference="{v}" dependencies="{d}"/>' for v, d in outputs.items())
    clocked = "" if sample is None else CLOCKED.format(sample=sample)
    text = (
        f'<?xml version="1.0" encoding="UTF-8"?>\n{HEAD}{way}<ModelVariables>{REALS}{clocked}</ModelVariables>'
        f"<ModelStructure>{structure}</ModelStructure></fmiModelDescription>"
    )
    return pack(path, text, library(FMU_SOURCES / "instants.c"))
