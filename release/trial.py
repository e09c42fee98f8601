"""Try the distributions of dist/ in empty environments: no compiler, and no network but a folder of wheels.

The folder, dist/wheels, is collected once, where there is network. Every command of docs/install.md, of two tutorials,
of the Containerfile and of the example for CI is then run verbatim.
"""

from __future__ import annotations

import argparse
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from release.dist import DIST, ROOT, program

WHEELS = DIST / "wheels"
TOOLS = ("pip", "setuptools>=77", "build", "pipx", "uv")  # of those who install; the sdists need setuptools
PROGRAMS = (
    *("bash", "sh", "env", "ls", "cat", "cp", "mv", "rm", "mkdir", "ln", "test", "tee", "uname", "dirname", "basename"),
    *("chmod", "python3"),
)
COMPILERS = ("gcc", "cc", "clang", "c99", "tcc", "zig", "cl")
BUILDERS = ("podman", "docker", "buildah")
NOT_HERE = ("make ", *(f"{name} " for name in BUILDERS))  # run before, or where there is a builder
BASH = shutil.which("bash") or "bash"
TIME_LIMIT = 3600  # of a command [s]; a busy machine takes many times as long as an idle one


def collect() -> None:
    """Download wheels of everything that the distributions need; do nothing if dist/wheels has them already."""
    WHEELS.mkdir(parents=True, exist_ok=True)
    done, wanted = WHEELS / "complete", (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    if done.is_file() and done.read_text(encoding="utf-8") == wanted:
        return
    extras = {"fmu_cosim": "[refine]"}
    names = ((path.name.split("-")[0], path) for path in sorted(DIST.glob("*.whl")))
    ours = [f"{name}{extras.get(name, '')} @ {path.as_uri()}" for name, path in names]
    listed = subprocess.run(
        [program("uv"), "pip", "compile", "--quiet", "--only-binary", ":all:", "-"],
        input="\n".join((*ours, *TOOLS)), capture_output=True, text=True, check=True,
    )  # fmt: skip
    pins = [line for line in listed.stdout.splitlines() if "==" in line]
    # pip resolves for minutes; these are all already
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--only-binary=:all:", "--no-deps"]
    subprocess.run([*command, "--dest", str(WHEELS), *pins], check=True, stderr=subprocess.DEVNULL)
    done.write_text(wanted, encoding="utf-8")


@cache
def isolation() -> list[str]:
    """Return the words before a command that take the network from it; empty where the system has none."""
    for options in ([], ["--map-root-user"]):
        words = [shutil.which("unshare") or "", *options, "--net"]
        if words[0] and not subprocess.run([*words, "true"], capture_output=True).returncode:
            return words
    return []


@dataclass
class Place:
    """An empty folder with an environment of Python of its own.

    Attributes:
        folder: Current folder of the commands.
        output: What the last command printed.
    """

    folder: Path
    wheels: Path = WHEELS
    output: str = ""
    variables: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        programs = self.folder.parent / f"{self.folder.name}-programs"
        for path in (self.folder, programs, self.home):
            path.mkdir(parents=True)
        for name in PROGRAMS:
            if found := shutil.which(name, path="/usr/bin:/bin"):
                (programs / name).symlink_to(found)
        python = programs / "python3"
        python.unlink(missing_ok=True)
        python.symlink_to(Path(sys.base_prefix) / "bin" / f"python3.{sys.version_info.minor}")
        subprocess.run([python, "-m", "venv", str(self.environment)], check=True)
        search = os.pathsep.join((str(self.environment / "bin"), str(self.home / ".local" / "bin"), str(programs)))
        if compilers := [name for name in COMPILERS if shutil.which(name, path=search)]:
            raise RuntimeError(f"a compiler in the empty environment: {', '.join(compilers)}")
        self.variables = {
            **{
                "PATH": search,
                "HOME": str(self.home),
                "LANG": "C.UTF-8",
                "PIP_CONFIG_FILE": os.devnull,
                "PIP_NO_COMPILE": "1",
            },
            **{"PIP_NO_INDEX": "1", "PIP_FIND_LINKS": str(self.wheels), "PIP_DISABLE_PIP_VERSION_CHECK": "1"},
            **{"UV_NO_INDEX": "1", "UV_FIND_LINKS": str(self.wheels), "UV_OFFLINE": "1", "UV_NO_PROGRESS": "1"},
            **{"UV_PYTHON_DOWNLOADS": "never", "PYTHONWARNINGS": "ignore"},
        }

    @property
    def home(self) -> Path:
        """Return the home folder."""
        return self.folder.parent / f"{self.folder.name}-home"

    @property
    def environment(self) -> Path:
        """Return the folder of the environment of Python."""
        return self.folder.parent / f"{self.folder.name}-python"

    def run(self, line: str, *, options: Sequence[str] = ("-e",), code: int | None = None) -> str:
        """Run a line of bash; return its output.

        Args:
            line: Command; a comment `# exit code 5` states its exit code.
            code: Exit code in place of the comment's.

        Raises:
            RuntimeError: Another exit code.
        """
        stated = re.search(r"# exit code (\d+)", line)
        wanted = code if code is not None else int(stated[1]) if stated else 0
        begin = time.monotonic()
        done = subprocess.run(
            [*isolation(), BASH, *options, "-c", line], cwd=self.folder, env=self.variables, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=TIME_LIMIT,
        )  # fmt: skip
        self.output = done.stdout
        print(f"{time.monotonic() - begin:6.1f} s  {line.splitlines()[0]}", flush=True)
        if done.returncode != wanted:
            raise RuntimeError(f"exit code {done.returncode}, not {wanted}: {line}\n{done.stdout}")
        return done.stdout


def typed(document: Path) -> Iterator[str]:
    """Yield the commands that a document shows, without those that need a checkout or a builder."""
    for block in re.findall(r"```sh\n(.*?)```", document.read_text(encoding="utf-8"), re.DOTALL):
        yield from (line for line in block.splitlines() if line and not line.startswith(NOT_HERE))


def recipe(path: Path) -> Iterator[tuple[str, str]]:
    """Yield the instructions of a Containerfile with their texts."""
    for line in path.read_text(encoding="utf-8").replace("\\\n", " ").splitlines():
        if line and not line.startswith("#"):
            name, text = line.split(maxsplit=1)
            yield name, text


def steps(workflow: Path) -> Iterator[str]:
    """Yield the commands of the first job of a workflow."""
    content: Any = YAML(typ="safe").load(workflow)
    (first, *_) = content["jobs"].values()
    for step in first["steps"]:
        if "run" in step and "hashFiles" not in str(step.get("if", "")):
            yield step["run"]


# -- the trials -----------------------------------------------------------------------------------------


def try_documents(folder: Path) -> None:
    """Run the page about the installation, then a tutorial with what it installed, and the worked example."""
    place = Place(folder)
    (place.folder / "dist").mkdir()
    for path in DIST.glob("fmu_cosim*"):
        shutil.copy(path, place.folder / "dist")
    for part in ("examples/tanks", "scenarios"):
        shutil.copytree(ROOT / part, place.folder / part, ignore=shutil.ignore_patterns("*.csv"))
    place.run("python -m pip install pipx uv build")
    for document in ("install.md", "my_fmus.md"):
        for line in typed(ROOT / "docs" / document):
            place.run(line)
    place.run("python -m pip install dist/*.whl")
    build = "cosim build --model hovercraft"
    for line in (f"{build} --out build", "cosim run scenarios/regulate.yaml --out results/regulate"):
        place.run(line)
    place.run(f"{build} --native --out native", code=2)  # needs a compiler: that there is none has been tried


def try_refine(folder: Path) -> None:
    """Run the tutorial of a log, which fits and refines, without a compiler."""
    place = Place(folder)
    shutil.copytree(ROOT / "examples/tanks", place.folder / "examples/tanks", ignore=shutil.ignore_patterns("*.csv"))
    place.run(f'python -m pip install "$(ls {DIST}/fmu_cosim-*.whl)[refine]"')  # a compiler that pip installs
    for name in ("tank", "level_control"):
        place.run(f"pythonfmu build -f examples/tanks/{name}.py --dest build")
    for line in typed(ROOT / "docs" / "my_log.md"):
        place.run(line)


def try_sdists(folder: Path) -> None:
    """Install the sdists, which have their build tools in the folder of wheels."""
    place = Place(folder)
    place.run("python -m pip install " + shlex.join(sorted(str(path) for path in DIST.glob("fmu_cosim*.tar.gz"))))
    place.run("cosim --version && cosim build --model hovercraft --out build && cosim info build/plant.fmu")


def try_container(folder: Path) -> None:
    """Run the commands of the Containerfile, and build its image if one of `BUILDERS` has the base image."""
    place = Place(folder)
    for name, text in recipe(ROOT / "Containerfile"):
        if name == "COPY":
            *sources, target = shlex.split(text)
            inside = place.folder / target.lstrip("/")
            inside.mkdir(parents=True, exist_ok=True)
            for source in sources:
                for path in ROOT.glob(source):
                    shutil.copy(path, inside)
        elif name == "RUN":
            place.run(text.replace("/opt/", f"{place.folder}/opt/"))
        elif name == "ENTRYPOINT":
            place.run(shlex.join([*re.findall(r'"([^"]+)"', text), "--help"]))
    built = [name for name in BUILDERS if shutil.which(name) and has_image(name)]
    for name in built[:1]:
        subprocess.run([name, "build", "--file", "Containerfile", "--tag", "cosim", "."], cwd=ROOT, check=True)
    print("         the container " + (f"was built by {built[0]}" if built else "was not built: no builder here"))


def has_image(builder: str) -> bool:
    """Return whether a builder works and gets the base image."""
    (base,) = (text for name, text in recipe(ROOT / "Containerfile") if name == "FROM")
    try:
        return not subprocess.run([builder, "pull", base], capture_output=True, timeout=300).returncode
    except subprocess.TimeoutExpired:
        return False


def try_workflow(folder: Path) -> None:
    """Run the commands of the example for CI in a repository as it describes one."""
    place = Place(folder)
    for part in ("wheels", "fmus"):
        (place.folder / part).mkdir()
    for path in DIST.glob("fmu_cosim-*.whl"):
        shutil.copy(path, place.folder / "wheels")
    place.variables["GITHUB_STEP_SUMMARY"] = str(place.folder / "summary.md")
    options, made = ("--noprofile", "--norc", "-eo", "pipefail"), False
    for line in steps(ROOT / "examples" / "ci" / "cosim.yml"):
        place.run(line, options=options)
        if not made:  # the first step has installed cosim, which brings PythonFMU
            made = True
            for name in ("tank", "level_control"):
                place.run(f"pythonfmu build -f {ROOT / 'examples' / 'tanks' / name}.py --dest fmus")
            place.run("cosim init fmus/Tank.fmu fmus/Controller.fmu --out scenario.yaml")
    for name in ("site/index.html", "summary.md"):
        if not (place.folder / name).is_file():
            raise RuntimeError(f"the example for CI left no {name}")


TRIALS: Mapping[str, Callable[[Path], None]] = {
    "documents": try_documents,
    "refine": try_refine,
    "sdists": try_sdists,
    "container": try_container,
    "workflow": try_workflow,
}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run trials; return 1 at the first command that fails."""
    options = argparse.ArgumentParser(description="Try the distributions of dist/ in empty environments.")
    options.add_argument("trials", nargs="*", choices=[*TRIALS, []], help="default: all")
    chosen = options.parse_args(arguments).trials or list(TRIALS)
    collect()
    if not isolation():
        print("no network namespaces here: only pip and uv are kept from the network")
    for name in chosen:
        print(name)
        with tempfile.TemporaryDirectory() as folder:
            try:
                TRIALS[name](Path(folder) / name)
            except (RuntimeError, subprocess.TimeoutExpired) as error:
                print(error)
                return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
