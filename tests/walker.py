"""FMUs of C with hidden states, some of which save their state, and scenarios of all that a checkpoint holds."""

from __future__ import annotations

from pathlib import Path

from tests.compiled import library, pack
from tests.decay import decay_fmu

HEAD2 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="walker" guid="g" generationTool="tests">
  <CoSimulation modelIdentifier="walker" canHandleVariableCommunicationStepSize="true" {saves}/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="1" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="y" valueReference="2" causality="output"><Real/></ScalarVariable>
    <ScalarVariable name="gain" valueReference="3" causality="parameter" variability="tunable"><Real start="1"/>
    </ScalarVariable>
    <ScalarVariable name="pause" valueReference="4" causality="parameter" variability="tunable"><Real start="0"/>
    </ScalarVariable>
    <ScalarVariable name="kicks" valueReference="5" causality="local"><Real/></ScalarVariable>
    {mood}
    <ScalarVariable name="limit" valueReference="7" causality="parameter" variability="fixed"><Real start="1e30"/>
    </ScalarVariable>
    <ScalarVariable name="bound" valueReference="8" causality="parameter" variability="fixed"><Real start="0"/>
    </ScalarVariable>
  </ModelVariables>
  <ModelStructure><Outputs><Unknown index="2" dependencies="{feeds}"/>{unknown}</Outputs></ModelStructure>
</fmiModelDescription>
"""
MOOD = (
    '<ScalarVariable name="mood" valueReference="6" causality="output" variability="discrete">'
    "<String/></ScalarVariable>"
)
HEAD3 = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="3.0" modelName="walker" instantiationToken="g" generationTool="tests">
  <CoSimulation modelIdentifier="walker" canHandleVariableCommunicationStepSize="true" {saves}/>
  <ModelVariables>
    <Float64 name="u" valueReference="1" causality="input" start="0"/>
    <Float64 name="y" valueReference="2" causality="output"/>
    <Float64 name="gain" valueReference="3" causality="parameter" variability="tunable" start="1"/>
    <Float64 name="pause" valueReference="4" causality="parameter" variability="fixed" start="0"/>
    <Float64 name="kicks" valueReference="5" causality="local"/>
    <Float64 name="limit" valueReference="7" causality="parameter" variability="fixed" start="1e30"/>
    <Float64 name="bound" valueReference="8" causality="parameter" variability="fixed" start="0"/>
  </ModelVariables>
  <ModelStructure><Output valueReference="2" dependencies=""/></ModelStructure>
</fmiModelDescription>
"""
SAVES = {"2": 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"',
         "3": 'canGetAndSetFMUState="true" canSerializeFMUState="true"'}  # fmt: skip


def walker_fmu(path: Path, *, saves: bool, version: str = "2", mood: bool = False) -> Path:
    """Return an FMU that saves its state, or one that does not and whose output follows its input at once.

    With `mood` it has a text too, which takes the loop of Python.
    """
    more = {
        "feeds": "" if saves else "1",
        "mood": MOOD if mood else "",
        "unknown": '<Unknown index="6" dependencies=""/>' if mood else "",
    }
    description = (HEAD2 if version == "2" else HEAD3).format(saves=SAVES[version] if saves else "", **more)
    return pack(path, description, library(Path(__file__).with_name("walker.c")))


SCENARIO = """name: walk
duration: {duration}
step: 0.01
seed: 4
record: ["*.kicks"]
{checkpoint}
components:
  saving: {{fmu: saving.fmu, start: {{pause: {pause}}}}}
  other: {{fmu: other.fmu}}
  three: {{fmu: three.fmu, step: 0.03}}
{more}
  recording: {{block: playback, file: recording.csv}}
  reference:
    block: reference
    signals: {{r: {{start: 0, changes: [{{at: 0.2, to: 1}}, {{at: 0.5, to: 0, rate: 2}}]}}}}
connections:
  - {{from: other.y, to: saving.u, noise: {{variance: 0.01}}}}
  - {{from: saving.y, to: other.u, noise: {{variance: 0.02, bias: 0.1}}}}
  - {{from: {source}, to: three.u}}
{links}
events:
  - {{at: 0.25, set: {{saving.gain: 1.5}}}}
  - {{at: 0.4, set: {{other.gain: 0.7}}}}
  - {{at: 0.6, set: {{three.gain: 1.2}}}}
faults:
  - {{on: saving.u, kind: delay, delay: 0.07, from: 0.1}}
  - {{on: other.u, kind: dropout, probability: 0.3}}
  - {{on: saving.u, kind: freeze, from: 0.5, to: 0.8}}
"""
SENSOR = "  sensor: {block: fix, rate: 12, latency: 0.05, dropout: 0.2, signals: {y: {noise: {variance: 0.1}}}}\n"
DECAY = "  decay: {fmu: decay.fmu}\n"


def walker_scenario(
    folder: Path, *, python: bool = False, duration: float = 1.0, pause: float = 0.0, checkpoint: str = ""
) -> Path:
    """Return a scenario of FMUs that save their states and FMUs that do not, for FMI 2.0 and 3.0.

    Args:
        python: With a sensor of fixes, texts and model exchange, so that the loop is in Python.
        pause: Wall time of each step [us].
        checkpoint: Wall time between two checkpoints.
    """
    walker_fmu(folder / "saving.fmu", saves=True)
    walker_fmu(folder / "other.fmu", saves=False, mood=python)
    walker_fmu(folder / "three.fmu", saves=True, version="3")
    (folder / "recording.csv").write_text("time,w\n" + "".join(f"{k / 7},{(k * k) % 11}\n" for k in range(100)))
    more = SENSOR + DECAY if python else ""
    links = "  - {from: saving.y, to: sensor.y}\n  - {from: recording.w, to: decay.u}\n" if python else ""
    if python:
        decay_fmu(folder / "decay.fmu")
    text = SCENARIO.format(
        duration=duration,
        pause=pause,
        checkpoint=f"checkpoint: {checkpoint}" if checkpoint else "",
        more=more,
        source="sensor.y_meas" if python else "recording.w",
        links=links,
    )
    path = folder / "walk.yaml"
    path.write_text(text)
    return path
