"""What filtering a sequence leaves."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from torch_ebip.filtering.states import State


@dataclass(frozen=True, repr=False, eq=False)
class Trace:
    """What filtering a sequence leaves.

    Attributes:
        state: after the last sample.
        states: [..., T, m], mean after each sample of the entries of the state that the dynamics move: of all of
            them, unless the model says that some stand still.
        log_likelihood: [..., T], of each sample given those before it.
        projection: [..., T, D], mean of h(x) after each sample; [..., T, 0] if it was not asked for.
        kept: the states asked for with ``keep``, batch dimensions [..., K]; None if none were.
        engine: who held the members: "dense" or "span".
        familiarity: [..., T], in [0, 1], how usual the largest surprise up to each sample is; NaN where it was not
            calibrated. None where nobody asks.
        surprise: [..., T, S], how surprising each of S sensors was, see `Surprise`; None where nobody asks.
        counts: [..., T, S], in [0, 1], what each of them counted for it; None where nobody asks.
    """

    state: State
    states: Tensor
    log_likelihood: Tensor
    projection: Tensor
    kept: State | None
    engine: str
    familiarity: Tensor | None = None
    surprise: Tensor | None = None
    counts: Tensor | None = None

    def __repr__(self) -> str:
        *batch, length = self.log_likelihood.shape
        return (
            f"{type(self).__name__}({length} samples, batch {batch}, {self.engine} engine, "
            f"{self.log_likelihood.dtype}, state={type(self.state).__name__})"
        )
