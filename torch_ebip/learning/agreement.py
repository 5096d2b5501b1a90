"""Whether recordings are what a model was learned from: names, units, order, rate."""

from __future__ import annotations

from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.layout import Layout


def check_agreement(demonstrations: Demonstrations, layout: Layout, rate: float) -> None:
    """Compare recordings with a layout and a rate in Hz; modalities that the layout does not have may be there.

    Raises:
        ValueError: a modality that is missing, or has other DoFs, another order or another unit; another rate.
    """
    theirs = demonstrations.layout
    if abs(demonstrations.rate / rate - 1) > 1e-6:
        raise ValueError(f"the recordings have {demonstrations.rate:g} samples a second, the model {rate:g}")
    missing = [name for name in layout.names if name not in theirs.names]
    if missing:
        raise ValueError(f"the recordings lack {', '.join(missing)}; they have {', '.join(theirs.names)}")
    for mine in layout.modalities:
        other = theirs[mine.name]
        if other.kind != mine.kind:
            raise ValueError(f"{mine.name} is of kind {other.kind!r} in the recordings, {mine.kind!r} in the model")
        if other.unit != mine.unit:
            raise ValueError(f"{mine.name} is in {other.unit!r} in the recordings, in {mine.unit!r} in the model")
        if other.dofs != mine.dofs:
            raise ValueError(
                f"{mine.name} has the columns {', '.join(other.dofs)} in the recordings, "
                f"{', '.join(mine.dofs)} in the model"
            )
    order = [name for name in theirs.names if name in layout.names]
    if order != list(layout.names):
        raise ValueError(
            f"the recordings have the modalities in the order {', '.join(order)}, the model {', '.join(layout.names)}"
        )
