"""A worker in a process of its own."""

from __future__ import annotations

import os

import pytest

from cosim.core.errors import Crashed
from cosim.isolation.process import Worker


def test_jobs_are_done_by_one_process_elsewhere_and_after_a_crash_by_another() -> None:
    with Worker("json") as own:
        first, folder = own.call(os.getpid), own.folder
        assert own.call(os.getpid) == first != os.getpid()
        assert own.call(os.getenv, "TMPDIR") == str(folder)  # what FMUs leave goes with the worker
        with pytest.raises(Crashed, match=r"the worker ended the process, exit code 3$"):
            own.call(os._exit, 3)
        assert own.call(os.getpid) != first
        assert not folder.exists()
        folder = own.folder
    assert not folder.exists()
    own.end()  # once more is no harm
