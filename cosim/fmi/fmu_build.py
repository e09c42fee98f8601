"""Building the FMUs: sources under a name no other FMU has, packed by pythonfmu, completed, byte-reproducible.

All Python FMUs of a process share `sys.modules`. Each of ours therefore carries its sources in one
package named by their content: two FMUs never see each other's modules, nor the host's.
"""

from __future__ import annotations

import hashlib
import re
import sys
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

from cosim.base.drafts import draft_of
from cosim.base.scratch import temporary_folder
from cosim.fmi.documentation import GUID_PLACEHOLDER, model_text, write_documentation
from cosim.fmi.model_description import Description, complete
from cosim.model.model import Model
from cosim.model.traits import Traits
from fmus import __version__

ROOT = Path(__file__).resolve().parent.parent
# What each FMU carries of our sources; `fmus` is listed by file, for most of it is needed at build time only.
RUNTIME = ("__init__", "lifetime", "ports", "slave", "state")
ABSOLUTE_IMPORT = re.compile(r"^(\s*from )(plant|controller|fmus)(?=[.\s])", re.MULTILINE)
BUILD_TIME = ("plant/symbolic", "cosim/model/traits.py")  # what needs more than the FMU's host has
OWN = "own_model"  # what the file of a model of one's own is called within its FMU
EPOCH = (1980, 1, 1, 0, 0, 0)
ASSETS = Path(__file__).resolve().parent / "assets"


@dataclass(frozen=True)
class Recipe:
    """What makes one FMU: its slave class, the packages it carries, and what its description says."""

    slave: tuple[str, str]  # module within `fmus`, and its class
    packages: tuple[str, ...]
    about: Description
    text: str  # documentation: what it is and how to use it, HTML
    values: tuple[tuple[str, float | bool], ...] = ()  # parameter defaults other than the declared ones
    modules: tuple[str, ...] = ()  # of `fmus` that the slave's module needs
    own: tuple[Path, str] | None = None  # file and class of a model of one's own
    without: tuple[str, ...] = ()  # of the packages, what is not needed when it runs
    printed: tuple[tuple[str, str], ...] = ()  # modules that are made when it is built: path, text
    substep: float | None = None  # [s], where it is not that of the model's class


def model_recipe(model: Model, file: Path, values: Mapping[str, float | bool] | None = None) -> Recipe:
    """A model of one's own, whose class stands in `file`, with other defaults where `values` says so.

    The FMU carries the file; what it imports beside `plant` and the standard library its host must have.
    """
    own = (file, type(model).__name__)
    about = about_model(model.with_values(values or {}), model.title)
    slave, text = ("model_fmu", "ModelSlave"), model_text(model)
    return Recipe(slave, ("plant",), about, text, ordered(values), own=own, substep=model.chosen_substep)


def ordered(values: Mapping[str, float | bool] | None) -> tuple[tuple[str, float | bool], ...]:
    """Parameter values in an order that does not hang on how they were written."""
    return tuple(sorted((values or {}).items()))


def about_model(model: Model, text: str) -> Description:
    """What the description of a model's FMU says."""
    from cosim.fmi.ports import model_ports
    from cosim.model.symbolic.dependencies import direct_dependencies, initial_dependencies

    return Description(
        text,
        model_ports(model),
        direct_dependencies(model),
        initial_dependencies(model),
        step=model.rate,
        stop=10.0,
        variable_step=True,
        traits=Traits.of(model),
    )


def build(recipe: Recipe, path: Path) -> Path:
    """Write one FMU to `path`, whole or not at all; the same sources give the same bytes."""
    with temporary_folder("build") as folder:
        draft = _pack(recipe, folder)
        members = {name: data for name, data in _members(draft) if "__pycache__" not in name}
        xml = members.pop("modelDescription.xml")
        # the page names the GUID, which is made of everything else: a placeholder stands there until it is known
        guid = f"{{{digest(members, xml_of(recipe, xml, ''))[:32]}}}"
        page = "documentation/index.html"
        members[page] = members[page].replace(GUID_PLACEHOLDER.encode(), guid.encode())
        members["modelDescription.xml"] = xml_of(recipe, xml, guid)
    with draft_of(path) as target:
        write_zip(target, members)
    return path


def xml_of(recipe: Recipe, xml: bytes, guid: str) -> bytes:
    """The completed model description."""
    return complete(xml, recipe.about, __version__, guid)


def _pack(recipe: Recipe, folder: Path) -> Path:
    """Sources under their content's name, packed by pythonfmu."""
    from pythonfmu.builder import FmuBuilder

    sources = dict(_sources(recipe))
    module, class_name = recipe.slave
    identity: tuple[object, ...] = (recipe.slave, recipe.values)
    if recipe.own:
        class_name = f"{recipe.own[1]}Plant"
        identity += (class_name,)
    if recipe.substep is not None:
        identity += (recipe.substep,)
    tag = digest(sources, repr(identity).encode())[:12]
    package = f"{_snake(class_name)}_{tag}"
    for name, text in sources.items():
        file = folder / package / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(ABSOLUTE_IMPORT.sub(rf"\1{package}.\2", text.decode()).encode())
    script = folder / f"{package}_slave.py"
    script.write_text(_script(recipe, package, module, class_name), encoding="utf-8")
    documentation = folder / "documentation"
    write_documentation(documentation, recipe.about, recipe.text, __version__, ASSETS / "license.txt")
    path, modules = list(sys.path), set(sys.modules)
    try:
        draft = folder / "draft.fmu"
        FmuBuilder.build_FMU(script, draft, [folder / package], documentation)
        return draft
    finally:
        sys.path[:] = path
        for name in set(sys.modules) - modules:
            if name.startswith(package):
                del sys.modules[name]


def _script(recipe: Recipe, package: str, module: str, class_name: str) -> str:
    """The file pythonfmu loads: the slave class, with other defaults where the recipe has them."""
    lines = [
        f"from {package}.fmus.lifetime import keep",
        f"from {package}.fmus.{module} import {recipe.slave[1]} as Base",
    ]
    if recipe.values or recipe.own or recipe.substep is not None:
        lines.append(f"from {package}.fmus.ports import model_ports")
    if recipe.own:
        lines.append(f"from {package}.{OWN} import {recipe.own[1]} as Own")
    lines += ["", "", f"class {class_name}(Base):", f'    """{recipe.about.description}."""']
    if recipe.values or recipe.own or recipe.substep is not None:
        model = "Own()" if recipe.own else "Base.model"
        changed = f"{model}.with_values({dict(recipe.values)!r})" if recipe.values else model
        changed += f".with_substep({recipe.substep!r})" if recipe.substep is not None else ""
        lines += ["", f"    model = {changed}", "    ports = model_ports(model)"]
    return "\n".join([*lines, "", "", "keep(globals(), locals())"]) + "\n"


def _sources(recipe: Recipe) -> Iterator[tuple[str, bytes]]:
    """Our sources that the FMU carries, by path within its package."""
    yield "__init__.py", b""
    if recipe.own:
        yield f"{OWN}.py", recipe.own[0].read_bytes()
    yield from ((path, text.encode()) for path, text in recipe.printed)
    for name in sorted({*RUNTIME, recipe.slave[0], *recipe.modules}):
        yield f"fmus/{name}.py", (ROOT / "fmus" / f"{name}.py").read_bytes()
    for package in recipe.packages:
        for file in sorted((ROOT / package).rglob("*.py")):
            path = file.relative_to(ROOT)
            if not any(path.is_relative_to(part) for part in (*BUILD_TIME, *recipe.without)):
                yield path.as_posix(), file.read_bytes()


def _members(archive: Path) -> Iterator[tuple[str, bytes]]:
    with zipfile.ZipFile(archive) as packed:
        for name in sorted(packed.namelist()):
            yield name, packed.read(name)
    if (icon := ASSETS / "model.png").exists():
        yield "model.png", icon.read_bytes()


def write_zip(path: Path, members: dict[str, bytes]) -> None:
    """An archive whose bytes hang on nothing but its members."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as packed:
        for name in sorted(members):
            info = zipfile.ZipInfo(name, EPOCH)
            info.compress_type, info.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            packed.writestr(info, members[name])


def digest(members: dict[str, bytes], more: bytes) -> str:
    """SHA-256 over names and contents."""
    sha = hashlib.sha256()
    for name in sorted(members):
        sha.update(f"{name}\0{len(members[name])}\0".encode())
        sha.update(members[name])
    sha.update(more)
    return sha.hexdigest()


def _snake(name: str) -> str:
    return re.sub(r"(?<!^)(?=[A-Z])", "_", name).lower()
