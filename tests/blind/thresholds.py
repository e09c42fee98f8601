"""Thresholds of refine: one table of all, and what twelve blind studies say when one is doubled or halved.

    python -m tests.blind.thresholds table > docs/thresholds.md
    python -m tests.blind.thresholds run results.jsonl     # resumable: what stands in the file is not run again
    python -m tests.blind.thresholds show results.jsonl

A threshold is a number in capitals at the top of a module; the comment beside it says what it means.
"""

from __future__ import annotations

import ast
import importlib
import json
import math
import re
import sys
import tempfile
import tokenize
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import StringIO
from pathlib import Path
from typing import Any

from tests.blind.harness import FIELD, LABORATORY, invent

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("refinement", "estimation", "subject", "logs")
STUDIES = [(LABORATORY, seed) for seed in range(9000, 9006)] + [(FIELD, seed) for seed in range(9000, 9006)]
FACTORS = (0.5, 2.0)
UNKNOWN = "by hand, origin unknown"
ORIGIN = {  # by module and name; what is not here was set by hand, and nobody wrote down why
    "refinement.search.fits.ENTRY": "by hand, beside half of BIC and the logarithm of the number on trial",
    "refinement.search.input_hold.LIKELIER": "Kass and Raftery 1995: 'very strong' evidence",
    "refinement.decision.judgement.SIGNIFICANT": "convention: three standard deviations",
    "refinement.decision.judgement.BETTER": "convention: three times its own scatter",
    "refinement.decision.judgement.WORSE": "convention: three times its own scatter",
    "refinement.decision.evidence.BY_CHANCE": "convention: one false alarm in a hundred",
    "refinement.proof.sealed.CHANCE": "convention: one false alarm in a hundred",
    "refinement.proof.replay_check.PART": "docs/refine_json.md, `grade`: more than a tenth of the excess is left",
    "subject.base_parameters.TOLERANCE": "assumed of a data sheet that states none",
    "subject.base_parameters.WIDTHS": "normal distribution: two standard deviations hold 95 %",
    "logs.channel_noise.NORMAL_95": "normal distribution, 95 %",
}
DECIDING = {  # module below cosim → thresholds that decide a verdict
    "refinement.decision.claims": ("MUCH", "MOVED", "LARGE"),
    "refinement.decision.judgement": (
        "RIVAL", "UNSURE", "SMALL", "NEAR", "SIGNIFICANT", "HELD", "PLAIN", "PLAINLY", "BETTER",
    ),
    "refinement.decision.trust": ("CLEARLY",),
    "refinement.decision.evidence": ("BY_CHANCE",),
    "refinement.proof.replay_check": ("PART", "HALF"),
    "refinement.proof.nearest": ("SIMPLER",),
    "refinement.search.fits": ("ENTRY",),
    "refinement.search.hypotheses": ("NOISE",),
    "refinement.search.attribution": ("HOPE",),
    "subject.base_parameters": ("TOLERANCE",),
}  # fmt: skip


@dataclass(frozen=True)
class Threshold:
    """A number in capitals at the top of a module."""

    module: str
    name: str
    value: float
    meaning: str

    @property
    def decides(self) -> bool:
        """Whether it decides a verdict."""
        return self.name in DECIDING.get(self.module, ())

    @property
    def origin(self) -> str:
        """Where its value comes from."""
        return ORIGIN.get(f"{self.module}.{self.name}", UNKNOWN)


def thresholds() -> Iterator[Threshold]:
    """Every threshold of the rooms, in the order of modules and lines."""
    for room in ROOMS:
        for path in sorted((ROOT / "cosim" / room).rglob("*.py")):
            module = ".".join(path.relative_to(ROOT / "cosim").with_suffix("").parts)
            text = path.read_text(encoding="utf-8")
            comments = {
                t.start[0]: t.string.lstrip("# ") for t in tokenize.generate_tokens(StringIO(text).readline)
                if t.type == tokenize.COMMENT
            }  # fmt: skip
            for node in ast.parse(text).body:
                for name, value in _numbers(node):
                    yield Threshold(module, name, value, _meaning(comments, node))


def _numbers(node: ast.stmt) -> Iterator[tuple[str, float]]:
    """Names in capitals that a statement gives a plain number, with the number."""
    if not isinstance(node, ast.Assign) or len(node.targets) != 1:
        return
    target = node.targets[0]
    several = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple)
    pairs = zip(target.elts, node.value.elts, strict=True) if several else [(target, node.value)]  # type: ignore[union-attr,attr-defined]
    for one, value in pairs:
        try:
            number = ast.literal_eval(value)
        except ValueError:
            continue
        if isinstance(one, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]*", one.id) and type(number) in (int, float):
            yield one.id, number


def _meaning(comments: dict[int, str], node: ast.stmt) -> str:
    """The comment at a statement, or the lines of comment right above it."""
    for line in range(node.lineno, (node.end_lineno or node.lineno) + 1):
        if line in comments:
            return comments[line]
    above, line = [], node.lineno - 1
    while line in comments:
        above.insert(0, comments[line])
        line -= 1
    return " ".join(above)


def table() -> str:
    """The page docs/thresholds.md."""
    lines = [
        "# Thresholds",
        "",
        "Every number by which `cosim refine` and the checks of logs decide, as printed by",
        "`python -m tests.blind.thresholds table`; a test compares the page with the code. The unit stands in brackets",
        "in the meaning; without one the number is a ratio or a count. **Bold** thresholds decide a verdict:",
        "`python -m tests.blind.thresholds run FILE` doubles and halves each over",
        f"{len(STUDIES)} fixed blind studies, and `show FILE` lists what changes.",
        "",
        "| module | name | value | meaning | origin |",
        "|---|---|---|---|---|",
    ]
    for t in thresholds():
        name = f"**`{t.name}`**" if t.decides else f"`{t.name}`"
        lines.append(f"| `{t.module}` | {name} | {t.value:g} | {t.meaning.replace('|', '∣')} | {t.origin} |")
    return "\n".join(lines) + "\n"


@contextmanager
def changed(t: Threshold, factor: float) -> Iterator[None]:
    """Multiply a threshold in its module and wherever it was imported from there by its name."""
    declaring = f"cosim.{t.module}"
    importlib.import_module(declaring)
    line = re.compile(rf"from {re.escape(declaring)} import [^\n]*\b{t.name}\b")
    holders = [m for n, m in list(sys.modules.items()) if n.startswith("cosim.") and _holds(m, t, declaring, line)]
    value = type(t.value)(math.ceil(t.value * factor)) if isinstance(t.value, int) else t.value * factor
    for module in holders:
        setattr(module, t.name, value)
    try:
        yield
    finally:
        for module in holders:
            setattr(module, t.name, t.value)


def _holds(module: Any, t: Threshold, declaring: str, line: re.Pattern[str]) -> bool:
    """Whether a module declares the threshold or imports it by its name."""
    if module.__name__ == declaring:
        return True
    file = getattr(module, "__file__", None)
    return bool(file and hasattr(module, t.name) and line.search(Path(file).read_text(encoding="utf-8")))


def run(results: Path) -> None:
    """Refine every study with every deciding threshold as it is, halved and doubled; append what is new to the file."""
    from cosim.refinement.workflow import refine

    done = {_key(entry) for entry in _entries(results)}
    deciding = [t for t in thresholds() if t.decides]
    cases: list[tuple[Threshold | None, float]] = [(None, 1.0), *((t, f) for t in deciding for f in FACTORS)]
    for t, factor in cases:
        for half, seed in STUDIES:
            entry: dict[str, Any] = {
                "threshold": f"{t.module}.{t.name}" if t else "", "factor": factor, "half": half, "seed": seed,
            }  # fmt: skip
            if _key(entry) in done:
                continue
            with tempfile.TemporaryDirectory() as place:
                study, _ = invent(half, seed, Path(place) / "study")
                if t is None:
                    record = refine(study, Path(place) / "out").record
                else:
                    with changed(t, factor):
                        record = refine(study, Path(place) / "out").record
            entry |= {"verdict": record["verdict"], "grade": record["grade"], "rivals": sorted(record["rivals"])}
            entry |= {"effects": sorted(e["name"] for e in record["effects"])}
            with results.open("a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry) + "\n")


def show(results: Path) -> str:
    """One line for each threshold and factor: how many studies were run, and what became of those that changed."""
    entries = list(_entries(results))
    plain = {(e["half"], e["seed"]): e for e in entries if not e["threshold"]}
    lines = []
    for t in (t for t in thresholds() if t.decides):
        for factor in FACTORS:
            of = [e for e in entries if (e["threshold"], e["factor"]) == (f"{t.module}.{t.name}", factor)]
            compared = [(plain[key], e) for e in of if (key := (e["half"], e["seed"])) in plain]
            other = [f"{e['half']} {e['seed']}: {_said(b)} → {_said(e)}" for b, e in compared if _said(b) != _said(e)]
            lines.append(f"{t.name} × {factor:g} ({len(compared)} studies): {'; '.join(other) or 'nothing changes'}")
    return "\n".join(lines)


def _said(entry: dict[str, Any]) -> str:
    names = entry["effects"] or entry["rivals"]
    return f"{entry['verdict']} [{entry['grade']}] {', '.join(names)}".strip()


def _key(entry: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(entry[name] for name in ("threshold", "factor", "half", "seed"))


def _entries(results: Path) -> Iterator[dict[str, Any]]:
    if results.is_file():
        yield from map(json.loads, results.read_text(encoding="utf-8").splitlines())


def main(arguments: Sequence[str]) -> None:
    """One of `table`, `run FILE`, `show FILE`."""
    if arguments == ["table"]:
        sys.stdout.write(table())
    elif len(arguments) == 2 and arguments[0] == "run":
        run(Path(arguments[1]))
    elif len(arguments) == 2 and arguments[0] == "show":
        print(show(Path(arguments[1])))
    else:
        sys.exit("say one of: table, run FILE, show FILE")


if __name__ == "__main__":
    main(sys.argv[1:])
