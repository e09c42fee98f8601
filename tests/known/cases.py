"""All cases, by what they are about."""

from __future__ import annotations

from tests.known import couplings, files, interfaces, sources, values

CASES = {
    "source": sources.CASES,
    "coupling": couplings.COUPLING,
    "interface": interfaces.INTERFACE,
    "event": interfaces.EVENT,
    "unit": values.UNIT,
    "type": values.TYPE,
    "step control": couplings.CONTROL,
    "loop": couplings.LOOPS,
    "start time": interfaces.START,
    "multi-rate": couplings.MULTI_RATE,
    "SSP": files.SSP,
    "verb": files.VERB,
}
