"""A map and the alignment with it in a process of their own, so that no step holds the node's callbacks up.

Both processes are ours and talk through a pipe of their own: a method's name and arguments go in, its result comes out.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from xalign_ros.apps.node_alignment import Alignment, Terms
from xalign_ros.core.errors import XalignError
from xalign_ros.core.records import AlignmentState
from xalign_ros.io.xmap import read_map

END_S = 5.0  # for the step in hand, when all ends
HUNG_S = 30.0  # without an answer to a call; a step takes milliseconds, over the whole map a second


class ProcessDiedError(Exception):
    """The other process is gone; what it knew is lost."""


@dataclass(frozen=True, slots=True, eq=False)
class OpenMap:
    """What the node has to know of the map that it opened, and the state to begin with."""

    map_id: str
    version: str
    frame: str
    metric: bool
    points: int
    state: AlignmentState


class MapProcess:
    """`opened` once, then `call`; each waits for its answer. Ended by `end`, and with the process that made it."""

    def __init__(self, path: Path, terms: Terms) -> None:
        self.path, self.terms = path, terms
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # its matrices are small; and as in replay, to the last bit
        spawn = multiprocessing.get_context("spawn")
        self._pipe, theirs = spawn.Pipe()
        self._process = spawn.Process(target=_serve, args=(theirs, path, terms), name="xalign_aligner", daemon=True)
        self._process.start()
        theirs.close()

    @property
    def pid(self) -> int | None:
        return self._process.pid

    @property
    def exitcode(self) -> int | None:
        """None while it lives."""
        return self._process.exitcode

    def opened(self) -> OpenMap:
        """Waits for the map. Raises what reading it raises, and ProcessDiedError."""
        result = self._result(None)
        assert isinstance(result, OpenMap)
        return result

    def call(self, name: str, *arguments: Any) -> Any:
        """Alignment.name(*arguments) over there. Raises ProcessDiedError, also where there is no answer for HUNG_S."""
        try:
            self._pipe.send((name, arguments))
        except (OSError, ValueError) as error:
            raise ProcessDiedError(str(error)) from error
        return self._result(HUNG_S)

    def _result(self, patience_s: float | None) -> Any:
        try:
            if not self._pipe.poll(patience_s):
                self._process.kill()
                raise ProcessDiedError(f"no answer for {patience_s:g} s")
            result = self._pipe.recv()
        except (EOFError, OSError, TypeError) as error:  # TypeError: `end` came in between
            self._process.join(END_S)
            raise ProcessDiedError(f"exit code {self._process.exitcode}") from error
        if isinstance(result, Exception):
            raise result
        return result

    def end(self) -> None:
        """Not while a call waits, unless its answer does not matter any more."""
        self._pipe.close()
        self._process.join(END_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(pipe: Connection, path: Path, terms: Terms) -> None:
    for ending in (signal.SIGINT, signal.SIGTERM):  # the node's own, which ends this one by the pipe
        signal.signal(ending, signal.SIG_IGN)
    try:
        alignment = Alignment(read_map(path, verify=True), terms)
        m, state = alignment.map, alignment.restart("no keyframe was received yet").state
        pipe.send(OpenMap(m.map_id, m.version, alignment.map_frame, m.metric, len(m.points), state))
        while True:
            name, arguments = pipe.recv()
            pipe.send(getattr(alignment, name)(*arguments))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return
    except XalignError as error:
        pipe.send(error)
