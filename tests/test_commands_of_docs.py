"""Commands that documents show: the parser accepts each, and each document is run by a test or has a reason why not."""

from __future__ import annotations

import re
import shlex
import webbrowser
from collections.abc import Mapping
from pathlib import Path

import pytest

from tests.conftest import ROOT
from tests.test_first_steps import told
from tests.test_help import COMMANDS

LINE = re.compile(r"(?:\S*/)?cosim (.*)")
DOCUMENTS = {
    path.relative_to(ROOT).as_posix(): path
    for path in (ROOT / "README.md", *ROOT.glob("docs/*.md"), *ROOT.glob("examples/**/README.md"))
}

# document → what runs its commands as they stand, or with shorter times
RUN: Mapping[str, str] = {
    "README.md": "tests/test_docs.py",
    "docs/controllers.md": "tests/test_controllers.py",
    "docs/install.md": "release/trial.py",
    "docs/localisation.md": "tests/test_localisation.py",
    "docs/my_fmus.md": "tests/test_docs.py",
    "docs/my_log.md": "tests/test_docs.py",
    "docs/refined.md": "tests/test_docs.py",
    "docs/seed.md": "tests/test_seed.py",
    "examples/coupling/README.md": "tests/test_coupling_examples.py",
}
YOURS = "the files are those of the reader"
LONG = "a whole study takes minutes to hours"
# document → reason why its commands are parsed only, and the tests that run the same verbs and options
PARSED: Mapping[str, tuple[str, str]] = {
    "docs/fit.md": (YOURS, "tests/test_fit.py"),
    "docs/hosts.md": ("tests build these FMUs in folders of their own", "tests/test_native.py"),
    "docs/live.md": ("a page is open until its reader closes it", "tests/test_live_browser.py"),
    "docs/logs.md": (YOURS, "tests/test_replay.py"),
    "docs/native.md": ("libraries of other systems need a compiler that is not everywhere", "tests/test_native.py"),
    "docs/probing.md": (YOURS, "tests/test_probing.py"),
    "docs/real_time.md": ("a run at the pace of the clock, with partners", "tests/test_live_values.py"),
    "docs/refine_fmu.md": (YOURS, "tests/test_refine_fmu.py"),
    "docs/related.md": ("an FMU of another project", "tests/test_related.py"),
    "docs/remote.md": ("a server runs until it is ended", "tests/test_remote.py"),
    "docs/resume.md": ("a run that is stopped in its middle", "tests/test_resume.py"),
    "docs/ssp.md": ("tests export shorter scenarios", "tests/test_ssp.py"),
    "docs/sweep.md": ("hundreds of runs", "tests/test_sweep.py"),
    "docs/times.md": ("tests run a shorter scenario", "tests/test_component_times.py"),
    "docs/verbs.md": ("the craft is linearized elsewhere, results are listed below", "tests/test_linearize.py"),
    "docs/view.md": ("a page is open until its reader closes it; the conversion is run below", "tests/test_view.py"),
    "examples/clocks/README.md": ("needs a compiler", "tests/test_compile.py"),
    "examples/remote/README.md": ("a server beside a run", "tests/test_remote.py"),
    **{
        f"examples/{name}/README.md": (LONG, f"tests/{test}.py")
        for name, test in {
            "ballbeam": "test_examples_data",
            "bench/overshoot": "test_overshoot",
            "coupled_drives": "test_measured_fmus",
            "drive": "test_drive",
            "incubator": "test_measured_fmus",
            "pendulum": "test_examples_data",
            "propeller": "test_examples_data",
            "silverbox": "test_examples_data",
            "tclab": "test_examples_data",
            "ur10e": "test_examples_data",
        }.items()
    },
}


def shown(document: str) -> list[str]:
    """The commands of a document, in code blocks for a shell or indented, without `cosim`."""
    text = DOCUMENTS[document].read_text(encoding="utf-8")
    blocks = [block for kind, block in re.findall(r"```(\w*)\n(.*?)```", text, re.DOTALL) if kind in {"sh", "text", ""}]
    lines = [line for block in blocks for line in block.splitlines()] + re.findall(r"^ {4}(\S.*)$", text, re.MULTILINE)
    return [found[1] for line in lines if (found := LINE.fullmatch(line.strip()))]


COMMANDS_OF = {document: lines for document in DOCUMENTS if (lines := shown(document))}


@pytest.mark.parametrize("document", COMMANDS_OF)
def test_the_parser_accepts_every_command_of_a_document(document: str) -> None:
    for line in COMMANDS_OF[document]:
        words = shlex.split(re.split(r" [>|&]( |$)", line)[0], comments=True)
        if words != ["--version"]:
            COMMANDS[words[0]].make_context(words[0], words[1:])


def test_each_document_with_commands_is_run_or_has_a_reason_why_not() -> None:
    assert not {*RUN} & {*PARSED}
    assert {*COMMANDS_OF} == {*RUN, *PARSED}
    runners = [*RUN.values(), *(runner for _, runner in PARSED.values())]
    assert [name for name in runners if not (ROOT / name).is_file()] == []


def test_the_commands_about_results_run_as_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(webbrowser, "open", lambda _: True)
    signal = "{x: {start: 1, unit: m, changes: [{at: 0.5, to: 2}]}}"
    for name in ("tank", "tank", "tank", "other"):
        (tmp_path / f"{name}.yaml").write_text(
            f"name: {name}\nduration: 1\nstep: 0.1\ncomponents: {{ref: {{block: reference, signals: {signal}}}}}\n"
        )
        told("run", f"{name}.yaml", "--in-process")
    for line in COMMANDS_OF["docs/verbs.md"] + COMMANDS_OF["docs/view.md"]:
        verb, *arguments = shlex.split(line, comments=True)
        if verb in {"list", "open", "compare", "gc"} or "--prepare" in arguments:
            told(verb, *arguments)
    assert {"comparison.json", "report.html"} <= {path.name for path in tmp_path.glob("results/*/*")}
