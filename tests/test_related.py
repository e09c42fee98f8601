"""Files that an FMU carries by FMI-LS-REF: written, read again, run by `cosim check`, and wrong ones named."""

from __future__ import annotations

import math
import posixpath
import re
import zipfile
from hashlib import sha3_256, sha256
from pathlib import Path
from shutil import copyfile
from types import SimpleNamespace
from typing import Any
from urllib.parse import quote

import numpy as np
import pytest

import cosim
from cosim.base.errors import InputError
from cosim.fmi.related_files import (
    CSV,
    DESCRIPTION,
    EXPERIMENTS,
    FOLDER,
    MANIFEST,
    NAME,
    Experiment,
    RelatedFile,
    add_related,
    experiments_text,
    manifest_text,
    member_of,
    read_experiments,
    read_manifest,
)
from cosim.refinement.proof.carried import carry_sealed_logs
from cosim.related import experiments
from cosim.storage.archive import BadArchive
from tests.decay import decay_fmu
from tests.instants import CONSTANT, instants_fmu
from tests.tank import MODEL

FILES = (
    RelatedFile("mymodel.mo", "model", "text/modelica", "source", (("variant:a", "first"), ("os:Linux", ""))),
    RelatedFile("tests/smoke.exp", "experiment/smoke-test", EXPERIMENTS),
    RelatedFile("../../documentation/notes.txt", "document", "text/plain"),
    RelatedFile("state.bin", "serialized-state/x86_64-linux"),
)
RUNS = [
    Experiment("one", "from rest", 0.0, 1.0, 0.01, 1e-6, "one.ssv", "in.csv", "out.csv"),
    Experiment("two", stop=0.1 + 0.2),
]
HEAD = f'xmlns:n="http://fmi-standard.org/fmi-ls-manifest" n:fmi-ls-name="{NAME}" n:fmi-ls-version="1.0.0-alpha.1"'
SSV = b"""<?xml version="1.0"?>
<ssv:ParameterSet xmlns:ssv="http://ssp-standard.org/SSP1/SystemStructureParameterValues" version="1.0" name="start">
  <ssv:Parameters><ssv:Parameter name="y_start"><ssv:Real value="2"/></ssv:Parameter></ssv:Parameters>
</ssv:ParameterSet>
"""


def _decay(rate: float = 1.0, begin: float = 1.0, stop: float = 1.0) -> bytes:
    time = np.linspace(0.0, stop, 11)
    return "\n".join(["time,y", *(f"{t!r},{begin * math.exp(-rate * t)!r}" for t in time.tolist())]).encode()


@pytest.fixture(scope="module")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return decay_fmu(tmp_path_factory.mktemp("decay") / "decay.fmu")


def _with(fmu: Path, folder: Path, *files: tuple[RelatedFile, bytes], **more: bytes) -> Path:
    path = folder / "decay.fmu"
    copyfile(fmu, path)
    add_related(path, files, {name.replace("_", "."): text for name, text in more.items()})
    return path


def _with_manifest(fmu: Path, folder: Path, text: str) -> Path:
    path = folder / "decay.fmu"
    copyfile(fmu, path)
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr(MANIFEST, text)
    return path


def test_what_is_written_is_read_again() -> None:
    manifest = read_manifest(manifest_text(FILES))
    assert manifest.files == FILES
    assert not manifest.warnings
    assert read_experiments("a.exp", experiments_text("all", RUNS)) == RUNS
    for word in ("nan", "inf", "1 s"):
        text = f'<Experiments><Experiment name="a" stopTime="{word}"/></Experiments>'
        with pytest.raises(BadArchive, match="stopTime"):
            read_experiments("a.exp", text.encode())


@pytest.mark.parametrize(
    ("uri", "member"),
    [
        ("a.csv", f"{FOLDER}/a.csv"),
        ("a%20b.csv", f"{FOLDER}/a b.csv"),
        ("../../documentation/a.txt", "documentation/a.txt"),
        ("../../../etc/passwd", None),
        ("/etc/passwd", None),
        ("https://example.org/a.csv", None),
        ("..\\a", None),
        ("", None),
    ],
)
def test_a_uri_stays_within_the_archive(uri: str, member: str | None) -> None:
    assert member_of(FOLDER, uri) == member


def test_a_manifest_of_the_alpha_version_without_its_description_is_read_with_a_warning() -> None:
    manifest = read_manifest(f'<fmiReferences {HEAD}><Related source="a.csv" role="result"/></fmiReferences>'.encode())
    assert [f.source for f in manifest.files] == ["a.csv"]
    assert [w.code for w in manifest.warnings] == ["W-FMI-019"]


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("<fmiReferences", "E-STO"),
        (f"<references {HEAD}/>", "E-FMI-012"),
        ("<fmiReferences/>", "E-FMI-010"),
        (f'<fmiReferences {HEAD}><Related source="a.csv"/></fmiReferences>', "E-FMI-011"),
        (f'<fmiReferences {HEAD}><Related source="a.csv" role="toy"/></fmiReferences>', "E-FMI-013"),
        (f'<fmiReferences {HEAD}><Related source="a.csv" role="result" foo="1"/></fmiReferences>', "E-FMI-020"),
        (f"<fmiReferences {HEAD}><Toy/></fmiReferences>", "E-FMI-017"),
    ],
)
def test_a_wrong_manifest_is_a_fault_of_the_fmu(fmu: Path, tmp_path: Path, text: str, code: str) -> None:
    path = _with_manifest(fmu, tmp_path, text)
    with pytest.raises(InputError) as error:
        cosim.check(path, load=False)
    (fault,) = error.value.faults
    assert fault.exit_code == 3
    assert fault.code.startswith(code)


def test_a_newer_version_and_files_that_are_not_there_are_warnings(fmu: Path, tmp_path: Path) -> None:
    head = HEAD.replace("1.0.0-alpha.1", "1.2.0")
    files = "".join(f'<Related source="{s}" role="result" type="text/csv"/>' for s in ("a.csv", "http://b/a.csv"))
    path = _with_manifest(fmu, tmp_path, f"<fmiReferences {head}>{files}</fmiReferences>")
    codes = [getattr(line, "code", "") for line in cosim.check(path, load=False)]
    assert codes[-5:] == ["W-FMI-018", "W-FMI-019", "W-REL-001", "W-REL-002", "N-REL-004"]


def test_a_later_version_may_have_other_attributes(fmu: Path, tmp_path: Path) -> None:
    head = HEAD.replace("1.0.0-alpha.1", "1.2.0")
    manifest = read_manifest(
        f'<fmiReferences {head}><Related source="a" role="other" foo="1"/></fmiReferences>'.encode()
    )
    assert [w.code for w in manifest.warnings][-1] == "W-FMI-021"


@pytest.mark.parametrize(
    ("checksum", "kind", "code"),
    [
        (sha3_256(b"model").hexdigest().upper(), "", ""),
        (sha256(b"model").hexdigest(), "SHA-256", ""),
        ("00ff", "SHA3-256", "W-REL-014"),
        ("00ff", "MD5", "W-REL-015"),
    ],
)
def test_a_checksum_is_checked_and_kept(fmu: Path, tmp_path: Path, checksum: str, kind: str, code: str) -> None:
    file = RelatedFile("a.mo", "model", checksum=checksum, checksum_type=kind)
    path = _with(fmu, tmp_path, (file, b"model"))
    codes = [getattr(line, "code", "") for line in cosim.check(path, load=False)]
    assert [c for c in codes if c.startswith("W-REL")] == ([code] if code else [])
    assert read_manifest(manifest_text([file])).files == (file,)


def test_expected_results_are_compared_with_the_default_experiment(fmu: Path, tmp_path: Path) -> None:
    result = RelatedFile("out.csv", "result", CSV)
    path = _with(fmu, tmp_path, (result, _decay()))
    assert any(getattr(line, "code", "") == "N-REL-005" for line in cosim.check(path))
    assert [line for line in cosim.check(path, load=False) if getattr(line, "code", "") == "N-REL-004"]
    path = _with(fmu, tmp_path, (result, _decay(rate=1.1)))
    with pytest.raises(InputError) as error:
        cosim.check(path)
    (fault,) = error.value.faults
    assert (fault.code, fault.exit_code) == ("E-REL-006", 5)
    assert "most y, by" in fault.message


def test_expected_results_that_cannot_be_read_are_a_fault_of_the_fmu(fmu: Path, tmp_path: Path) -> None:
    path = _with(fmu, tmp_path, (RelatedFile("out.csv", "result", CSV), b"y,z\n0,1\n1,2\n"))
    with pytest.raises(InputError, match=r'"default experiment" .* cannot be compared .*: extra/.*out.csv') as error:
        cosim.check(path)
    (fault,) = error.value.faults
    assert (fault.exit_code, fault.file) == (3, path)


def test_expected_results_without_a_signal_of_the_fmu_are_named_as_such(fmu: Path, tmp_path: Path) -> None:
    path = _with(fmu, tmp_path, (RelatedFile("out.csv", "result", CSV), _decay().replace(b",y", b",height")))
    with pytest.raises(InputError) as error:
        cosim.check(path)
    (fault,) = error.value.faults
    assert (fault.code, fault.exit_code) == ("E-REL-013", 3)
    assert "is run to its end" in fault.message
    assert fault.message.endswith("out.csv: none of its signals is a signal of the FMU: height")


def test_several_files_of_expected_results_have_names_of_their_own(fmu: Path, tmp_path: Path) -> None:
    files = [(RelatedFile(f"{name}.csv", "result", CSV), _decay()) for name in ("a", "b")]
    lines = [line for line in cosim.check(_with(fmu, tmp_path, *files)) if getattr(line, "code", "") == "N-REL-005"]
    assert [line.partition('"')[2].partition('"')[0] for line in lines] == [
        "default experiment, a.csv", "default experiment, b.csv",
    ]  # fmt: skip


@pytest.mark.parametrize("folder", ["a b", "50%", "sub/./x"])
def test_an_experiment_in_a_folder_with_an_encoded_name_reads_the_files_beside_it(
    fmu: Path, tmp_path: Path, folder: str
) -> None:
    run = Experiment("from two", stop=1.0, step=0.1, parameters="two.ssv", references="out.csv")
    place = posixpath.normpath(f"{FOLDER}/{folder}")
    members = {f"{place}/a.exp": experiments_text("a", [run]), f"{place}/two.ssv": SSV}
    members |= {f"{place}/out.csv": _decay(begin=2.0)}
    members |= {MANIFEST: manifest_text([RelatedFile(f"{quote(folder)}/a.exp", "experiment", EXPERIMENTS)])}
    path = tmp_path / "decay.fmu"
    copyfile(fmu, path)
    with zipfile.ZipFile(path, "a") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    assert any('"from two"' in line and "1 signal within" in line for line in cosim.check(path))


def test_an_experiment_sets_parameters_and_inputs(fmu: Path, tmp_path: Path) -> None:
    run = Experiment("from two", stop=1.0, step=0.1, parameters="two.ssv", references="out.csv")
    file = RelatedFile("a.exp", "experiment", EXPERIMENTS)
    path = _with(fmu, tmp_path, (file, experiments_text("a", [run])), two_ssv=SSV, out_csv=_decay(begin=2.0))
    assert any('"from two"' in line and "1 signal within" in line for line in cosim.check(path))
    path = _with(fmu, tmp_path, (file, experiments_text("a", [run])), two_ssv=SSV, out_csv=_decay())
    with pytest.raises(InputError, match='"from two" is not reproduced'):
        cosim.check(path)


def test_files_that_an_experiment_names_and_the_fmu_lacks_are_warnings(fmu: Path, tmp_path: Path) -> None:
    run = Experiment("lost", parameters="two.ssv", stimuli="../../../in.csv", references="out.csv")
    file = RelatedFile("a.exp", "experiment", EXPERIMENTS)
    path = _with(fmu, tmp_path, (file, experiments_text("a", [run])), two_ssv=SSV)
    notes = [line for line in cosim.check(path, load=False) if getattr(line, "code", "").startswith("W-REL")]
    assert [note.partition("warning: ")[2] for note in notes] == [
        'a.exp names ../../../in.csv (stimuli of experiment "lost"), outside the FMU; it is not read',
        'a.exp names out.csv (references of experiment "lost"), which is not in the FMU',
    ]


def test_stimuli_tick_triggered_clocks(tmp_path: Path) -> None:
    fmu = instants_fmu(tmp_path / "scheduled.fmu", CONSTANT, scheduled=True)
    run = Experiment("ticks", stop=1.0, step=0.1, stimuli="in.csv", references="out.csv")
    times = [round(0.1 * k, 1) for k in range(11)]
    stimuli = "".join(f"{t},{int(t in (0.2, 0.5))}\n" for t in times)
    expected = "".join(f"{t},{k},{int(t >= 0.2) + int(t >= 0.5)}\n" for k, t in enumerate(times, 1))
    members = {"in.csv": f"time,trigger\n{stimuli}".encode(), "out.csv": f"time,ticks,triggered\n{expected}".encode()}
    add_related(fmu, [(RelatedFile("a.exp", "experiment", EXPERIMENTS), experiments_text("a", [run]))], members)
    assert any('"ticks": 2 signals within' in line and "no difference" in line for line in cosim.check(fmu))


def test_a_default_experiment_without_its_expected_results_is_run(fmu: Path, tmp_path: Path) -> None:
    lost = f'<fmiReferences {HEAD}><Related source="a.csv" role="result" type="text/csv"/></fmiReferences>'
    codes = [getattr(line, "code", "") for line in cosim.check(_with_manifest(fmu, tmp_path, lost))]
    assert codes[-2:] == ["W-REL-001", "N-REL-008"]


@pytest.mark.parametrize(("step", "exchange", "said"), [(1e-3, True, True), (1e-3, False, False), (1.0, True, False)])
def test_co_simulation_of_too_many_internal_steps_gives_way_to_model_exchange(
    step: float, exchange: bool, said: bool
) -> None:
    description = SimpleNamespace(
        coSimulation=SimpleNamespace(fixedInternalStepSize=step),
        modelExchange=SimpleNamespace() if exchange else None,
        defaultExperiment=SimpleNamespace(startTime="1e-5", stopTime="1e8"),
    )
    notes = experiments._too_fine(description, experiments.with_default(Path("a.fmu"), Path(), ""))
    assert [note.code for note in notes] == ["N-REL-011"] * said


def test_other_types_are_listed(fmu: Path, tmp_path: Path) -> None:
    file = RelatedFile("a.mo", "model", "text/modelica", "the source", (("variant:a", ""),))
    path = _with(fmu, tmp_path, (file, b"model A end A;"))
    assert any(
        line.endswith("a.mo: model, text/modelica, variant:a (the source); not run") for line in cosim.check(path)
    )


def test_files_of_an_earlier_manifest_stay(fmu: Path, tmp_path: Path) -> None:
    path = _with(fmu, tmp_path, (FILES[0], b"model A end A;"))
    add_related(path, [(FILES[1], b"")])
    with zipfile.ZipFile(path) as archive, zipfile.ZipFile(fmu) as original:
        assert [f.source for f in read_manifest(archive.read(MANIFEST)).files] == [FILES[0].source, FILES[1].source]
        assert all(archive.read(name) == original.read(name) for name in original.namelist())
        assert DESCRIPTION.encode() in archive.read(MANIFEST)
        assert len(set(archive.namelist())) == len(archive.namelist())


def test_the_fmu_of_a_model_reproduces_the_experiment_that_its_equations_gave(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(MODEL, encoding="utf-8")
    (built,) = cosim.build(tmp_path, f"{tmp_path / 'tank.py'}:Tank")
    (line,) = [line for line in cosim.check(built) if getattr(line, "code", "") == "N-REL-005"]
    share = re.search(r"\(([\d.e−]+) % of its range\)", line)
    assert "; no difference" in line or (share is not None and float(share[1].replace("−", "-")) < 1e-7), line


def test_sealed_logs_are_run_as_experiments_and_their_errors_given(fmu: Path, tmp_path: Path) -> None:
    path = _with(fmu, tmp_path)
    time = np.linspace(0.0, 1.0, 11)
    outputs = {"y": np.where(time == 0.5, np.nan, np.exp(-time) + 0.01)}
    log: Any = SimpleNamespace(path=Path("friday.csv"), time=time, step=0.1, inputs={"u": 0.0 * time}, outputs=outputs)
    carry_sealed_logs([path], [log], {"verdict": "no_effect", "error": {"before": 1.0}})
    lines = cosim.check(path)
    assert any('experiment "friday": root mean square of the error y 0.01' in line for line in lines)
    with zipfile.ZipFile(path) as archive:
        assert b"no_effect" in archive.read(f"{FOLDER}/sealed-errors.json")


def test_a_manifest_that_declares_entities_is_refused() -> None:
    with pytest.raises(BadArchive, match="DOCTYPE"):
        read_manifest(b'<!DOCTYPE a [<!ENTITY b "c">]>' + manifest_text(FILES))
