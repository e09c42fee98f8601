"""Thresholds of refine: a table, and the effect of doubling or halving each on twelve blind studies.

    python -m tests.blind.thresholds table > docs/thresholds.md
    python -m tests.blind.thresholds run results.jsonl     # resumable: results in the file are not repeated
    python -m tests.blind.thresholds show results.jsonl

A threshold is a number in capitals at the top of a module; the comment beside it states its meaning.
"""

from __future__ import annotations

import ast
import hashlib
import importlib
import json
import math
import operator
import pickle
import re
import sys
import tempfile
import tokenize
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, fields
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np

import cosim.refinement.workflow
from cosim.estimation import fit as estimation
from cosim.estimation.problem import Problem
from tests.blind.harness import FIELD, LABORATORY, invent

ROOT = Path(__file__).resolve().parents[2]
ROOMS = ("refinement", "estimation", "subject", "logs")
STUDIES = [(LABORATORY, seed) for seed in range(9000, 9006)] + [(FIELD, seed) for seed in range(9000, 9006)]
FACTORS = (0.5, 2.0)
UNKNOWN = "by hand, origin unknown"
ORIGIN = {  # by module and name; what is not here was set by hand, and nobody wrote down why
    "refinement.search.fits.ENTRY": "by hand, beside half of BIC and the logarithm of the number on trial",
    "refinement.search.input_hold.LIKELIER": "Kass and Raftery 1995: 'very strong' evidence",
    "refinement.decision.equivalence.NIL": "between twins (5e-5 left) and the nearest other pair (3e-2), enlarged",
    "refinement.decision.constancy.VARIES": "chosen before the first study with this test",
    "refinement.search.hypotheses.MAX_HALVED_RATIO": "what is asked of refine: half the held-out error",
    "refinement.decision.judgement.SIGNIFICANT": "convention: three standard deviations",
    "refinement.decision.judgement.BETTER": "convention: three times its own scatter",
    "refinement.decision.judgement.WORSE": "convention: three times its own scatter",
    "refinement.decision.evidence.BY_CHANCE": "convention: one false alarm in a hundred",
    "refinement.search.periods.LASTING": "as the least rows of a block of evidence; 40 show the same lines",
    "refinement.search.periods.DRAWS": "by hand: a mean of 16 spectra is within a quarter of its expectation",
    "refinement.search.periods.OFF": "sinc²(½), the power of a line half a cycle off",
    "refinement.proof.sealed.CHANCE": "convention: one false alarm in a hundred",
    "refinement.proof.replay_check.PART": "docs/refine_json.md, `grade`: more than a tenth of the excess is left",
    "subject.base_parameters.TOLERANCE": "assumed of a data sheet that states none",
    "subject.base_parameters.WIDTHS": "normal distribution: two standard deviations hold 95 %",
    "estimation.growing.GROWTH": "simulated pendulums: of ten, 2 ended in a local optimum, 1 with 1.25, 4 with 2",
    "logs.channel_noise.NORMAL_95": "normal distribution, 95 %",
}
DECIDING = {  # module below cosim → thresholds that decide a verdict
    "refinement.decision.constancy": ("VARIES",),
    "refinement.decision.equivalence": ("NIL",),
    "refinement.search.resemblance": ("LIKE",),
    "refinement.decision.claims": ("MUCH", "MOVED", "LARGE"),
    "refinement.decision.judgement": ("RIVAL", "NEAR", "SIGNIFICANT", "PLAIN", "PLAINLY", "BETTER"),
    "refinement.decision.trust": ("CLEARLY",),
    "refinement.decision.evidence": ("BY_CHANCE",),
    "refinement.proof.replay_check": ("PART", "HALF", "UNSURE"),
    "refinement.proof.nearest": ("SIMPLER",),
    "refinement.search.fits": ("ENTRY",),
    "refinement.search.hypotheses": ("NOISE", "MAX_HALVED_RATIO"),
    "refinement.search.attribution": ("HOPE",),
    "subject.base_parameters": ("TOLERANCE",),
    "estimation.predictability": ("FAR", "NEAR", "EXPONENTIAL"),
}  # fmt: skip

NOT_COMPARED = ("subject.base_parameters.TOLERANCE",)  # it goes into arrays: each of its cases is refined


@dataclass(frozen=True)
class Threshold:
    """A named number in capitals at the top of a module."""

    module: str
    name: str
    value: float
    meaning: str

    @property
    def decides(self) -> bool:
        """Return whether a verdict depends on the threshold: its name is in DECIDING."""
        return self.name in DECIDING.get(self.module, ())

    @property
    def key(self) -> str:
        """Return `module.NAME`."""
        return f"{self.module}.{self.name}"

    @property
    def origin(self) -> str:
        """Return the source of the value, such as a reference or a convention; UNKNOWN without one."""
        return ORIGIN.get(self.key, UNKNOWN)


def thresholds() -> Iterator[Threshold]:
    """Yield every threshold of the rooms, in the order of modules and lines."""
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
    """Yield name and value of each number in capitals assigned by a statement."""
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
    """Return the comment at a statement, or the comment lines above it."""
    for line in range(node.lineno, (node.end_lineno or node.lineno) + 1):
        if line in comments:
            return comments[line]
    above, line = [], node.lineno - 1
    while line in comments:
        above.insert(0, comments[line])
        line -= 1
    return " ".join(above)


def table() -> str:
    """Return the page docs/thresholds.md."""
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
    """Multiply a threshold in its module and in all modules that import it by name, within a `with` block."""
    with replaced(t, multiplied(t, factor)):
        yield


def multiplied(t: Threshold, factor: float) -> float:
    """Return the value of a threshold times a factor; a count is rounded up."""
    return math.ceil(t.value * factor) if isinstance(t.value, int) else t.value * factor


@contextmanager
def replaced(t: Threshold, value: Any) -> Iterator[None]:
    """Replace a threshold in its module and in all modules that import it by name, within a `with` block."""
    declaring = f"cosim.{t.module}"
    importlib.import_module(declaring)
    line = re.compile(rf"from {re.escape(declaring)} import [^\n]*\b{t.name}\b")
    holders = [m for n, m in list(sys.modules.items()) if n.startswith("cosim.") and _holds(m, t, declaring, line)]
    for module in holders:
        setattr(module, t.name, value)
    try:
        yield
    finally:
        for module in holders:
            setattr(module, t.name, t.value)


def _holds(module: Any, t: Threshold, declaring: str, line: re.Pattern[str]) -> bool:
    """Return whether a module declares the threshold or imports it by name."""
    if module.__name__ == declaring:
        return True
    file = getattr(module, "__file__", None)
    return bool(file and hasattr(module, t.name) and line.search(Path(file).read_text(encoding="utf-8")))


Case = tuple[str, float]  # name of a threshold, with its module, and factor


class Watched:
    """A number that depends on thresholds, with its plain value and its value in each case of a changed threshold.

    Comparisons use the plain value and note the cases with a different result; a conversion to float notes all cases.
    Without a note, a refinement gives the same result in a case as with unchanged thresholds.
    """

    def __init__(self, plain: float, cases: Mapping[Case, Any], noted: set[Case]) -> None:
        self.plain, self.cases, self.noted = plain, cases, noted

    def _calculated(self, operation: Callable[..., Any], *operands: Any) -> Watched:
        of = {case for operand in operands if isinstance(operand, Watched) for case in operand.cases}
        cases = {case: operation(*(_in(operand, case) for operand in operands)) for case in of}
        return Watched(operation(*(_in(operand, None) for operand in operands)), cases, self.noted)

    def _compared(self, operation: Callable[..., Any], *operands: Any) -> Any:
        result = self._calculated(operation, *operands)
        self.noted |= {case for case, value in result.cases.items() if np.any(value != result.plain)}
        return result.plain

    def __float__(self) -> float:
        self.noted |= set(self.cases)
        return float(self.plain)

    def __array_ufunc__(self, function: np.ufunc, method: str, *operands: Any, **named: Any) -> Any:
        def operation(*values: Any) -> Any:
            return getattr(function, method)(*values, **named)

        compares = function in (np.less, np.less_equal, np.greater, np.greater_equal, np.equal, np.not_equal)
        return (self._compared if compares else self._calculated)(operation, *operands)


def _in(operand: Any, case: Case | None) -> Any:
    return operand.cases.get(case, operand.plain) if isinstance(operand, Watched) else operand


def _add_operators() -> None:
    for f in (operator.add, operator.sub, operator.mul, operator.truediv, operator.pow):
        setattr(Watched, f"__{f.__name__}__", lambda self, other, f=f: self._calculated(f, self, other))
        setattr(Watched, f"__r{f.__name__}__", lambda self, other, f=f: self._calculated(f, other, self))
    for f in (operator.neg, operator.abs):
        setattr(Watched, f"__{f.__name__}__", lambda self, f=f: self._calculated(f, self))
    for f in (operator.lt, operator.le, operator.gt, operator.ge, operator.eq, operator.ne):
        setattr(Watched, f"__{f.__name__}__", lambda self, other, f=f: self._compared(f, self, other))


_add_operators()


class Fits:
    """Cache of the fits of a study; fits do not read thresholds that decide a verdict."""

    def __init__(self) -> None:
        self.fit = estimation.fit
        self.known: dict[bytes, estimation.Fit] = {}

    def __call__(self, problem: Problem, *args: Any, **named: Any) -> estimation.Fit:
        """Return the fit for these arguments."""
        stated = [getattr(problem, f.name) for f in fields(problem) if f.name not in ("kernel", "ranges")]
        library = problem.kernel._library._name  # type: ignore[attr-defined]  # named by its source
        plain = [_in(value, None) for value in args], {name: _in(value, None) for name, value in named.items()}
        key = hashlib.sha256(pickle.dumps((library, stated, plain))).digest()
        if key not in self.known:
            self.known[key] = self.fit(problem, *args, **named)
        return self.known[key]


def run(results: Path) -> None:
    """Refine every study with every deciding threshold unchanged, halved and doubled; append new results to the file.

    Only cases with a changed comparison are refined again; all others have the unchanged result.
    """
    done = {_key(entry): entry for entry in _entries(results)}
    deciding = [t for t in thresholds() if t.decides]
    for half, seed in STUDIES:
        with tempfile.TemporaryDirectory() as place:
            study, _ = invent(half, seed, Path(place) / "study")
            fits, noted = Fits(), set[Case]()
            plain = _entry(half, seed, "", 1.0)
            if _key(plain) in done:
                plain = done[_key(plain)]
            else:
                with ExitStack() as stack:
                    for t in deciding:
                        cases = {(t.key, factor): multiplied(t, factor) for factor in FACTORS}
                        if t.key in NOT_COMPARED:
                            noted |= set(cases)
                            continue
                        stack.enter_context(replaced(t, Watched(t.value, cases, noted)))
                    plain |= _refined(study, fits)
                plain["otherwise"] = sorted(noted)
                _append(results, plain)
            noted = {(name, factor) for name, factor in plain["otherwise"]}
            for t in deciding:
                for factor in FACTORS:
                    entry = _entry(half, seed, t.key, factor)
                    if _key(entry) in done:
                        continue
                    if (t.key, factor) in noted:
                        with changed(t, factor):
                            entry |= _refined(study, fits)
                    else:
                        entry |= {name: plain[name] for name in ("verdict", "grade", "rivals", "effects")}
                    _append(results, entry)


def _entry(half: str, seed: int, threshold: str, factor: float) -> dict[str, Any]:
    return {"threshold": threshold, "factor": factor, "half": half, "seed": seed}


def _append(results: Path, entry: Mapping[str, Any]) -> None:
    with results.open("a", encoding="utf-8") as stream:
        stream.write(json.dumps(entry) + "\n")


def _refined(study: Path, fits: Fits) -> dict[str, Any]:
    """Return the verdict on a blind study."""
    with replaced_fit(fits):
        record = cosim.refinement.workflow.refine(study, study.parent / "out").record
    return {
        "verdict": record["verdict"],
        "grade": record["grade"],
        "rivals": sorted(str(rival) for rival in record["rivals"]),
        "effects": sorted(effect["name"] for effect in record["effects"]),
    }


@contextmanager
def replaced_fit(fits: Fits) -> Iterator[None]:
    """Replace the fit function in all modules that import it, within a `with` block."""
    holders = [
        m for n, m in list(sys.modules.items()) if n.startswith("cosim.") and getattr(m, "fit", None) is fits.fit
    ]
    for module in holders:
        module.fit = fits  # type: ignore[attr-defined]
    try:
        yield
    finally:
        for module in holders:
            module.fit = fits.fit  # type: ignore[attr-defined]


def show(results: Path) -> str:
    """Return a line per threshold and factor: the number of studies, and the verdicts that changed."""
    entries = list(_entries(results))
    plain = {(e["half"], e["seed"]): e for e in entries if not e["threshold"]}
    lines = []
    for t in (t for t in thresholds() if t.decides):
        for factor in FACTORS:
            of = [e for e in entries if (e["threshold"], e["factor"]) == (t.key, factor)]
            compared = [(plain[key], e) for e in of if (key := (e["half"], e["seed"])) in plain]
            other = [
                f"{e['half']} {e['seed']}: {_outcome_text(b)} → {_outcome_text(e)}"
                for b, e in compared
                if _outcome_text(b) != _outcome_text(e)
            ]
            lines.append(f"{t.name} × {factor:g} ({len(compared)} studies): {'; '.join(other) or 'nothing changes'}")
    return "\n".join(lines)


def _outcome_text(entry: dict[str, Any]) -> str:
    names = entry["effects"] or entry["rivals"]
    return f"{entry['verdict']} [{entry['grade']}] {', '.join(names)}".strip()


def _key(entry: dict[str, Any]) -> tuple[Any, ...]:
    return tuple(entry[name] for name in ("threshold", "factor", "half", "seed"))


def _entries(results: Path) -> Iterator[dict[str, Any]]:
    if results.is_file():
        yield from map(json.loads, results.read_text(encoding="utf-8").splitlines())


def main(arguments: Sequence[str]) -> None:
    """Run `table`, `run FILE` or `show FILE`."""
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
