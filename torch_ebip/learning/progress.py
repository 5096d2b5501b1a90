"""What is left to do of a learning, and for how long."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, NamedTuple


class Progress(NamedTuple):
    """Where a learning is.

    Attributes:
        stage: what it is at, in a word.
        done, total: units of work, which take about as long as each other.
        text: what matters so far.
    """

    stage: str
    done: int
    total: int
    text: str


class Reporter:
    """Counts work and tells whoever listens.

    Args:
        listener: called with a `Progress` after each unit; None: a bar where there is a terminal to draw it on and
            tqdm is installed, otherwise nobody.
        total: units of work.
    """

    def __init__(self, listener: Callable[[Progress], None] | None, total: int) -> None:
        self._bar: Any = None
        self._listener = self._draw if listener is None else listener
        self._stage, self._done, self._total, self._text = "", 0, total, ""
        if listener is None and sys.stderr is not None and sys.stderr.isatty():
            try:
                from tqdm import tqdm
            except ImportError:
                return
            self._bar = tqdm(total=total, desc="learning", unit="step", dynamic_ncols=True)

    def stage(self, name: str) -> None:
        """Something else begins."""
        self._stage = name
        self._tell()

    def tick(self, units: int = 1, text: str | None = None) -> None:
        """So many units are done; what matters now is ``text``."""
        self._done = min(self._done + units, self._total)
        self._text = self._text if text is None else text
        self._tell()

    def close(self) -> None:
        """All is done, also what turned out not to be needed."""
        self._done = self._total
        self._tell()
        if self._bar is not None:
            self._bar.close()

    def _tell(self) -> None:
        self._listener(Progress(self._stage, self._done, self._total, self._text))

    def _draw(self, progress: Progress) -> None:
        if self._bar is not None:
            self._bar.set_description(progress.stage, refresh=False)
            self._bar.set_postfix_str(progress.text, refresh=False)
            self._bar.update(progress.done - self._bar.n)
            self._bar.refresh()
