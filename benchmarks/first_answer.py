"""Time from two unknown FMUs to three compared runs.

`python -m benchmarks.first_answer [A.fmu B.fmu]` prints every command of the way with its time. Without arguments the
FMUs of the first tutorial are taken, which are built before the clock starts. The page counts as read when a Chromium,
if there is one, has drawn its charts.
"""

from __future__ import annotations

import json
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cosim.files.yaml_file import YamlFile

ROOT = Path(__file__).resolve().parent.parent
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
FACTORS = (1.1, 1.25)  # of the parameter that is varied, in the second and in the third run
REALS = ("Real", "Float64", "Float32")
MOST_COMMANDS, MOST_SECONDS = 10, 300.0


class Way:
    """Commands so far, each with its time."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.seconds: list[float] = []

    def take(self, *words: str) -> str:
        """Run a command and return its output.

        The command is printed with its time; a failure ends the program.
        """
        program = [sys.executable, "-m", "cosim"] if words[0] == "cosim" else [words[0]]
        begin = time.perf_counter()
        environment = {**os.environ, "PYTHONPATH": str(ROOT)}
        done = subprocess.run(
            [*program, *words[1:]], cwd=self.folder, env=environment, capture_output=True, text=True, check=False
        )
        self.seconds.append(time.perf_counter() - begin)
        shown = shlex.join(words if len(words) < 20 else [*words[:6], "…"])
        print(f"{len(self.seconds):2}. {self.seconds[-1]:6.1f} s  {shown}", flush=True)
        if done.returncode:
            sys.exit(f"exit code {done.returncode}\n{done.stdout}{done.stderr}")
        return done.stdout


def first_answer(fmus: Sequence[Path], folder: Path) -> dict[str, Any]:
    """Go the way and return its figures."""
    way = Way(folder)
    about = json.loads(way.take("cosim", "info", *map(str, fmus), "--json"))
    way.take("cosim", "init", *map(str, fmus), "--out", "first.yaml")
    way.take("cosim", "check", "first.yaml")
    way.take("cosim", "run", "first.yaml")
    name, value = _parameter(about, folder / "first.yaml")
    for factor in FACTORS:
        way.take("cosim", "run", "first.yaml", "--set", f"components.{name}={factor * value:g}")
    way.take("cosim", "list")
    way.take("cosim", "compare", "1", "2", "3")
    page = folder / "results" / "runs-1-2-3" / "0001" / "report.html"
    curves = _browse(way, page)
    return {
        "commands": len(way.seconds),
        "seconds": round(sum(way.seconds), 1),
        "curves": curves,
        "varied": name,
        "within": len(way.seconds) <= MOST_COMMANDS and sum(way.seconds) <= MOST_SECONDS,
    }


def _parameter(about: Any, scenario: Path) -> tuple[str, float]:
    """Return the first parameter other than 0.

    The name is COMPONENT.start.NAME; the value comes with it.
    """
    for component, fmu in zip(YamlFile(scenario).root["components"], about, strict=True):
        for variable in fmu["variables"]:
            if variable["causality"] == "parameter" and variable["type"] in REALS and float(variable["start"] or 0):
                return f"{component}.start.{variable['name']}", float(variable["start"])
    sys.exit("no FMU has a parameter with a start value")


def _browse(way: Way, page: Path) -> int | None:
    """Return the number of curves in a browser.

    It is None without a browser.
    """
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        print("    no Chromium here: the page is written, and not opened")
        return None
    with tempfile.TemporaryDirectory() as profile:
        options = ["--headless", "--no-sandbox", "--disable-gpu", f"--user-data-dir={profile}", "--dump-dom"]
        return way.take(browser, *options, page.as_uri()).count("data-line=")


def tutorial_fmus(folder: Path) -> list[Path]:
    """Build the FMUs of the first tutorial."""
    build = "import sys; from pythonfmu.__main__ import cli_main; cli_main()"
    for slave in ("tank", "level_control"):
        file = ROOT / "examples" / "tanks" / f"{slave}.py"
        command = [sys.executable, "-c", build, "build", "-f", str(file), "--dest", str(folder)]
        subprocess.run(command, check=True, capture_output=True)
    return [folder / "Tank.fmu", folder / "Controller.fmu"]


def main() -> None:
    """Print the figures as one JSON line."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        fmus = [Path(word).resolve() for word in sys.argv[1:]] or tutorial_fmus(folder)
        outcome = first_answer(fmus, folder)
    print(json.dumps(outcome))
    sys.exit(not outcome["within"])


if __name__ == "__main__":
    main()
