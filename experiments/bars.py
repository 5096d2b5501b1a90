"""The progress bar of a learning."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from tqdm import tqdm

from torch_ebip.learning import Progress


@contextmanager
def learning_bar(disable: bool = False) -> Iterator[Callable[[Progress], None]]:
    """What `learn` calls to show on a bar how far it is and for how long it will go on."""
    with tqdm(desc="learning", unit="step", dynamic_ncols=True, disable=disable) as bar:

        def show(progress: Progress) -> None:
            """On the bar."""
            bar.total = progress.total
            bar.set_description(progress.stage, refresh=False)
            bar.set_postfix_str(progress.text, refresh=False)
            bar.update(progress.done - bar.n)

        yield show
