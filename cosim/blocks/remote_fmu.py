"""An FMU on another machine, stepped through a server of FMUs: one message and its answer for each step."""

from __future__ import annotations

import zipfile
from collections.abc import Callable, Mapping, MutableSequence, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from cosim.base.drafts import draft_of
from cosim.base.errors import FmuError, SimulationError
from cosim.blocks.component import ADVANCE, Row, in_turn
from cosim.blocks.fmu import FmuBlock
from cosim.blocks.instance import Instance
from cosim.blocks.link import Control, Session
from cosim.blocks.wire import HEAD, VERSION, LinkError, Operation, decode, pack, unpack
from cosim.storage.archive import DESCRIPTION
from cosim.storage.cache import cache_path

SETTINGS = "tolerance", "logging", "solver"


@dataclass(frozen=True)
class Distant:
    """An FMU of a server.

    Attributes:
        at: host:port of the server.
        fmu: File within the server's folders.
        sha256: SHA-256 of that file.
        path: Local FMU that holds only its model description.
    """

    at: str
    fmu: str
    sha256: str
    path: Path


def find_distant(at: str, fmu: str, sha256: str | None) -> Distant:
    """Return an FMU of a server; its description comes from there.

    Raises:
        LinkError: The server cannot be used or does not offer the FMU.
        InputError: A library is missing.
    """
    with Control(at) as control:
        answer = control.ask("describe", fmu=fmu, sha256=sha256)
    content, digest = bytes(answer["description"]), str(answer["sha256"])
    path = cache_path(f"description {digest} {content.hex()}", ".fmu")
    with draft_of(path) as draft, zipfile.ZipFile(draft, "w") as archive:
        archive.writestr(zipfile.ZipInfo(DESCRIPTION), content)
    return Distant(at, fmu, digest, path)


class _RemoteInstance(Instance):
    """The instance of an FMU of a server: its states stay there and have numbers here, and none is serialized."""

    serializes = False

    def __init__(self, owner: RemoteFmu) -> None:
        super().__init__(owner.path, owner.calls, logging=False)
        self.owner, self.fmu = owner, owner  # not None: only a broken connection loses the FMU, and ends the run

    def save_state(self) -> Any:
        return self.owner.ask(Operation.SAVE)

    def restore_state(self, state: Any, *, keep: bool = False) -> None:
        self.owner.ask(Operation.RESTORE, {"state": state, "keep": keep})

    def free_state(self, state: Any) -> None:
        self.owner.ask(Operation.FREE, {"state": state})


class RemoteFmu(FmuBlock):
    """An FMU in a process of a server.

    Args:
        distant: Server and file.
    """

    def __init__(self, *arguments: Any, distant: Distant, **settings: Any) -> None:
        super().__init__(*arguments, **settings)
        make, words = self._recipe
        self._recipe = partial(make, distant=distant), words
        self.distant, self._settings = distant, settings
        self.instance = _RemoteInstance(self)
        self._session: Session | None = None
        self._outputs: bytes | None = None  # received with a step

    def bind(self, row: Row, first: int, beside: list[Any] | None = None, first_beside: int = 0) -> None:
        """Set the places of the signals."""
        self._beside = [] if beside is None else beside
        ends = [first, len(self.inputs), len(self.outputs)]
        exact = [first_beside, len(self.exact_inputs), len(self.exact_outputs)]
        for k in (1, 2):
            ends[k], exact[k] = ends[k - 1] + ends[k], exact[k - 1] + exact[k]
        view = memoryview(row).cast("B")
        self._in, self._out, self._all = (view[8 * a : 8 * b] for a, b in (ends[:2], ends[1:], ends[::2]))
        self._exact_in, self._exact_out, self._exact_all = (slice(a, b) for a, b in (exact[:2], exact[1:], exact[::2]))
        self._has_exact = exact[2] > exact[0]

    def open(self, start: float, stop: float) -> None:
        """Open a session and begin initialization."""
        self.close()
        self.instance.time = start
        job = {
            "fmu": self.distant.fmu,
            "sha256": self.distant.sha256,
            "name": self.name,
            "values": dict(self.start_values),
            "connected": sorted(self.connected),
            "recorded": sorted(self._settings.get("recorded", ())),
            "settings": {"way": self._calls.way, **{key: self._settings.get(key) for key in SETTINGS}},
        }
        try:
            self._session = Session(self.distant.at, self.name, job)
        except LinkError as error:
            raise FmuError(error.message.after(f"{self.name}: ")) from None
        self._session.time = start
        content = {"start": start, "stop": stop}
        self._show(self._call(pack(Operation.OPEN, content=content)))

    def open_again(self, values: Mapping[str, Any], start: float, stop: float) -> None:
        """Initialize a new instance with other start values."""
        self.start_values = values
        self.open(start, stop)
        self.start()

    def start(self) -> None:
        """End initialization."""
        self._call(pack(Operation.START))
        self.instance.initialized = True

    def put(self) -> None:
        """Do nothing: each call sends the inputs."""

    def try_inputs(self) -> None:
        """Do nothing: each call sends the inputs."""

    def advance(self, t: float, h: float) -> None:
        """Send the inputs, step, and receive the outputs."""
        session = self._session
        assert session is not None
        session.time = t
        self._outputs = self._exchange(Operation.STEP, t, h)
        self.instance.time = session.time = t + h

    def get(self) -> None:
        """Write the outputs of the last step, or of the current inputs."""
        answer, self._outputs = self._outputs, None
        self._write(self._exchange(Operation.EXCHANGE) if answer is None else answer, self._out, self._exact_out)

    def stepping(self, doing: MutableSequence[int], first: int) -> Callable[[float, float], None]:
        if self._has_exact:
            return in_turn(self, doing, first, puts=False)
        head, operation, inputs, outputs = HEAD.pack, int(Operation.STEP), self._in, self._out
        instance, size, advancing = self.instance, HEAD.size + len(outputs), first + ADVANCE

        def once(t: float, h: float) -> None:
            """Do `advance` and `get` with fewer calls between."""
            doing[0] = advancing
            session = self._session
            assert session is not None
            session.time = t
            answer = session.call(head(VERSION, operation, t, h) + inputs)
            instance.time = session.time = t + h
            if len(answer) != size:
                self._write(answer, outputs, self._exact_out)  # raises its error
            outputs[:] = memoryview(answer)[HEAD.size :]

        return once

    def change(self, values: Mapping[str, Any]) -> None:
        """Set tunable parameters and inputs during a run."""
        content = {"values": dict(values), "exact": self._beside[self._exact_in]}
        self._show(self._call(pack(Operation.CHANGE, doubles=self._in, content=content)))

    def slopes(self, outputs: Sequence[str], inputs: Sequence[str]) -> list[list[float]] | None:
        """Return directional derivatives of outputs, None if unavailable."""
        content = {"exact": self._beside[self._exact_in], "outputs": [*outputs], "inputs": [*inputs]}
        slopes: list[list[float]] | None = self.ask(Operation.SLOPES, content, self._in)
        return slopes

    def ask(self, operation: Operation, content: Any = None, doubles: Any = b"") -> Any:
        """Return the JSON of an answer."""
        return decode(self._call(pack(operation, doubles=doubles, content=content))[HEAD.size :] or b"null")

    def slot(self) -> str:
        """Return the reason against the C loop."""
        return f"{self.name} is on another machine"

    @property
    def saves(self) -> bool:
        """Return False: inputs are replayed."""
        return False

    def checkpoint(self) -> None:
        """Return None: inputs are replayed."""

    def close(self) -> None:
        """End the session and take its messages."""
        session, self._session = self._session, None
        if session is None:
            return
        self.instance.initialized = False
        try:
            if not session.is_gone:
                self.log.first.extend(decode(session.call(pack(Operation.CLOSE))[HEAD.size :]))
        except SimulationError:  # It has failed before; that failure is reported.
            pass
        finally:
            session.close()

    def _exchange(self, operation: Operation, t: float = 0.0, h: float = 0.0) -> bytes:
        content = self._beside[self._exact_in] if self._has_exact else None
        return self._call(pack(operation, t, h, self._in, content))

    def _call(self, message: bytes) -> bytes:
        assert self._session is not None
        return self._session.call(message)

    def _show(self, answer: bytes) -> None:
        """Write inputs and outputs of an answer."""
        self._write(answer, self._all, self._exact_all)

    def _write(self, answer: bytes, place: memoryview, exact: slice) -> None:
        try:
            content = unpack(answer, place, self._has_exact)
        except ValueError:
            message = f"the connection to {self.distant.at} is lost: its answer has other signals"
            raise SimulationError(self.name, self.instance.time, message) from None
        if self._has_exact:
            self._beside[exact] = content
