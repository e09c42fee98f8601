"""A worker in a process of its own."""

from __future__ import annotations

import os
import signal
import sys
import threading
import time

import pytest

from cosim.core.errors import Crashed, TimedOut
from cosim.isolation.limits import Limits
from cosim.isolation.process import Worker
from cosim.isolation.rows import OTHER
from cosim.isolation.watch import Watch


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


@pytest.mark.skipif(sys.platform == "win32", reason="no signal stops a process")
def test_a_limit_of_computing_leaves_out_the_time_in_which_the_machine_does_other_work() -> None:
    def watch(*, computing: bool) -> Watch:
        return Watch(("own",), limits=Limits(load=1.0, step=1.0), computing=computing)

    numbers = range(8_000_000)
    with Worker("json") as own:
        pid = own.call(os.getpid)
        os.kill(pid, signal.SIGSTOP)
        threading.Timer(1.6, os.kill, (pid, signal.SIGCONT)).start()
        assert own.call(sum, numbers, watch=watch(computing=True), doing=OTHER) == sum(numbers)
        os.kill(pid, signal.SIGSTOP)
        with pytest.raises(TimedOut):
            own.call(sum, numbers, watch=watch(computing=False), doing=OTHER)
        with pytest.raises(TimedOut):
            own.call(time.sleep, 30.0, watch=watch(computing=True), doing=OTHER)
