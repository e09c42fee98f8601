"""FMUs of C that integrate inputs, x' = u + w, with an output that follows them, y = x + u + w; compiled once."""

from __future__ import annotations

import zipfile
from pathlib import Path

from tests.compiled import library

WAYS = {
    "cs": '<CoSimulation modelIdentifier="follow" canHandleVariableCommunicationStepSize="true" {saves}/>',
    "me": '<ModelExchange modelIdentifier="follow" completedIntegratorStepNotNeeded="true"/>',
}
SAVES = 'canGetAndSetFMUstate="true" canSerializeFMUstate="true"'
FOLLOWS = {"declared": ' dependencies="1 4"', "measured": "", "none": None}  # dependencies of y; None for no y
OUTPUT = '<ScalarVariable name="y" valueReference="2" causality="output"><Real/></ScalarVariable>'
WHOLE = (
    '<ScalarVariable name="n" valueReference="4" causality="input" variability="discrete"><Integer start="0"/>'
    "</ScalarVariable>"
    '<ScalarVariable name="m" valueReference="5" causality="output" variability="discrete"><Integer/></ScalarVariable>'
)
DESCRIPTION = """<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="follow" guid="g" generationTool="tests" numberOfEventIndicators="0">
  {way}
  <DefaultExperiment startTime="0" stopTime="2" stepSize="0.1"/>
  <ModelVariables>
    <ScalarVariable name="u" valueReference="0" causality="input"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="x" valueReference="1" causality="output" initial="exact"><Real start="0"/></ScalarVariable>
    <ScalarVariable name="der(x)" valueReference="3" causality="local"><Real derivative="2"/></ScalarVariable>
    <ScalarVariable name="w" valueReference="6" causality="input"><Real start="0"/></ScalarVariable>
    {more}
  </ModelVariables>
  <ModelStructure>
    <Outputs><Unknown index="2" dependencies=""/>{outputs}</Outputs>
    <Derivatives><Unknown index="3"/></Derivatives>
    <InitialUnknowns><Unknown index="3"/>{initial}</InitialUnknowns>
  </ModelStructure>
</fmiModelDescription>
"""


def follow_fmu(
    path: Path, way: str = "cs", follows: str = "declared", *, saves: bool = True, whole: bool = False
) -> Path:
    """Return an FMU.

    Args:
        way: cs or me.
        follows: Whether the dependency of y on u and w is declared, to be measured, or there is no y.
        saves: Whether it saves its state.
        whole: Whether it has an integer input n and output m.
    """
    dependencies = FOLLOWS[follows]
    has_y = dependencies is not None
    unknowns = [f'<Unknown index="5"{dependencies}/>'] if has_y else []
    unknowns += [f'<Unknown index="{5 + has_y + 1}"/>'] if whole else []
    description = DESCRIPTION.format(
        way=WAYS[way].format(saves=SAVES if saves else ""),
        more=(OUTPUT if has_y else "") + (WHOLE if whole else ""),
        outputs="".join(unknowns),
        initial="".join(u.split(" dep")[0].rstrip("/>") + "/>" for u in unknowns),
    )
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", description)
        archive.write(library(Path(__file__).with_name("follow.c")), "binaries/linux64/follow.so")
    return path
