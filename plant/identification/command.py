"""`cosim identify`: a command that the worked example adds to cosim."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from cosim.core.errors import InputError
from cosim.core.settings import Seed
from cosim.files.files import FilePath
from cosim.files.folders import new_run
from cosim.verbs.cli import files_in, progress_bar, say, say_json, show, warn


def command(
    protocol: Path,
    *,
    out: FilePath | None = None,
    seed: Seed | None = None,
    report: bool = True,
    open: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Identify a power-train, or noise and friction of a craft.

    The protocol names a bench or its recordings, or logs of a craft.
    Writes identify.json, powertrain.yaml or model.yaml, and report.html.

    Args:
        protocol: A protocol: tests on a bench or recordings of them, or logs of a craft.
        out (--out -o PATH): Folder for the results (default: a new number in results/NAME of the protocol).
        seed: Seed for the noise of a simulated bench (default: the seed of the protocol).

    Example: cosim identify examples/bench/protocol.yaml
    """
    from cosim.files.yaml_file import YamlFile
    from plant.identification.workflow import identify as identify_bench

    name = protocol.stem if protocol.is_file() else ""
    with suppress(InputError):  # reported below
        given = YamlFile(protocol).root.get("name")
        name = given if isinstance(given, str) else name
    with new_run(out, name, "cosim identify", force=force) as place, progress_bar() as progress:
        outcome = identify_bench(protocol, place, progress, report=report, seed=seed)
    warn(*outcome.warnings)
    say(*outcome.sentences, outcome.closing(place))
    if report:
        say(f"report: {place / 'report.html'}")
    if json:
        texts = {"sentences": list(outcome.sentences), "closing": outcome.closing(place), "warnings": outcome.warnings}
        say_json({**texts, **files_in(place, "identify.json", "powertrain.yaml", "model.yaml")})
    show(place / "report.html", open)
