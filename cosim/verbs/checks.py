"""Commands on files before a run: check, info, graph, linearize, doctor and schema."""

from __future__ import annotations

import os
import re
import shlex
from collections.abc import Mapping, Sequence
from contextlib import ExitStack, nullcontext, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from cosim.core.errors import Crashed, Fault, InputError, NotExecuted, refuse
from cosim.core.messages import with_prefix
from cosim.core.registry import resolve
from cosim.core.settings import Files, Given, ModelName
from cosim.core.text import some
from cosim.files.artefact import Checking, artefacts, kind_by_keys, of_kind
from cosim.files.files import FilePath
from cosim.files.folders import name_of, new_run
from cosim.verbs.cli import say, say_json, show, table, warn

if TYPE_CHECKING:
    from pydantic import BaseModel

    from cosim.blocks.summary import Summary, Variable
    from cosim.simulation.report.system_diagram import Graph


VERSIONED_LIBRARIES = ("fmpy", "numpy", "scipy", "control", "pyarrow", "sympy", "pythonfmu")
CHECKED_KINDS = "a scenario, study, sweep, protocol, model, log, SSP or FMU"
MAX_PRINTED_LINES = 200  # number of lines printed without --json
CAUSALITIES = {"inputs": ("input",), "outputs": ("output",), "parameters": ("parameter", "structuralParameter")}
EXPERIMENT_UNITS = {"start": " s", "stop": " s", "step": " s", "tolerance": ""}  # of a default experiment
STRUCTURE_TITLES = ("pairs", "connections", "dampings", "storages", "sensors", "inputs", "parameters")
MAX_LISTED_ITEMS = 8  # states, and items of an enumeration
MAX_LISTED_PARAMETERS = 60  # parameters in the table; --all shows every one
DIAGRAM_HEAD = 4096  # characters of a file that show whether it is a diagram
DIALECT = "https://json-schema.org/draft/2020-12/schema"
RESULT_SCHEMAS = {  # kind of result → class of its content
    "refine_result": "cosim.refinement.record:Record",
    "fit_result": "cosim.calibration.fit_record:Record",
    "credibility": "cosim.credibility.record:Credibility",
}
KEY = re.compile(r"^\s*`?(\w+)`?:\s+(\S.*)$")


def check(
    files: FilePath | Files,
    model: ModelName | None = None,
    *,
    load: bool = True,
    compile: bool = False,
    columns: Given | None = None,
    signed_by: FilePath | None = None,
) -> list[str]:
    """Find every fault of files.

    Args:
        files: One file or several: scenarios, studies, sweeps, protocols, models, logs, SSPs, FMUs.
        model: Model of the logs (base, a model.yaml, FILE.py:Class). By default, a log with an input of the base model
            is compared with it, and other logs are checked without a model.
        load: Load FMUs and make one step, and execute named Python files, in a worker process. False executes nothing.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        columns: Column of the logs → variable, or "time".
        signed_by: File of an Ed25519 public key (PEM) whose owner must have signed every FMU that is named.

    Returns:
        Notes and warnings, one line each.

    Raises:
        InputError: A file has faults; the error names all of them.
    """
    from cosim.blocks.compiling import compiling, permission
    from cosim.files.artefact import FMU
    from cosim.files.kinds import kind_by_form
    from cosim.isolation.process import Worker
    from cosim.master.remote import RUN_MODULES

    faults: list[Fault] = []
    lines: list[str] = []
    paths = [*map(Path, [files] if isinstance(files, (str, os.PathLike)) else files)]
    first = paths[0] if paths else Path("columns")
    names: dict[str, str] = {}
    if columns:
        from cosim.logs.log import read_column_names

        names = read_column_names(columns, first)
    with compiling(compile):
        if permission.get() and not load:
            text = "needs to load FMUs, but --no-load (in Python load=False) forbids it; remove one of them"
            raise InputError.at(Path("--compile"), text)
        with Worker(*RUN_MODULES) if load else nullcontext() as worker:
            checking = Checking(model, names, worker)
            for path in paths:
                try:
                    if signed_by is not None:
                        if kind_by_form(path) != FMU:
                            raise InputError.at(path, "is not an FMU; --signed-by checks FMUs only")
                        from cosim.credibility.record import check_signature

                        check_signature(path, Path(signed_by))
                    lines += [with_prefix(f"{path}: ", line) for line in _check_isolated(path, checking)]
                except InputError as error:
                    faults += error.faults
    refuse(faults)
    return lines


def _check_isolated(path: Path, checking: Checking) -> list[str]:
    """Check a file; execute named Python in the worker, or not at all without a worker."""
    from cosim.files.artefact import without_execution

    worker = checking.worker
    with without_execution() as skipped:
        try:
            return _check(path, checking)
        except NotExecuted as code:
            if worker is None:
                return [f"warning: {code} (--no-load); this file and the files that use it are not checked"]
        except InputError:
            if worker is None or not skipped:  # otherwise there may be more faults
                raise
    try:
        lines: list[str] = worker.call(_check, path, replace(checking, worker=None))
    except Crashed as crash:
        reason = crash.reason.replace("the worker", "its Python", 1)
        raise InputError.at(skipped[0], f"does not load: {reason}") from None
    return lines


def _check(path: Path, checking: Checking) -> list[str]:
    """Return the notes of a file; raise InputError with its faults."""
    from cosim.files import artefact, kinds
    from cosim.files.yaml_file import YamlFile

    kind: str | None = artefact.CODE
    if not path.suffix.startswith(".py:"):  # FILE.py:Class
        kinds.refuse_unreadable(path, CHECKED_KINDS)
        kind = kinds.kind_by_form(path)
    if kind is None:
        root = YamlFile(path).root
        is_study = root.keys() & {"model", "candidates"} and "step" not in root  # a study without `logs`
        kind = kind_by_keys(root) or (artefact.STUDY if is_study else artefact.SCENARIO)
    declared = of_kind(kind)
    if declared is None or not declared.check:
        raise InputError.at(path, f"is {kind}, which has no check: {kinds.next_step(kind, path)}")
    notes: list[str] = resolve(declared.check)(path, checking)
    return notes


def check_command(*, json: bool = False, **given: Any) -> None:
    """Find every fault of scenarios, studies, models, logs and FMUs.

    Args:
        files (FILE): Scenario, study, sweep, protocol, model, log, SSP, FMU or manifest.json.
        model (MODEL): Model of the logs: base, a model.yaml, or FILE.py:CLASS.
        load: Load the FMUs and make one step in a separate process.
        columns (--column COLUMN=VARIABLE): Variable of the model for a column of a log, for example stamp=time.
        signed_by (KEY): File of an Ed25519 public key whose owner must have signed every FMU that is named.

    Example: cosim check scenario.yaml build/*.fmu
    """
    files, lines = given["files"], check(**given)
    say(*lines[:MAX_PRINTED_LINES])
    if len(lines) > MAX_PRINTED_LINES:
        say(f"… and {len(lines) - MAX_PRINTED_LINES} more; --json lists all of them")
    say(f"no faults in {', '.join(map(str, files))}")
    if json:
        say_json({"files": [str(file) for file in files], "findings": lines, "faults": []})


def info_command(
    fmus: list[Path],
    *,
    every: bool = False,
    report: bool = False,
    places: bool = False,
    log: list[str] | None = None,
    compile: bool = False,
    limits: str = "",
    json: bool = False,
) -> None:
    """List variables, units, defaults and capabilities of FMUs.

    Args:
        fmus (FMU): FMU to describe.
        every (--all): List local variables and every parameter too.
        report: Write NAME-credibility.html, which draws the region of the logs and the error bands of an FMU of cosim.
        places: Execute each FMU to find the signals at which missing effects can act.
        log (LOG): Measured log that drives the inputs for --places.
        compile: Compile and execute the sources of FMUs that have no library for this machine.
        limits: Limits of each simulation for --places, for example 'step: 10 s'.

    Example: cosim info plant.fmu controller.fmu
    """
    from cosim.blocks.summary import summaries
    from cosim.credibility.found import read_credibility

    if not places and (log or limits or compile):
        raise typer.BadParameter("--log, --limits and --compile need --places")
    descriptions = summaries(fmus)
    probed: dict[Path, dict[str, Any]] = {}
    if places:
        from cosim.blocks.compiling import compiling
        from cosim.isolation.limits import read_limits
        from cosim.probing.places import probe_places
        from cosim.probing.prober import LIMITS
        from cosim.residuals.drive import log_of_fmu

        most, logs = read_limits(limits) if limits else LIMITS, log or []
        for fmu in fmus:
            read = [log_of_fmu(Path(name), fmu) for name in logs]
            with compiling(compile):
                probed[fmu] = probe_places(fmu, read, limits=most).as_json()
    pages: dict[Path, Path] = {}
    if report:
        from cosim.credibility.page import write_page

        pages = {fmu: write_page(fmu) for fmu in fmus}
    contents, blank = [], [""]
    for fmu, summary in zip(fmus, descriptions, strict=True):
        known, problem = read_credibility(fmu)
        contents.append(summary.as_json() | ({"places": probed[fmu]} if places else {}))
        contents[-1] |= {"credibility": known.model_dump(mode="json", exclude={"region": {"points"}})} if known else {}
        say(*(blank if len(contents) > 1 else []), *_overview(summary), *(known.lines() if known else []))
        warn(*([f"{fmu}: {problem}"] if problem else []))
        say(*([f"report: {pages[fmu]}"] if report else []))
        say(*(_places(probed[fmu]) if places else _variables(summary, every=every)))
    if json:
        say_json(contents if len(contents) > 1 else contents[0])


def _places(places: Mapping[str, Any]) -> list[str]:
    """Return the tables of places, and the findings."""

    def cell(value: Any) -> str:
        if isinstance(value, dict):  # by its name
            value = next(iter(value.values()))
        if isinstance(value, (list, tuple)):
            return ", ".join(map(cell, value))
        return f"{value:.6g}" if isinstance(value, float) else str("" if value is None else value)

    lines = [f"way: {places['way']}: {places['reason']}"]
    for title in STRUCTURE_TITLES:
        rows = [
            [f"  {cell(value)}" if not k else cell(value) for k, value in enumerate(row.values())]
            for row in places[title]
        ]
        heads = [f"{'' if k else '  '}{name}" for k, name in enumerate(places[title][0])] if rows else []
        lines += [f"{title}: {len(rows) or 'none'}", *(table(heads, rows) if rows else [])]
    findings = places["findings"]
    return [*lines, f"findings: {len(findings) or 'none'}", *(f"  {finding}" for finding in findings)]


def _overview(s: Summary) -> list[str]:
    """Return the lines about an FMU before its variables."""
    from cosim.fmi.description import C_CODE

    experiment = [f"{key} {s.experiment[key]:g}{unit}" for key, unit in EXPERIMENT_UNITS.items() if key in s.experiment]
    without = " without --compile" if C_CODE in s.platforms else ""
    here = "" if s.runs_here else f", so it does not run on this machine{without}"
    capabilities = []
    for way, flags in s.capabilities.items():
        names = [name if value is True else f"{name} {value}" for name, value in flags.items()]
        capabilities.append(f"  {way}: {', '.join(names) or 'no capability declared'}")
    return [
        f"{s.file}: {s.name}, FMI {s.fmi_version} for {', '.join(s.ways)}" + (f", by {s.tool}" if s.tool else ""),
        *([f"  {s.description}"] if s.description else []),
        f"  default experiment: {', '.join(experiment) or 'none'}",
        f"  platforms: {', '.join(s.platforms) or 'none'}{here}",
        *capabilities,
        f"  states: {s.state_count}" + (f" ({some(s.states, MAX_LISTED_ITEMS)})" if s.states else ""),
        *(f"  warning: {slip}" for slip in s.slips[:5]),
    ]


def _variables(s: Summary, *, every: bool) -> list[str]:
    """Return the tables of variables; unless all are shown, local variables are only counted."""
    groups = {title: s.of(*causalities) for title, causalities in CAUSALITIES.items()}
    others = [v for v in s.variables if v.causality not in {"independent"}.union(*CAUSALITIES.values())]
    if every and others:
        groups["others"] = others
    lines = []
    for title, variables in groups.items():
        listed = variables if every or title != "parameters" else variables[:MAX_LISTED_PARAMETERS]
        header = ("  name", "type", "unit", "start", "range", "description")
        lines += (
            [f"{title}: {len(variables)}", *table(header, [*map(_row, listed)])] if variables else [f"{title}: none"]
        )
        lines += [f"  … and {len(variables) - len(listed)} more (--all)"] if len(listed) < len(variables) else []
    if others and not every:
        lines.append(f"{len(others)} more: locals and calculated parameters (--all lists them)")
    return lines


def _row(v: Variable) -> tuple[str, ...]:
    """Return the cells of a variable: name, type, unit, start, range, description."""
    item = next((name for name, number in v.items.items() if str(number) == v.start), "")
    start = f"{v.start} ({item})" if item else (v.start or "")[:30]
    limits = "" if v.min is None and v.max is None else f"{v.min or '-∞'} … {v.max or '∞'}"
    if v.items:
        limits = some([f"{number} {name}" for name, number in v.items.items()], MAX_LISTED_ITEMS)
    name = f"  {v.name}{list(v.dimensions) if v.dimensions else ''}"
    return name, v.type, v.unit, start, limits, v.description[:80]


def graph_command(
    scenario: Path,
    *,
    out: FilePath | None = None,
    set: list[str] | None = None,
    open: bool = False,
    force: bool = False,
    json: bool = False,
) -> None:
    """Draw the components and connections of a scenario.

    The picture shows the order of steps, signals, units, noise and faults.

    Args:
        scenario: A scenario, an SSP, or the manifest.json of a run.
        out (--out -o FILE.svg): Picture (default: NAME.svg).
        set (PATH=VALUE): Replace a value of the scenario, for example noise=off.
        force: Overwrite a file that is not a picture of a scenario.

    Example: cosim graph scenario.yaml
    """
    from cosim.files.files import write_text

    graph = graph_of(scenario, set or ())
    path = Path(f"{scenario.stem}.svg" if out is None else out)
    if not path.parent.is_dir():
        raise InputError.at(path, "its folder does not exist; create it first")
    if path.suffix.lower() != ".svg":
        raise InputError.at(path, "give an .svg file")
    if path.exists() and not force:
        with path.open(encoding="utf-8", errors="replace") as stream:
            is_diagram = 'class="diagram"' in stream.read(DIAGRAM_HEAD)
        if not is_diagram:
            reason = "exists and is not a picture of a scenario; give another --out, or overwrite it with --force"
            raise InputError.at(path, reason)
    write_text(path, graph.svg())
    say(f"graph: {path}")
    if json:
        say_json({"graph": str(path)})
    show(path, open)


def graph_of(path: Path, overrides: Sequence[str] = ()) -> Graph:
    """Return the block diagram of a scenario, a manifest or an SSP.

    Raises:
        InputError: The input is faulty.
        FmuError: An FMU is invalid.
    """
    from cosim.core.scratch import temporary_folder
    from cosim.scenario.scenario import resolve_defaults
    from cosim.scenario.scenario_file import ScenarioFile
    from cosim.simulation.packaged import is_ssp, lay_out
    from cosim.simulation.report.system_diagram import graph_from
    from cosim.system.system import build_system

    with ExitStack() as stack:
        if is_ssp(path):
            file, _ = lay_out(path, stack.enter_context(temporary_folder("graph")), overrides)
        else:
            file = ScenarioFile(path, overrides)
        system = build_system(file)
    units = {name: signal.unit for name, signal in system.signals.items()}
    arrays = {f"{n.partition('.')[0]}.{s.array}": s.unit for n, s in system.signals.items() if s.array}
    held = {transfer.name for transfer in system.held if not transfer.of}
    return graph_from(resolve_defaults(file.scenario), system.names, held, {**arrays, **units})


def linearize_command(*, open: bool = False, json: bool = False, **given: Any) -> None:
    """Linearize a model or an FMU about an operating point.

    Prints A, B, C, D, poles and ranks. Writes linear.json, linear.mat, linear.py and report.html.

    Args:
        model: A registered model such as base, a model.yaml, FILE.py:CLASS, the folder of a refine, or an FMU.
        out (--out -o PATH): Folder for the results (default: a new number in results/MODEL-linear).
        at (POINT): Operating point: NAME=VALUE,NAME=VALUE of states and inputs, SCENARIO@TIME, or
            SCENARIO@START:STOP:STEP for a trajectory.
        set (NAME=VALUE): Value of a parameter.
        states (NAME,NAME): States of the linear model, in this order.
        inputs (NAME,NAME): Inputs of the linear model.
        outputs (NAME,NAME): Outputs of the linear model.
        residualize (NAME,NAME): Fast states that are set to their equilibrium.
        component (NAME): Component of the scenario, if several match.
        step (NUMBER): Step of central differences, for example 1e-5; replaces the FMU's derivatives.

    Example: cosim linearize motor.fmu --at speed=100
    """
    from cosim.linearization.workflow import linearize
    from cosim.linearization.write import POLE_COLUMNS, content, headline, matrix_lines, pole_rows

    for key in ("states", "inputs", "outputs", "residualize"):
        given[key] = [name.strip() for text in given[key] for name in text.split(",") if name.strip()]
    name = f"{name_of(str(given['model']))}-linear"
    with new_run(given["out"], name, "cosim linearize", force=given["force"]) as folder:
        outcome = linearize(**given | {"out": folder})
    warn(*outcome.notes)
    if json:
        say_json(content(outcome))
    m, page = outcome.first, folder / "report.html"
    say(headline(outcome.structure, m))
    say(*table(POLE_COLUMNS, [tuple(row.values()) for row in pole_rows(outcome.structure)]))
    for name in "ABCD":
        header, *cells = matrix_lines(name, *m.matrix(name)) or [[name]]
        say(*table(header, cells) if cells else [])
    count = len(outcome.linear)
    several = f", {count} times from {m.point.time:g} s on; the first is shown above" if count > 1 else ""
    say(f"by {m.method}{several}")
    report = f"; report: {page}" if page.is_file() else ""
    say(f"linear model: {folder / 'linear.json'}, linear.mat, linear.py{report}")
    show(page, open)


def doctor_command(fmus: list[ModelName] | None = None, *, json: bool = False) -> None:
    """Show what this installation can do: versions, compiler, extras, and whether FMUs run on this machine.

    Args:
        fmus ([FMU]): FMUs whose platforms are compared with this machine.

    Example: cosim doctor motor.fmu
    """
    import platform
    from importlib.metadata import PackageNotFoundError, version
    from importlib.util import find_spec

    from cosim.blocks.summary import summaries
    from cosim.core.extras import EXTRAS, install_command
    from cosim.core.version import __version__
    from cosim.fmi.description import no_library
    from cosim.fmi.native.compiler import compiler, cure, this_platform

    versions = {"cosim": __version__, "Python": platform.python_version()}
    for name in VERSIONED_LIBRARIES:
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    here, command = this_platform(), compiler()
    libraries = {name: find_spec(name) is not None for name in EXTRAS}
    machine = {"system": platform.platform(), "platform": here.name if here else platform.machine()}
    fmus_here = dict[str, str]()
    for fmu in summaries([Path(name) for name in fmus or ()]):
        name = here.folder(int(fmu.fmi_version[0])) if here else platform.machine()
        fmus_here[fmu.file] = "" if name in fmu.platforms else no_library(name, fmu.platforms)
    if json:
        say_json({"versions": versions, **machine, "compiler": command, "libraries": libraries, "fmus": fmus_here})
    say(*table(("", "version"), [*versions.items()]))
    say(*(f"{name}: {value}" for name, value in machine.items()))
    without = f"none; {cure('refine')}"
    say(f"C compiler: {shlex.join(command) if command else without}")
    for name, is_there in libraries.items():
        say(f"{name}: {'installed' if is_there else f'not installed; {install_command(EXTRAS[name])}'}")
    say(*(f"{fmu}: {reason or 'runs on this machine'}" for fmu, reason in fmus_here.items()))


def schema_command(kind: str) -> None:
    """Print the JSON schema of a kind of file, for editors.

    Args:
        kind (KIND): Kind of file: scenario, study, model, refine_result, …, or a kind of an installed package.

    Example: cosim schema scenario
    """
    say_json(schema_of(kind))


def kinds_with_schema() -> list[str]:
    """Return the kinds of files with a schema."""
    return sorted({*(a.schema_name for a in artefacts() if a.schema), *RESULT_SCHEMAS})


def schema_of(name: str) -> dict[str, Any]:
    """Return the JSON schema of a kind of file, each key with its meaning; raise InputError for an unknown kind."""
    places = {**{a.schema_name: a.schema for a in artefacts() if a.schema}, **RESULT_SCHEMAS}
    if name not in places:
        raise InputError.at(Path(name), f"has no schema; give one of {', '.join(kinds_with_schema())}")
    model: type[BaseModel] = resolve(places[name])
    schema = model.model_json_schema(mode="serialization" if name in RESULT_SCHEMAS else "validation")
    for part in (schema, *schema.get("$defs", {}).values()):
        keys: dict[str, Any] = part.get("properties", {})
        rest, last = [], ""
        # a docstring line `key: meaning` becomes the key's description
        for line in str(part.get("description", "")).splitlines():
            match = KEY.match(line)
            if match and match[1] in keys:
                last = match[1]
                keys[last]["description"] = match[2]
            elif last and line.strip():
                keys[last]["description"] += f" {line.strip()}"
            elif not last:
                rest.append(line)
        if rest:
            part["description"] = "\n".join(rest).strip()
        for content in keys.values() if name in RESULT_SCHEMAS else ():
            content.pop("title", None)  # repeats the key
    if name in RESULT_SCHEMAS:
        return {"$schema": DIALECT, **schema}
    title = next(a.title for a in artefacts() if a.schema_name == name)
    return {"$schema": DIALECT, **_allow_on_and_off(schema), "title": title}


def _allow_on_and_off(node: Any) -> Any:
    """Allow `on` and `off`, as in YAML 1.1, for true and false."""
    if isinstance(node, list):
        return [_allow_on_and_off(value) for value in node]
    if not isinstance(node, dict):
        return node
    inner = {key: _allow_on_and_off(value) for key, value in node.items()}
    if inner.get("type") != "boolean":
        return inner
    return {**{k: v for k, v in inner.items() if k != "type"}, "anyOf": [{"type": "boolean"}, {"enum": ["on", "off"]}]}
