"""`python -m benchmarks.pace [SECONDS]`: one JSON line on a run at 1 kHz in real time, printed and not judged.

The numbers are those of this machine at this time. Run it on a quiet core, or with priority: `chrt -f 50 python -m …`.
`bare_within_1_ms` is the same for a loop that only waits, made right after.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path

from benchmarks.bench_native import native_scenario
from cosim.isolation.rows import NO_CALL
from cosim.master.pacing import Pacer
from cosim.simulation.workflow import run

H = 0.001


def pace_figures(place: Path, duration: float) -> dict[str, object]:
    """Return overruns and jitter of the native craft loop at 1 kHz."""
    overrides = [f"step={H}", f"duration={duration}", "pace=1", "components.controller.step=0.02"]
    outcome = run(native_scenario(place, 1), place / "run", overrides, report=False)
    pacer, steps = Pacer(1.0, round(duration / H), H, [NO_CALL]), range(round(duration / H) + 1)
    for k in steps:
        pacer.wait(k)
    bare = pacer.record(0.0)["within_1_ms"]
    return {"loop": outcome.manifest["loop"], **outcome.manifest["pacing"], "bare_within_1_ms": bare}


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        print(json.dumps(pace_figures(Path(folder), float([*sys.argv, "20"][1]))))
