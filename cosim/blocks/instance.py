"""Life cycle of an FMU instance: unpacking, loading, messages, status values and freeing."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from cosim.blocks.compiling import compile_library
from cosim.blocks.component import EarlyEnd
from cosim.blocks.fmi import DISCARD, Calls, Step
from cosim.blocks.loading import load_error
from cosim.blocks.model_exchange import ModelExchange
from cosim.blocks.shared_code import claim, own_symbols_first
from cosim.core.drafts import is_full
from cosim.core.errors import CallFailed, DiskFull, FmuError, Terminated
from cosim.core.scratch import process_folder
from cosim.files.archive import unpack
from cosim.fmi.description import C_CODE, library_of, no_library, platform_of, platforms_among
from cosim.fmi.guard import without_wrapping
from cosim.fmi.lifetime import let_go_at_exit

STATUS = ("OK", "Warning", "Discard", "Error", "Fatal", "Pending")
WARNING, FATAL = 1, 4
LONGEST_MESSAGE = 1000  # characters
KEPT_FIRST, KEPT_LAST = 50, 50  # messages


class MessageLog:
    """The first and the last messages of an FMU, each text once, and the number of those between.

    Attributes:
        share: Function called with each message, if any.
    """

    def __init__(self) -> None:
        self.first: list[str] = []
        self.last: deque[str] = deque(maxlen=KEPT_LAST)
        self.omitted = 0
        self.share: Callable[[str], None] | None = None

    def __iter__(self) -> Iterator[str]:
        """Yield the messages, with a note in place of those between."""
        yield from self.first
        if self.omitted:
            yield (
                f"{self.omitted:,} messages are left out here: the first {len(self.first)} and the last "
                f"{len(self.last)} are recorded"
            )
        yield from self.last

    def append(self, text: str) -> None:
        """Add a message."""
        if self.share is not None:
            self.share(text)
        if text in self.first:
            return
        if len(self.first) < KEPT_FIRST:
            self.first.append(text)
            return
        if text in self.last:
            self.last.remove(text)
        self.omitted += len(self.last) == KEPT_LAST
        self.last.append(text)

    def state(self) -> dict[str, Any]:
        """Return the messages in JSON types."""
        return {"first": [*self.first], "last": [*self.last], "omitted": self.omitted}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the messages of a state."""
        self.first, self.omitted = list(state["first"]), int(state["omitted"])
        self.last = deque(state["last"], maxlen=KEPT_LAST)


class Instance:
    """An FMU instance and the folder of its unpacked FMU.

    Attributes:
        fmu: FMPy's object, None before loading and after Fatal; `component` is C's pointer.
        log: Messages and warnings.
        time: Reached time [s], for messages.
        place: Folder of the already unpacked FMU, left unchanged.
        logging: Whether debug logging is on.
        compiles: Whether sources may be compiled for a missing library.
    """

    def __init__(self, path: Path, calls: Calls, *, logging: bool = False, compiles: bool = False) -> None:
        self.path, self.calls, self.name, self.description = path, calls, calls.name, calls.description
        self.by_pythonfmu = "pythonfmu" in (self.description.generationTool or "").lower()
        self.log = MessageLog()
        self.step_name = f"{calls.prefix}DoStep"
        self.fmu: Any = None
        self.component: Any = None
        self.place: Path | None = None
        self.time = 0.0
        self.initialized = False
        self._logging, self._compiles = logging, compiles
        self._folder: Path | None = None
        self._stop: BaseException | None = None
        self._words = ""  # last message

    # -- life cycle ---------------------------------------------------------------------------------

    def load(self) -> None:
        """Unpack the FMU if necessary, load it and make the instance.

        Raises:
            FmuError: The library does not load.
            SharedCode: The process has other code of the same name.
            DiskFull: No space is left to unpack.
        """
        hidden = claim(self.path)
        folder = self._folder or self._unpack()
        previous, self._words = os.getcwd(), ""
        identifier = str(self.calls.about.modelIdentifier)
        try:
            library, warning = library_of(folder, self.description, identifier) or (None, "")
            if library is None:
                platforms = platforms_among([p.relative_to(folder).as_posix() for p in folder.rglob("*")])
                if not self._compiles or C_CODE not in platforms:
                    raise FmuError(no_library(platform_of(self.description), platforms))
                library = compile_library(folder, self.description, identifier)
            try:
                with own_symbols_first(self.path, library):
                    self.calls.load(folder, library)
            except Exception as error:  # FMPy raises bare Exceptions.
                raise FmuError(load_error(library, error, hidden=bool(hidden))) from None
            for text in filter(None, (warning, *hidden)):
                self.remember(text)
            # pythonfmu reports its reasons in debug messages only.
            self.calls.instantiate(self.listen, self._logging or self.by_pythonfmu)
            if self.by_pythonfmu and not self._logging:
                self.calls.limit_logging()
        except Exception as error:  # FMPy raises bare Exceptions; the FMU's own message says more.
            reason = "; ".join((self.last_words() or str(error), *hidden))
            raise FmuError(f"{self.path} does not load: {reason}") from None
        finally:
            os.chdir(previous)  # FMPy changes to the FMU's folder.
        self.fmu, self.component = self.calls.fmu, self.calls.fmu.component
        let_go_at_exit(folder)  # pythonfmu would release its objects twice at exit.

    def _unpack(self) -> Path:
        """Unpack the FMU unless it is unpacked; return the folder."""
        if self.place is not None:
            self._folder = self.place
            return self.place
        try:
            self._folder = folder = Path(tempfile.mkdtemp(prefix="fmu-", dir=process_folder()))
            unpack(self.path, folder)
        except Exception as error:  # FMPy raises bare Exceptions, zipfile its own.
            if is_full(error):
                full = (
                    f"the disk is full: no room to unpack {self.path.name} in the folder for temporary files (TMPDIR)"
                )
                raise DiskFull(self.name, self.time, full) from None
            raise FmuError(f"{self.path} does not load: {error}") from None
        return folder

    def free(self) -> None:
        """Terminate and free the instance; keep the folder."""
        fmu, self.fmu = self.fmu, None
        if fmu is not None:
            try:
                if self.initialized:
                    fmu.terminate()
            except Exception as error:  # The run is over, so a refusal is logged only.
                self.log.append(str(error))
            fmu.freeInstance()
        self.initialized = False

    def renew(self) -> None:
        """Replace the instance by a new one; the library stays loaded."""
        fmu, self.fmu = self.fmu, None
        with suppress(Exception):  # FMPy raises bare Exceptions; a refusal to terminate does not matter.
            if self.initialized:
                fmu.terminate()
        self.initialized = False
        getattr(fmu, f"{self.calls.prefix}FreeInstance")(fmu.component)
        self.calls.instantiate(self.listen, self._logging or self.by_pythonfmu)
        self.fmu, self.component = self.calls.fmu, self.calls.fmu.component

    def remove(self) -> None:
        """Delete the folder, unless it is foreign."""
        if self._folder is not None and self._folder != self.place:
            shutil.rmtree(self._folder, ignore_errors=True)
            self._folder = None

    # -- messages -------------------------------------------------------------------------

    def listen(self, status: int, message: bytes | None) -> None:
        """Keep a message of the FMU; debug messages only on request."""
        try:
            if status >= WARNING or self._logging:
                self._words = (message or b"").decode("utf-8", "replace")
                self.remember(self._words)
        except (KeyboardInterrupt, Terminated) as stop:  # Exceptions cannot pass through C.
            self._stop = stop

    def raise_stop(self) -> None:
        """Raise the stop that arrived during a message."""
        stop, self._stop = self._stop, None
        if stop is not None:
            raise stop

    def remember(self, text: str) -> None:
        """Add a message to the log."""
        self.log.append(text if len(text) <= LONGEST_MESSAGE else text[:LONGEST_MESSAGE])

    def last_words(self) -> str:
        """Return the FMU's last message on a single line."""
        return without_wrapping(" ".join(self._words[:LONGEST_MESSAGE].split()))

    # -- status values ---------------------------------------------------------------

    @contextmanager
    def check_calls(self) -> Iterator[None]:
        """Convert failed FMPy calls to SimulationError."""
        from fmpy.fmi1 import FMICallException

        try:
            yield
        except FMICallException as error:
            self.judge(error.function, error.status)

    def call(self, name: str, *arguments: Any) -> Any:
        """Call a function of FMPy's object; a failure becomes a SimulationError."""
        with self.check_calls():
            return getattr(self.fmu, name)(*arguments)

    def stepping(self) -> Step:
        """Return the function that steps the FMU.

        Model exchange makes many FMI calls per step. Its errors therefore name the failed call and the call's time.
        """
        calls, step = self.calls, self.calls.stepping()
        if not isinstance(calls, ModelExchange):
            return step
        from fmpy.fmi1 import FMICallException

        def step_and_judge(component: Any, t: float, h: float, flag: int) -> int:
            try:
                return step(component, t, h, flag)
            except FMICallException as error:
                self.time = calls.time
                self.judge(error.function, error.status)
                return 0

        return step_and_judge

    def judge(self, function: str, status: int) -> None:
        """Handle a status other than OK; log a warning.

        Raises:
            EarlyEnd: The FMU ended the simulation by Discard.
            SimulationError: The call failed.
        """
        if status == WARNING:
            self.remember(f"{function} returned Warning")
            return
        if status == DISCARD and function == self.step_name and (reached := self.calls.end_time(self.time)) is not None:
            words = self.last_words()
            raise EarlyEnd(
                self.name,
                reached,
                f"{function} returned Discard: the FMU ended the simulation early{words and f': {words}'}",
                readable=True,
            )
        if status == FATAL:  # FMI demands to abandon the instance.
            self.fmu = None
        words, name = self.last_words(), STATUS[status] if 0 <= status < len(STATUS) else status
        if "KeyboardInterrupt" in words:  # Ctrl-C arrived while the FMU's Python code ran.
            raise KeyboardInterrupt
        because = f": {words}" if words else ""
        raise CallFailed(self.name, self.time, f"{function} returned {name}{because}")
