"""Reading one case in a process that may die of it: limits of memory and time, and what became of the case."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import resource
import time
import warnings
from collections.abc import Callable
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

MEMORY = 4 << 30
"""Bytes that a reader may take beyond what the imports needed."""
LONGEST_MESSAGE = 10_000
"""Characters; nobody reads a longer one."""


class Outcome(NamedTuple):
    """What became of one case.

    Attributes:
        verdict: ``read``, ``refused`` or ``crashed``.
        message: of the exception, if there was one.
        result: what the reader returned.
        seconds: that it took.
        megabytes: by which memory grew at its peak.
    """

    verdict: str
    message: str
    result: Any
    seconds: float
    megabytes: float


Reader = Callable[[Path], Any]
"""Reads what is in the folder of a case, checks it, and returns something small that stands for it."""


class Worker:
    """A forked process that reads one case after the other, and is replaced when it dies.

    Args:
        read: the reader.
        word: one of these must be in the message of a refusal, beside the path of the case.
        limit: seconds a case.
    """

    def __init__(self, read: Reader, word: str | None, limit: float) -> None:
        self._read, self._word, self._limit = read, word, limit
        # Forked: importing torch for each replacement would take longer than all cases together.
        self._context = multiprocessing.get_context("fork")
        self._start()

    def _start(self) -> None:
        self._pipe, theirs = self._context.Pipe()
        self._process = self._context.Process(target=_serve, args=(theirs, self._read, self._word), daemon=True)
        self._process.start()
        theirs.close()

    def run(self, folder: Path) -> Outcome:
        """Read one case."""
        began = time.monotonic()
        try:
            self._pipe.send(folder)
            if self._pipe.poll(self._limit):
                outcome: Outcome = self._pipe.recv()
                return outcome
            message = f"took more than {self._limit} s"
        except (EOFError, OSError):
            self._process.join(5)
            message = f"the process died (exit code {self._process.exitcode})"
        self.close()
        self._start()
        return Outcome("crashed", message, None, time.monotonic() - began, 0.0)

    def close(self) -> None:
        """End the process."""
        self._process.kill()
        self._process.join()
        self._pipe.close()


def _serve(pipe: Connection, read: Reader, word: str | None) -> None:
    warnings.simplefilter("ignore")
    faulthandler.disable()  # a crash is reported by the parent
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in (0, 1, 2):
        os.dup2(nowhere, stream)
    limit = _status("VmSize") * 1024 + MEMORY
    resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    while True:
        try:
            folder = pipe.recv()
        except EOFError:
            return
        pipe.send(_attempt(folder, read, word))


def _attempt(folder: Path, read: Reader, word: str | None) -> Outcome:
    Path("/proc/self/clear_refs").write_text("5")  # the peak counts from here
    before, began = _status("VmRSS"), time.monotonic()
    result: Any = None
    try:
        result = read(folder)
        verdict, message = "read", ""
    except (ValueError, OSError) as error:
        message = str(error)
        clear = (str(folder) in message or (word is not None and word in message.lower())) and len(
            message
        ) < LONGEST_MESSAGE
        verdict = "refused" if clear else "crashed"
        message = message if clear else f"unclear: {type(error).__name__}: {message[:300]}"
    except BaseException as error:  # a reader may raise anything: that is what is looked for
        verdict, message = "crashed", f"{type(error).__name__}: {str(error)[:300]}"
    seconds = time.monotonic() - began
    return Outcome(verdict, message, result, seconds, max(0, _status("VmHWM") - before) / 1024)


def _status(name: str) -> int:
    """An entry of ``/proc/self/status``, kB."""
    for line in Path("/proc/self/status").read_text().splitlines():
        if line.startswith(f"{name}:"):
            return int(line.split()[1])
    return 0
