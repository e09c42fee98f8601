"""Building of Python FMUs by pythonfmu. Equal inputs give equal bytes.

All Python FMUs of a process share `sys.modules`. cosim therefore puts the sources of an FMU into a package whose name
is a hash of their content, so that an FMU does not import modules of another FMU or of the host.
"""

from __future__ import annotations

import ast
import hashlib
import re
import zipfile
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

from cosim.core.drafts import draft_of
from cosim.files.archive import ARCHIVE_DATE
from cosim.fmi.model_description import ASSETS, Description, describe, documentation, model_text
from cosim.fmi.ports import Value, model_ports, with_starts
from cosim.model.model import Model
from cosim.model.traits import Traits

FRAMEWORK = "cosim"
CARRIED_PACKAGES = ("cosim.model", "cosim.fmi")  # copied into FMUs; need no other library
EXCLUDED_PACKAGE = "cosim.model.symbolic"  # not copied, because it is needed only while an FMU is built
SCRIPT_MODULES = ("cosim.fmi.lifetime", "cosim.fmi.ports")  # imported by the script of pythonfmu
OWN_MODULE = "own_model"  # module name of a user's model inside its FMU


@dataclass(frozen=True)
class Recipe:
    """Everything needed to build an FMU.

    Attributes:
        slave: Module and class of the FMI slave.
        packages: Top-level packages. The FMU contains those of their modules that its slave imports.
        about: Content of the model description.
        text: Documentation in HTML.
        values: Parameter defaults that differ from the declared ones.
        own: File and class name of a user's model, if any.
        printed: Modules generated for the FMU: dotted name → source code.
        starts: Start values that replace the declared ones, for a slave without a model.
    """

    slave: tuple[str, str]
    packages: tuple[str, ...]
    about: Description
    text: str
    values: tuple[tuple[str, float | bool], ...] = ()
    own: tuple[Path, str] | None = None
    printed: tuple[tuple[str, str], ...] = ()
    substep: float | None = None
    integrator: str | None = None
    starts: tuple[tuple[str, Value], ...] = ()

    def with_starts(self, values: Mapping[str, Value]) -> Recipe:
        """Return the recipe with other start values of the FMU's variables."""
        about = replace(self.about, ports=with_starts(self.about.ports, values))
        return replace(self, about=about, starts=tuple(sorted(values.items())))


def model_recipe(model: Model, file: Path, values: Mapping[str, float | bool] | None = None) -> Recipe:
    """Return the recipe of a user's model.

    The FMU contains `file`. If the file imports packages other than `cosim.model` and the standard library, they must
    be installed on the machine that runs the FMU.

    Args:
        file: Python file of the model class.
        values: Parameter defaults that replace the declared ones.
    """
    from cosim.model.symbolic.symbols import output_dependencies

    own, built = (file, type(model).__name__), model.with_values(values or {})
    signals, traits = (model_ports(built), *output_dependencies(built)), Traits.of(built)
    about = Description(model.title, *signals, built.rate, 10.0, variable_step=True, traits=traits)
    slave, text = ("cosim.fmi.model_fmu", "ModelSlave"), model_text(model)
    sorted_values = tuple(sorted((values or {}).items()))
    return Recipe(slave, (), about, text, sorted_values, own, (), model.chosen_substep, model.chosen_integrator)


def build(recipe: Recipe, path: Path) -> Path:
    """Write an FMU completely or not at all. The same recipe gives the same bytes."""
    import pythonfmu
    from pythonfmu._version import __version__ as version

    packer = Path(pythonfmu.__file__).parent
    name = f"{recipe.own[1]}Plant" if recipe.own else recipe.slave[1]
    package, members = _package(recipe, name)
    members |= {f"pythonfmu/{file.name}": file.read_bytes() for file in packer.glob("*.py")}
    members = {f"resources/{file}": data for file, data in members.items()}
    members["resources/slavemodule.txt"] = f"{package}_slave".encode()
    for file in packer.glob("resources/binaries/*/*"):
        if file.suffix in {".dll", ".so", ".dylib"}:
            members[f"binaries/{file.parent.name}/{name}{file.suffix}"] = file.read_bytes()
    members["model.png"] = (ASSETS / "model.png").read_bytes()
    interface = {
        "needsExecutionTool": "true",
        "canHandleVariableCommunicationStepSize": str(recipe.about.variable_step).lower(),
        "canInterpolateInputs": "false",
        "canBeInstantiatedOnlyOncePerProcess": "false",
        "canGetAndSetFMUstate": "true",
        "canSerializeFMUstate": "true",
        "modelIdentifier": name,
        "canNotUseMemoryManagementFunctions": "true",
    }

    def description(guid: str) -> bytes:
        about, categories = recipe.about, pythonfmu.Fmi2Slave.log_categories
        return describe(about, name, f"PythonFMU {version}", guid, {"CoSimulation": interface}, categories)

    # The page contains the GUID, which is a hash of everything else.
    guid = f"{{{digest(members, description('') + recipe.text.encode())[:32]}}}"
    members |= documentation(recipe.about, recipe.text, guid, "FMI 2.0 co-simulation")
    members["modelDescription.xml"] = description(guid)
    with draft_of(path) as target:
        write_zip(target, members)
    return path


def _package(recipe: Recipe, class_name: str) -> tuple[str, dict[str, bytes]]:
    """Return the name of the FMU's Python package (with a hash of its files) and the files, with the slave's script."""
    sources, module = dict(_sources(recipe)), recipe.slave[0]
    identity = recipe.slave, class_name, recipe.values, recipe.substep, recipe.integrator, recipe.starts
    tag = digest(sources, repr(identity).encode())[:12]
    package = f"{re.sub(r'(?<!^)(?=[A-Z])', '_', class_name).lower()}_{tag}"
    # imports of cosim and of packages in the recipe, which become imports of the FMU's own package
    names = "|".join((FRAMEWORK, *recipe.packages))
    whole, replacement = rf"^(\s*)import (({names})(?:\.\w+)*)$", rf"\1import {package}.\2; from {package} import \3"
    members = {}
    for name, text in sources.items():
        source = re.sub(whole, replacement, text.decode(), flags=re.MULTILINE)
        source = re.sub(rf"^(\s*(?:from|import) )({names})(?=[.\s])", rf"\1{package}.\2", source, flags=re.MULTILINE)
        members[f"{package}/{name}"] = source.encode()
    has_substep = recipe.substep is not None or recipe.integrator is not None
    lines = [
        f"from {package}.cosim.fmi.lifetime import keep",
        f"from {package}.cosim.fmi.ports import model_ports, with_starts",
        f"from {package}.{module} import {recipe.slave[1]} as Base",
        f"from {package}.{OWN_MODULE} import {recipe.own[1]} as Own" if recipe.own else "",
        f"class {class_name}(Base):",
        f'    """{recipe.about.description}."""',
    ]
    if recipe.values or recipe.own or has_substep:
        model = "Own()" if recipe.own else "Base.model"
        model += f".with_values({dict(recipe.values)!r})" if recipe.values else ""
        model += f".with_substep({recipe.substep!r}, {recipe.integrator!r})" if has_substep else ""
        lines += [f"    model = {model}", "    ports = model_ports(model)"]
    if recipe.starts:
        lines.append(f"    ports = with_starts(Base.ports, {dict(recipe.starts)!r})")
    members[f"{package}_slave.py"] = "\n".join([*lines, "", "keep(globals(), locals())", ""]).encode()
    return package, members


def _sources(recipe: Recipe) -> Iterator[tuple[str, bytes]]:
    """Yield path and content of each module that the FMU imports."""
    printed = dict(recipe.printed)
    if recipe.own:
        yield f"{OWN_MODULE}.py", recipe.own[0].read_bytes()
    queue = [recipe.slave[0], *SCRIPT_MODULES, *(_imports(recipe.own[0].read_bytes()) if recipe.own else ())]
    modules: dict[str, tuple[str, bytes]] = {}
    carried = tuple(f"{package}." for package in (*CARRIED_PACKAGES, *recipe.packages))
    while queue:
        name = queue.pop()
        is_carried = f"{name}.".startswith(carried) and not f"{name}.".startswith(f"{EXCLUDED_PACKAGE}.")
        if name in modules or not (name == FRAMEWORK or is_carried):
            continue
        if name in printed:
            modules[name] = (f"{name.replace('.', '/')}.py", printed[name].encode())
            continue
        spec = None
        with suppress(ModuleNotFoundError):  # the name is an object in a module
            spec = find_spec(name)
        if spec is not None and spec.origin is not None:
            path = f"{name.replace('.', '/')}{'/__init__' if spec.submodule_search_locations is not None else ''}.py"
            # The __init__ of `cosim` is replaced: it contains the functions of the verbs.
            modules[name] = (path, b"" if name == FRAMEWORK else Path(spec.origin).read_bytes())
            queue += [*_imports(modules[name][1]), name.rpartition(".")[0]]
    yield "__init__.py", b""
    yield from modules.values()


def _imports(source: bytes) -> Iterator[str]:
    """Yield the names of the modules that a source imports, and of objects imported from them."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def archive_member(name: str) -> zipfile.ZipInfo:
    """Return the ZIP entry of a member with a fixed date and fixed permissions."""
    info = zipfile.ZipInfo(name, ARCHIVE_DATE)
    info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
    return info


def write_zip(path: Path, members: dict[str, bytes]) -> None:
    """Write a ZIP archive; equal members give equal bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in sorted(members):
            packed.writestr(archive_member(name), members[name])


def digest(members: dict[str, bytes], more: bytes) -> str:
    """Return the SHA-256 of the names and contents of members and of `more`."""
    sha = hashlib.sha256()
    for name in sorted(members):
        sha.update(f"{name}\0{len(members[name])}\0".encode())
        sha.update(members[name])
    sha.update(more)
    return sha.hexdigest()
