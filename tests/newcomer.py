"""How long from FMUs of others to a report: python -m tests.newcomer A.fmu B.fmu"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path


def main() -> int:
    """`cosim init` and `cosim run` in an empty folder; a line of JSON: exporters, connections, seconds, pages."""
    fmus = [str(Path(name).resolve()) for name in sys.argv[1:]]
    cosim, seconds = [sys.executable, "-m", "cosim"], {}
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parent.parent)}
    with tempfile.TemporaryDirectory(prefix="newcomer-") as folder:
        for verb, arguments in (("init", fmus), ("run", ["scenario.yaml", "--out", "results"])):
            began = time.perf_counter()
            done = subprocess.run(
                [*cosim, verb, *arguments, "--json"], cwd=folder, env=environment, capture_output=True, text=True
            )
            seconds[verb] = round(time.perf_counter() - began, 2)
            if done.returncode:
                print(done.stderr, file=sys.stderr)
                return done.returncode
            made = json.loads(done.stdout)
        page = (Path(folder) / "results" / "report.html").stat().st_size
        drafted = (Path(folder) / "scenario.yaml").read_text(encoding="utf-8")
    seconds["all"] = round(sum(seconds.values()), 2)
    about = [line.partition("# ")[2] for line in drafted.splitlines() if line.startswith("  ") and ", FMI " in line]
    links = [line.strip("- ") for line in drafted.splitlines() if line.startswith("  - {from")]
    print(json.dumps({"fmus": about, "connections": links, "seconds": seconds, "rows": made["rows"], "report": page}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
