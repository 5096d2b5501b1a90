"""How to tune, and how a tuning went."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from torch_ebip.common.arguments import as_count, as_number
from torch_ebip.recordings.demonstrations import Demonstrations


@dataclass(frozen=True)
class TuningSettings:
    """How to tune.

    Attributes:
        steps: gradient steps at most.
        batch_size: interactions a step.
        learning_rate: of Adam, on the logarithmic scale of all parameters; it falls along a half cosine.
        horizons: smallest and largest share of an interaction that is shown.
        horizons_each: horizons for each interaction of a batch.
        folds: into how many parts the demonstrations are cut: an interaction's ensemble is the other parts.
        n_members: E while tuning; default: all demonstrations of the other parts.
        pull: weight of the mean squared distance from the starting point, per parameter group.
        clip: largest norm of the gradient.
        validation: share of the demonstrations that are kept for early stopping.
        validate_every: steps between validations.
        patience: validations without improvement before stopping.
        thinning: use every k-th sample while tuning, each standing for k (see `EnsembleFilter`): k times faster.
        segment: samples a segment of gradient checkpointing (exact); 0 for none.
        only: shell patterns of the names of the parameters to tune.
        seed: of everything random.
    """

    steps: int = 100
    batch_size: int = 16
    learning_rate: float = 0.1
    horizons: tuple[float, float] = (0.2, 0.95)
    horizons_each: int = 3
    folds: int = 5
    n_members: int | None = None
    pull: float = 0.01
    clip: float = 1.0
    validation: float = 0.2
    validate_every: int = 20
    patience: int = 5
    thinning: int = 4
    segment: int = 0
    only: tuple[str, ...] = ("*",)
    seed: int = 0

    def __post_init__(self) -> None:
        """ValueError for a setting outside its range."""
        for name in ("steps", "batch_size", "horizons_each", "validate_every", "patience", "thinning"):
            as_count(name, getattr(self, name))
        for name, least in {"folds": 2, "segment": 0, "seed": -(2**63)}.items():
            as_count(name, getattr(self, name), least)
        if self.n_members is not None:
            as_count("n_members", self.n_members, 2)
        for name in ("learning_rate", "clip"):
            as_number(name, getattr(self, name), 0, above=True)
        as_number("pull", self.pull, 0)
        if isinstance(self.only, str) or not all(isinstance(pattern, str) for pattern in self.only):
            raise ValueError(f"only must be a sequence of patterns, got {self.only!r}")
        low, high = self.horizons
        if not 0 < low <= high <= 1:
            raise ValueError(f"horizons must be 0 < low <= high <= 1, got {self.horizons}")
        if not 0 < self.validation < 1:
            raise ValueError(f"validation must be a share between 0 and 1, got {self.validation}")


SAMPLES = 14
"""How many samples of an interaction are used while tuning: neighbouring ones say nearly the same."""
MANY = 400
"""Members while tuning, at most: more only take time."""


def settings_for(
    demonstrations: Demonstrations, steps: int, seed: int, members: int | None, others: Mapping[str, Any]
) -> TuningSettings:
    """What suits so many demonstrations, unless told otherwise.

    With few there are fewer folds and a stronger pull towards the start; with thousands ensembles are smaller while
    tuning.

    Args:
        demonstrations: N of them.
        steps, seed: see `TuningSettings`.
        members: E while tuning; default: all of the other folds, up to `MANY`.
        others: further settings by name.

    Raises:
        ValueError: a setting that there is not, or outside its range.
    """
    known = {field.name for field in fields(TuningSettings)}
    strangers = [name for name in others if name not in known]
    if strangers:
        raise ValueError(f"no setting {', '.join(strangers)}; there are {', '.join(sorted(known))}")
    N = len(demonstrations)
    settings: dict[str, Any] = {
        "folds": min(5, N),
        "pull": 0.01 * max(1.0, (20 / N) ** 2),
        "thinning": max(1, round(float(demonstrations.lengths.double().median()) / SAMPLES)),
        "n_members": MANY if members is None and N - -(-N // 5) > MANY else members,
        **others,
    }
    return TuningSettings(steps=steps, seed=seed, **settings)


class TuningResult(NamedTuple):
    """How a tuning went.

    Attributes:
        best_step: whose parameters were kept.
        validation: the loss by step.
        stopped_early: whether patience ended before the steps did.
        seconds: that it took.
        interrupted_at: the step at which Ctrl-C ended it; None if it did not.
    """

    best_step: int
    validation: dict[int, float]
    stopped_early: bool
    seconds: float
    interrupted_at: int | None = None
