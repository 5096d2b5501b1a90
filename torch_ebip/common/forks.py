"""Whether a process is a copy of the one that made something: its threads are gone, its locks and files shared."""

from __future__ import annotations

import os

_count = [0]


def _forked() -> None:
    _count[0] += 1


os.register_at_fork(after_in_child=_forked)


def forks() -> int:
    """How many forks lie between this process and the one that imported the module.

    Cheaper than a process id, which is a call to the system.
    """
    return _count[0]
