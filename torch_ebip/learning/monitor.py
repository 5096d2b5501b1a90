"""TensorBoard sink: the one place that knows SummaryWriter."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from torch_ebip.recordings.layout import Layout

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Monitor:
    """Writes what happens during tuning where TensorBoard finds it.

    Args:
        folder: of the events; created on construction.

    Use it as a context manager, or call `close`.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        try:  # imported here: it takes half a second that nobody should wait for who does not watch
            from torch.utils.tensorboard import SummaryWriter
        except ImportError as error:
            raise ImportError(f"a monitor needs TensorBoard: pip install tensorboard ({error})") from error
        self.folder = str(folder)
        self._goes_on = any(Path(folder).glob("events.out.tfevents.*"))
        self._writer: Any = SummaryWriter(self.folder)

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def resume(self, step: int) -> None:
        """Take back what an interrupted run wrote here after this step, since it will be written again."""
        if not self._goes_on or self._writer is None:
            return
        from torch.utils.tensorboard import SummaryWriter

        self._send("close")
        try:
            self._writer = SummaryWriter(self.folder, purge_step=step + 1)
        except OSError as error:
            self._writer = None
            warnings.warn(f"{self.folder}: what TensorBoard shows ends here: {error}", stacklevel=2)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One point at this step for each of some values; a slash in a name groups them."""
        for name, value in values.items():
            self._send("add_scalar", name, value, step)

    def text(self, name: str, markdown: str) -> None:
        """A text tab of this name, written in markdown."""
        self._send("add_text", name, markdown)

    def values(self, name: str, values: Mapping[str, Tensor], step: int = 0) -> None:
        """The distribution of each of some values [B] at this step, under a group of this name."""
        for each, numbers in values.items():
            self._send("add_histogram", f"{name}/{each}", numbers, step)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """A matplotlib figure of this name and step, which is closed."""
        self._send("add_figure", name, figure, step, close=True)

    def hyperparameters(self, settings: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """The HParams tab: settings and the final metrics they led to."""
        plain = {name: v if isinstance(v, bool | int | float | str) else str(v) for name, v in settings.items()}
        self._send("add_hparams", plain, dict(metrics), run_name=".")

    def filter(self, filter: nn.Module, layout: Layout, step: int) -> None:
        """The constrained noise of a filter on a layout, at this step: see `noise_scalars`."""
        self.scalars(noise_scalars(filter, layout), step)

    def close(self) -> None:
        """Write everything out."""
        self._send("close")

    def _send(self, action: str, *arguments: Any, **options: Any) -> None:
        """Have it written; a disk that fails ends the record, with a warning, and not what it is about."""
        if self._writer is None:
            return
        try:
            getattr(self._writer, action)(*arguments, **options)
        except OSError as error:
            self._writer = None
            warnings.warn(f"{self.folder}: what TensorBoard shows ends here: {error}", stacklevel=3)


@runtime_checkable
class HasNamedValues(Protocol):
    """A part that says what TensorBoard is to show of it."""

    def named_values(self, layout: Layout) -> dict[str, float]:
        """Constrained values by name, for a filter on this layout; a slash in a name groups them."""


def noise_scalars(filter: nn.Module, layout: Layout) -> dict[str, float]:
    """Constrained values of everything a filter on a layout can learn, by name: every part names its own.

    ``R/...`` and ``R_...`` of the measurement noise, ``Q/...`` of the process noise, ``localisation/...``,
    ``inflation`` and ``weighting/...`` of the update.
    """
    values: dict[str, float] = {}
    with torch.no_grad():
        for module in filter.modules():
            if isinstance(module, HasNamedValues):
                values |= module.named_values(layout)
    return values
