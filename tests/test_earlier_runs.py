"""Earlier runs in results/NAME/runs: nothing is lost, nothing of the user moves, a move that is cut off is finished."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path

import pytest

from cosim.base.errors import InputError
from cosim.loading.file import load_model
from cosim.scenario.pinned import sha256, with_files_beside
from cosim.scenario.scenario import FmuComponent, Scenario
from cosim.storage import folders, table
from cosim.storage.folder_lock import folder_locks
from cosim.storage.folders import check_overwritable, keep_earlier
from cosim.storage.yaml_file import YamlFile
from tests.users import OTHER, shared_folder

FILES = ("manifest.json", "results.csv", "report.html", "figures/tank.png")


@pytest.fixture
def results(tmp_path: Path) -> Path:
    """The folder of a run, with files of the user in it."""
    folder = tmp_path / "results" / "tank"
    for name in (*FILES, "notes.txt", "figures/mine.svg", "mine/results.csv"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(name)
    return folder


def files_in(folder: Path) -> set[str]:
    """All files of a folder, from there."""
    return {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}


def test_files_of_the_verb_move_and_those_of_the_user_stay(results: Path) -> None:
    assert keep_earlier(results, "cosim run") == results / "runs" / "0001"
    assert files_in(results / "runs" / "0001") == set(FILES)
    assert files_in(results) - {"runs/.last", *(f"runs/0001/{n}" for n in FILES)} == {
        "notes.txt",
        "figures/mine.svg",
        "mine/results.csv",
    }
    assert keep_earlier(results, "cosim run") is None  # there is nothing any more
    assert {p.name for p in (results / "runs").iterdir()} == {"0001", ".last"}


def test_files_of_another_verb_whose_marks_are_there_move_too(results: Path) -> None:
    for name in ("refine.json", "model.yaml", "plant.fmu"):
        (results / name).write_text("parameters: {}\n")
    keep_earlier(results, "cosim run")
    assert files_in(results / "runs" / "0001") == {*FILES, "refine.json", "model.yaml", "plant.fmu"}


@pytest.mark.parametrize("cut", range(len(FILES) + 4))
def test_a_move_that_is_cut_off_anywhere_is_finished_by_the_next_verb(
    results: Path, monkeypatch: pytest.MonkeyPatch, cut: int
) -> None:
    """The process ends before the k-th of its moves; neither run is lost, and both stay whole."""
    real, count = Path.replace, 0

    class Killed(BaseException):
        pass

    def step(self: Path, target: Path) -> Path:
        nonlocal count
        count += 1
        if count > cut:
            raise Killed
        return real(self, target)

    everything = {name: (results / name).read_text() for name in files_in(results)}
    with monkeypatch.context() as patch:
        patch.setattr(Path, "replace", step)
        patch.setattr(Path, "rename", step)
        try:
            keep_earlier(results, "cosim run")
        except Killed:
            assert cut < len(FILES) + 3  # the list of files, each of them, the number, the folder
    with folder_locks():
        check_overwritable(results, "cosim run")
    # a run that is killed between the note of its number and its name gets the next number
    kept = results / "runs" / ("0002" if cut == len(FILES) + 2 else "0001")
    where = kept if kept.exists() else results
    assert {name for name in FILES if (where / name).is_file()} == set(FILES)
    if kept.exists():
        assert files_in(kept) == set(FILES)
        assert not set(FILES) & files_in(results)
    assert not (results / "runs" / folders.MOVING).exists()
    after = {p.read_text() for p in results.rglob("*") if p.is_file() and p.name != folders.LAST}
    assert after == set(everything.values())


def test_a_stop_during_the_move_waits_for_its_end(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import signal

    real, sent = folders._move, []
    # a shell's background job is started with it ignored
    before = signal.signal(signal.SIGINT, signal.default_int_handler)

    def moving(path: Path, place: Path) -> None:
        if not sent:
            sent.append(signal.raise_signal(signal.SIGINT))
        real(path, place)

    monkeypatch.setattr(folders, "_move", moving)
    try:
        with pytest.raises(KeyboardInterrupt):
            keep_earlier(results, "cosim run")
    finally:
        signal.signal(signal.SIGINT, before)
    assert sent
    assert files_in(results / "runs" / "0001") == set(FILES)


def test_a_second_run_at_the_same_time_is_refused_and_moves_nothing(results: Path) -> None:
    import subprocess
    import sys

    with folder_locks():
        check_overwritable(results, "cosim run")
        code = (
            "import sys; from pathlib import Path; from cosim.base.errors import InputError\n"
            "from cosim.storage.folder_lock import folder_locks; from cosim.storage.folders import check_overwritable\n"
            "with folder_locks():\n"
            "    try: check_overwritable(Path(sys.argv[1]), 'cosim run')\n"
            "    except InputError as error: sys.exit(str(error))\n"
        )
        root = Path(__file__).resolve().parent.parent
        done = subprocess.run(
            [sys.executable, "-c", code, str(results)], capture_output=True, text=True, timeout=60,
            env={**os.environ, "PYTHONPATH": str(root)},
        )  # fmt: skip
    assert "another command writes into this folder now" in done.stderr
    assert not (results / "runs").exists()


@pytest.mark.parametrize(("last", "following"), [("0009", "0010"), ("9999", "10000"), ("10000", "10001")])
def test_numbers_go_on_beyond_four_digits(results: Path, last: str, following: str) -> None:
    for name in (last, "0002", "notes"):
        (results / "runs" / name).mkdir(parents=True)
    assert keep_earlier(results, "cosim run") == results / "runs" / following


@pytest.mark.parametrize(("last", "following"), [("7", "0008"), ("12345", "12346"), ("x", "0002"), ("9" * 99, "0002")])
def test_the_number_of_a_removed_run_is_not_used_again(results: Path, last: str, following: str) -> None:
    first = keep_earlier(results, "cosim run")
    assert first is not None
    for _ in range(2):
        (results / "results.csv").touch()
        shutil.rmtree(keep_earlier(results, "cosim run") or results)
    assert (results / "runs" / ".last").read_text() == "3\n"
    (results / "runs" / ".last").write_text(last)
    (results / "results.csv").touch()
    assert keep_earlier(results, "cosim run") == results / "runs" / following


def test_input_files_and_folders_of_the_user_stay(results: Path) -> None:
    (results / "system").mkdir()
    (results / "system" / "tank.fmu").touch()
    (results / "refine.json").touch()
    keep_earlier(results, "cosim run", read=[results / "system" / "tank.fmu", results / "refine.json"])
    assert files_in(results / "runs" / "0001") == set(FILES)
    assert keep_earlier(results, "cosim refine", read=[results]) is None
    (results / "refine.json").unlink()
    (results / "figures" / "paper.png").touch()
    assert keep_earlier(results, "cosim run") is None  # no run has been here
    (results / "manifest.json").touch()
    os.utime(results / "figures" / "paper.png", (1e9, 1e9))  # older than the results
    assert keep_earlier(results, "cosim run") == results / "runs" / "0002"
    assert (results / "figures" / "paper.png").is_file()


def test_runs_that_is_a_file_of_the_user_is_refused_before_any_work(results: Path) -> None:
    (results / "runs").write_text("5 km, 10 km")
    with pytest.raises(InputError, match="is a file; earlier runs are kept in a folder of this name; move it away"):
        check_overwritable(results, "cosim run")
    assert (results / "runs").read_text() == "5 km, 10 km"


@pytest.mark.skipif(not hasattr(os, "fork") or os.geteuid() != 0, reason="only root can act as another user")
def test_runs_that_cannot_be_written_are_refused_before_any_work() -> None:
    with shared_folder() as folder:
        (folder / "results.csv").touch()
        (folder / "runs").mkdir(mode=0o755)
        pid = os.fork()
        if pid == 0:
            code = 1
            try:
                os.setuid(OTHER)
                check_overwritable(folder, "cosim run")
            except InputError as error:
                code = 3 if "cannot be written" in str(error) else 4
            finally:
                os._exit(code)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 3
        assert files_in(folder) == {"results.csv"}


def test_paths_upwards_in_our_files_are_told_from_the_new_place(tmp_path: Path) -> None:
    (tmp_path / "tank.py").write_text(
        (Path(__file__).resolve().parent.parent / "examples" / "tanks" / "model.py").read_text(encoding="utf-8")
    )
    folder = tmp_path / "results" / "study"
    folder.mkdir(parents=True)
    (folder / "refine.json").write_text("{}")
    (folder / "model.yaml").write_text("schema_version: 1\nmodel: ../../tank.py:Tank\nparameters: {}\n")
    (folder / "scenario.yaml").write_text('components:\n  a:\n    fmu: "../my tank.fmu"\n    file: beside.csv\n')
    keep_earlier(folder, "cosim refine", ["scenario.yaml"])
    kept = folder / "runs" / "0001"
    assert load_model(str(kept / "model.yaml"), Path()).model.title
    assert YamlFile(kept / "scenario.yaml").root["components"]["a"] == {
        "fmu": "../../../my tank.fmu", "file": "beside.csv",
    }  # fmt: skip
    assert not (folder / "model.yaml").exists()


def test_an_earlier_run_of_an_ssp_is_repeated_with_its_own_fmus(tmp_path: Path) -> None:
    """Its manifest names results/NAME/system, where a later run has put others."""
    newest, kept = tmp_path / "system" / "a.fmu", tmp_path / "runs" / "0001" / "system" / "a.fmu"
    for path, content in ((newest, "new"), (kept, "old")):
        path.parent.mkdir(parents=True)
        path.write_text(content)
    component = {"fmu": str(newest), "sha256": sha256(kept)}
    scenario = Scenario.model_validate({"name": "s", "duration": 1, "step": 0.1, "components": {"a": component}})
    found = with_files_beside(scenario, kept.parent.parent).components["a"]
    assert isinstance(found, FmuComponent)
    assert found.fmu == "system/a.fmu"


def test_rows_in_the_format_of_a_package_are_kept_too(results: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Acme(table.Source):
        name, suffixes, writes = "Acme", (".acme",), True

    known = table.sources()
    monkeypatch.setattr(table, "sources", lambda: (*known, Acme()))
    (results / "results.csv").rename(results / "results.acme")
    (results / "results.xlsx").write_text("a sheet of the user")
    assert keep_earlier(results, "cosim run") == results / "runs" / "0001"
    assert "results.acme" in files_in(results / "runs" / "0001")
    assert (results / "results.xlsx").exists()


# -- planted by others ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["../private.txt", "/etc/passwd", "linked/photo.png", "sub/../../private.txt", "runs/0001/a.csv", "a" * 300, ".rc"],
)
def test_a_planted_list_moves_no_file_of_another_place(results: Path, tmp_path: Path, name: str) -> None:
    (private := results.parent / "private.txt").write_text("mine")
    (photo := tmp_path / "elsewhere" / "photo.png").parent.mkdir()
    photo.write_text("mine too")
    (results / "linked").symlink_to(photo.parent)
    (moving := results / "runs" / folders.MOVING).mkdir(0o700, parents=True)
    (moving / folders.LIST).write_text(name)
    with folder_locks(), pytest.raises(InputError, match=re.escape(f"names {name[:80]}, outside")):
        check_overwritable(results, "cosim run")
    assert (private.read_text(), photo.read_text()) == ("mine", "mine too")


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
@pytest.mark.parametrize("kind", ["open to others", "link"])
def test_a_move_that_others_can_have_begun_is_not_finished(results: Path, tmp_path: Path, kind: str) -> None:
    moving, elsewhere = results / "runs" / folders.MOVING, tmp_path / "elsewhere"
    moving.parent.mkdir()
    elsewhere.mkdir(0o700)
    (elsewhere / folders.LIST).write_text("results.csv")
    if kind == "link":
        moving.symlink_to(elsewhere)
    else:
        elsewhere.rename(moving)
        moving.chmod(0o777)
    with folder_locks(), pytest.raises(InputError, match="is open to other users, or not yours; move it away"):
        check_overwritable(results, "cosim run")
    assert (results / "results.csv").is_file()


@pytest.mark.parametrize("name", ["runs", "figures", "system"])
def test_no_file_is_moved_or_written_through_a_link(results: Path, tmp_path: Path, name: str) -> None:
    (photo := tmp_path / "elsewhere" / "photo.png").parent.mkdir()
    photo.write_text("mine")
    shutil.rmtree(results / name, ignore_errors=True)
    (results / name).symlink_to(photo.parent)
    with folder_locks(), pytest.raises(InputError, match=f"{name}: is a link, so files would be moved or written"):
        check_overwritable(results, "cosim run", force=True)
    assert photo.is_file()


@pytest.mark.skipif(os.name == "nt" or os.geteuid() != 0, reason="only root can make a link of another user")
def test_a_results_folder_that_is_the_link_of_another_user_is_refused_before_its_lock(tmp_path: Path) -> None:
    (target := tmp_path / "target").mkdir()
    link = tmp_path / "link"
    link.symlink_to(target)
    check_overwritable(link, "cosim run")  # one of our own leads to another disk, for example
    os.chown(link, OTHER, OTHER, follow_symlinks=False)
    with folder_locks(), pytest.raises(InputError, match="is a link of another user; give another folder as --out"):
        check_overwritable(link, "cosim run")
    with folder_locks(), pytest.raises(InputError, match="is a link of another user"):
        check_overwritable(link / "tank", "cosim run")
    assert not list(target.iterdir())


def test_the_folder_of_an_earlier_run_is_as_open_as_the_folder_around_it(results: Path) -> None:
    kept = keep_earlier(results, "cosim run")
    assert kept is not None
    assert kept.stat().st_mode == kept.parent.stat().st_mode


@pytest.mark.skipif(os.name == "nt", reason="pipes and devices of POSIX")
@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_what_is_no_file_is_not_waited_for(results: Path, kind: str) -> None:
    (results / "manifest.json").unlink()
    if kind == "pipe":
        os.mkfifo(results / "manifest.json")
    else:
        (results / "manifest.json").symlink_to("/dev/zero")
    assert folders.content_of(results / "manifest.json") == {}


def test_a_planted_link_inside_a_move_is_not_followed(results: Path, tmp_path: Path) -> None:
    (home := tmp_path / "home").mkdir()
    (home / "tank.png").write_text("mine")
    (moving := results / "runs" / folders.MOVING).mkdir(0o700, parents=True)
    (moving / folders.LIST).write_text("figures/tank.png")
    (moving / "figures").symlink_to(home)
    with folder_locks(), pytest.raises(InputError, match="is a link, and earlier runs hold none"):
        check_overwritable(results, "cosim run")
    assert (home / "tank.png").read_text() == "mine"


def test_a_list_that_is_no_text_is_damaged(results: Path) -> None:
    (moving := results / "runs" / folders.MOVING).mkdir(0o700, parents=True)
    (moving / folders.LIST).write_bytes(b"\xff\xfe")
    with folder_locks(), pytest.raises(InputError, match=r"\.files: is damaged; move .* away"):
        check_overwritable(results, "cosim run")


def test_the_target_of_a_linked_file_is_not_copied(results: Path, tmp_path: Path) -> None:
    (secret := tmp_path / "secret.yaml").write_text("fmu: ../x\npassword: 1\n")
    (results / "scenario.yaml").symlink_to(secret)
    kept = keep_earlier(results, "cosim run", also=["scenario.yaml"])
    assert kept is not None
    assert (kept / "scenario.yaml").is_symlink()
    assert secret.read_text() == "fmu: ../x\npassword: 1\n"


@pytest.mark.skipif(os.name == "nt", reason="permissions of POSIX")
def test_an_adapted_file_stays_private(results: Path) -> None:
    (results / "scenario.yaml").write_text("fmu: ../x\n")
    (results / "scenario.yaml").chmod(0o600)
    kept = keep_earlier(results, "cosim run", also=["scenario.yaml"])
    assert kept is not None
    assert (kept / "scenario.yaml").read_text() == "fmu: ../../../x\n"
    assert (kept / "scenario.yaml").stat().st_mode & 0o777 == 0o600
