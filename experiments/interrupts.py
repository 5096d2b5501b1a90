"""Ctrl-C: a study ends within two seconds, says how to go on, and leaves no process behind.

Its processes do not hear of it themselves: whoever started them ends them. What it has written is safe whenever it
ends, because files appear only once they are complete.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress

PATIENCE = 1.0
"""Seconds until a study that is deep in somebody's C code is ended from outside."""
_state = {"advice": ""}


def advise(text: str) -> None:
    """What to say at an interrupt from now on: how to go on."""
    _state["advice"] = text


def end_children() -> None:
    """End all processes that this one started through multiprocessing, and wait until they are gone."""
    children = multiprocessing.active_children()
    for child in children:
        child.terminate()
    for child in children:
        child.join(0.3)
        if child.is_alive():
            child.kill()


@contextmanager
def deaf_children() -> Iterator[None]:
    """Processes that are started here never see an interrupt: the mask of signals is handed on to them."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def interruptible() -> Iterator[None]:
    """Run a study: an interrupt ends it as KeyboardInterrupt, or from outside where that takes too long.

    Raises:
        SystemExit: it was interrupted; with what `advise` was told.
    """
    done = threading.Event()
    ours, theirs = socket.socketpair()
    theirs.setblocking(False)
    # Python's own handler runs between two lines of Python only; the number of the signal is written here at once.
    before = signal.set_wakeup_fd(theirs.fileno(), warn_on_full_buffer=False)

    def watch() -> None:
        """Wait for an interrupt, and then not for long."""
        while number := ours.recv(1):
            if number[0] == signal.SIGINT and not done.wait(PATIENCE):
                end_children()
                with suppress(OSError):
                    os.write(2, f"\n{_message()}\n".encode("utf-8", "replace"))
                os._exit(130)

    threading.Thread(target=watch, daemon=True).start()
    try:
        yield
    except KeyboardInterrupt:
        end_children()
        done.set()
        print(f"\n{_message()}", file=sys.stderr)
        raise SystemExit(130) from None
    finally:
        done.set()
        signal.set_wakeup_fd(before)
        theirs.close()


def _message() -> str:
    return "interrupted" + (f"; {_state['advice']}" if _state["advice"] else ", before anything was written")
