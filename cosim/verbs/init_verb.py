"""`cosim init`: write a first scenario that connects FMUs."""

from __future__ import annotations

from pathlib import Path

from cosim.verbs.cli import say, say_json, warn


def command(fmus: list[Path], *, out: Path = Path("scenario.yaml"), json: bool = False) -> None:
    """Write a first scenario that connects FMUs by name and unit.

    Guessed connections are marked in the file. The scenario runs without changes.

    Args:
        fmus (FMU): FMU of the system.
        out (--out -o PATH): Scenario file; an existing file is not overwritten.

    Example: cosim init plant.fmu controller.fmu --out scenario.yaml
    """
    from cosim.authoring.draft import write_draft
    from cosim.authoring.matching import text
    from cosim.core.text import counted
    from cosim.files.kinds import shell_path

    matches, algorithm, warnings = write_draft(out, fmus)
    if json:
        connections = [
            {"from": text(m.source), "to": text(m.target), "guess": m.guess, "others": m.others}
            for m in matches.connections
        ]
        unconnected = [text(port) for port, _ in matches.unconnected]
        say_json(
            {
                "scenario": str(out),
                "algorithm": algorithm,
                "connections": connections,
                "not_connected": unconnected,
                "choices": dict(matches.choices),
            }
        )
        return
    for m in matches.connections:
        say(f"  {text(m.source)} → {text(m.target)}" + (f"   guess: {m.guess}" if m.guess else ""))
        for other in m.others:
            say(f"      or {other}")
    for name, sources in matches.choices.items():
        say(f"  {name} is left open, for several fit alike: {', '.join(sources)}")
    warn(*warnings)
    guesses, choices = sum(bool(m.guess) for m in matches.connections), matches.choices
    parts = [counted(len(fmus), "FMU"), counted(len(matches.connections), "connection")]
    parts += [f"{guesses} guessed (marked in the file)"] if guesses else []
    parts += [f"{counted(len(choices), 'input')} to choose for (in the file)"] if choices else []
    say(f"wrote {out}: {', '.join(parts)}")
    if matches.connections or not matches.any_candidate:
        say(f"next: cosim run {shell_path(out)}")
    else:
        say(f"next: remove the # before the connections of {out} that you want, then cosim run {shell_path(out)}")
