"""Regression on a fixed share of the interaction: what anyone would try before a filter.

Methods learn a regressor for each set of sensors and each share of the interaction that they are asked about, from
training demonstrations cut at that share of their own length. They are told two things that no filter knows: where in
the interaction they stand, and that no other question will come. `UntoldTreesMethod` is told neither.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from experiments.baselines.common import Array, futures, kept_steps, places_of, point_answer, until
from experiments.evaluate import END, Answer
from torch_ebip import Demonstrations

SHARES = tuple(round(0.1 * k, 1) for k in range(1, 11))
"""At which demonstrations are cut for those who are not told where they stand."""
ALPHAS = tuple(float(alpha) for alpha in np.logspace(-1, 5, 25))
"""Grid of the ridge penalty, for standardised features and targets."""


class _RegressionMethod(ABC):
    """A regressor for each (shown DoFs, fraction), fitted when first asked for and kept.

    Args:
        demonstrations: of the training part.
        targets: bool [D], DoFs whose values are learned.
        fractions: shares of an interaction at which it will be asked: column k of `keep` is fractions[k].
        ahead: how many seconds later, A times; infinity: the end.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        targets: Tensor,
        fractions: Sequence[float],
        ahead: Sequence[float] = END,
    ) -> None:
        _require_sklearn()
        self.targets, self.fractions, self.ahead = targets, tuple(fractions), tuple(ahead)
        self._demonstrations = demonstrations
        self._values, self._measured = demonstrations.pad()
        self._lengths, self._rate = demonstrations.lengths, demonstrations.rate
        self._fitted: dict[tuple[tuple[bool, ...], tuple[float, ...]], _Regression] = {}

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`.

        Raises:
            ValueError: `keep` has not one column a fraction; DoFs are asked for that are no targets, or seconds that
                were not learned.
        """
        if keep.shape[1] != len(self.fractions):
            raise ValueError(f"keep has {keep.shape[1]} columns for the {len(self.fractions)} fractions")
        if (dofs & ~self.targets).any():
            raise ValueError("DoFs are asked for that were not among the targets")
        asked = places_of(ahead, self.ahead)
        shown = observed.any(0).any(0)
        means = []
        for k, fraction in enumerate(self.fractions):
            regression = self.fit(shown, fraction)
            features = self._features(y[..., shown], until(observed, keep[:, k])[..., shown], keep[:, k])
            said = torch.from_numpy(regression.predict(features)).to(y).view(len(y), len(self.ahead), -1)
            means.append(said[:, asked])
        return point_answer(torch.stack(means, 1)[..., dofs[self.targets]])

    def fit(self, shown: Tensor, fraction: float) -> _Regression:
        """The regression of the targets on the shown DoFs, bool [D], at a fraction of the interaction."""
        cuts = self._cuts(fraction)
        key = (tuple(shown.tolist()), cuts)
        if key not in self._fitted:
            features, wanted = [], []
            for cut in cuts:
                keep = kept_steps(self._lengths, cut)
                seen = until(self._measured, keep)[..., shown]
                features.append(self._features(self._values[..., shown], seen, keep))
                later = futures(self._demonstrations, keep.unsqueeze(-1), self.ahead, self.targets).flatten(1)
                wanted.append(later.double().numpy())
            # What lies behind the end for nearly all cannot be learned; the mean of the few is all that is said.
            self._fitted[key] = _Regression(self._regressor, np.concatenate(features), np.concatenate(wanted))
        return self._fitted[key]

    def _cuts(self, fraction: float) -> tuple[float, ...]:
        """At which shares demonstrations are cut to answer at one."""
        return (fraction,)

    @abstractmethod
    def _features(self, y: Tensor, seen: Tensor, keep: Tensor) -> Array:
        """[N, F] from y [N, T, shown DoFs] where seen, up to samples keep [N]; NaN where there is none."""

    @abstractmethod
    def _regressor(self) -> Any:
        """A new scikit-learn regressor of several outputs."""


class RidgeMethod(_RegressionMethod):
    """Ridge regression on the current pose: the last measured value of every shown DoF.

    The penalty is chosen for each target by leave-one-out cross-validation on the training part.
    """

    def _features(self, y: Tensor, seen: Tensor, keep: Tensor) -> Array:
        return last_values(y, seen).double().numpy()

    def _regressor(self) -> Any:
        from sklearn.linear_model import RidgeCV

        return RidgeCV(alphas=ALPHAS, alpha_per_target=True)


class TreesMethod(_RegressionMethod):
    """Extremely randomised trees on the observed prefix.

    Features of every shown DoF: its course over the prefix at evenly spaced points, its last value, its mean rate of
    change over the last `window` seconds; of every shown DoF that starts late (the ball) the seconds since it was
    first measured; and the elapsed time.

    Args:
        demonstrations, targets, fractions, ahead: see `_RegressionMethod`.
        points: of the prefix, the first and the last sample among them.
        window: s.
        trees: how many.
        max_features: share of the features that each split looks at.
        min_samples_leaf: smallest leaf.
        seed: of the trees.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        targets: Tensor,
        fractions: Sequence[float],
        ahead: Sequence[float] = END,
        points: int = 8,
        window: float = 0.1,
        trees: int = 200,
        max_features: float = 0.3,
        min_samples_leaf: int = 2,
        seed: int = 0,
    ) -> None:
        super().__init__(demonstrations, targets, fractions, ahead)
        self.points, self.window, self.seed = points, window, seed
        self.trees, self.max_features, self.min_samples_leaf = trees, max_features, min_samples_leaf

    def _features(self, y: Tensor, seen: Tensor, keep: Tensor) -> Array:
        course = resampled_prefix(y, seen, keep, self.points)
        last = last_values(y, seen)
        steps = max(1, round(self.window * self._rate))
        earlier = last_values(y, until(seen, keep - steps))
        rate = (last - earlier) / self.window
        first = torch.where(seen, torch.arange(y.shape[1]).view(1, -1, 1), y.shape[1]).amin(1)
        since = (keep.unsqueeze(-1) - first).clamp(min=0) / self._rate
        elapsed = keep.unsqueeze(-1) / self._rate
        parts = [course, *(part.double().numpy() for part in (last, rate, since, elapsed))]
        return np.concatenate(parts, axis=1)

    def _regressor(self) -> Any:
        from sklearn.ensemble import ExtraTreesRegressor

        return ExtraTreesRegressor(
            self.trees,
            max_features=self.max_features,
            min_samples_leaf=self.min_samples_leaf,
            random_state=self.seed,
            n_jobs=1,
        )


class UntoldTreesMethod(TreesMethod):
    """The same trees for every moment: learned at ten shares of the interaction, told none, as a filter is."""

    def _cuts(self, fraction: float) -> tuple[float, ...]:
        return SHARES


class _Regression:
    """A regressor with everything standardised by its training data; what is missing is at the mean.

    Targets that were measured in different demonstrations get regressors of their own.

    Args:
        make: returns a new scikit-learn regressor.
        features: [N, F], NaN = none.
        targets: [N, M], NaN = not measured.
    """

    def __init__(self, make: Any, features: Array, targets: Array) -> None:
        count = (~np.isnan(features)).sum(0)
        center, scale = _moments(features)
        # What never varies, or was measured once, says nothing.
        self._used = (count > 1) & (scale > 0)
        self._center, self._scale = center[self._used], scale[self._used]
        self._target_center, spread = _moments(targets)
        self._target_scale = np.where(spread > 0, spread, 1.0)
        inputs, outputs = self._standardised(features), (targets - self._target_center) / self._target_scale
        self._parts: list[tuple[list[int], Any]] = []
        measured = ~np.isnan(targets)
        groups: dict[bytes, list[int]] = {}
        for column in range(targets.shape[1]):
            groups.setdefault(measured[:, column].tobytes(), []).append(column)
        for columns in groups.values():
            rows = measured[:, columns[0]]
            # Without features, or with too few answers, the mean is all there is.
            if self._used.any() and rows.sum() > 1:
                self._parts.append((columns, make().fit(inputs[rows], outputs[rows][:, columns])))

    def predict(self, features: Array) -> Array:
        """Targets [B, M] for features [B, F]."""
        inputs = self._standardised(features)
        result = np.zeros((len(features), len(self._target_center)))
        for columns, regressor in self._parts:
            result[:, columns] = regressor.predict(inputs).reshape(len(features), -1)
        return result * self._target_scale + self._target_center

    def _standardised(self, features: Array) -> Array:
        scaled = (features[:, self._used] - self._center) / self._scale
        result: Array = np.where(np.isnan(scaled), 0.0, scaled)
        return result


def last_values(y: Tensor, seen: Tensor) -> Tensor:
    """[B, D]: the last seen value of each DoF of y [B, T, D]; NaN where there is none."""
    last = torch.where(seen, torch.arange(y.shape[1]).view(1, -1, 1), -1).amax(1)
    value = y.gather(1, last.clamp(min=0).unsqueeze(1)).squeeze(1)
    return torch.where(last >= 0, value, torch.nan)


def resampled_prefix(y: Tensor, seen: Tensor, keep: Tensor, points: int) -> Array:
    """[B, D * points]: each DoF of y [B, T, D] at `points` even steps from sample 0 to sample keep [B].

    Gaps are interpolated, the first and last seen values held; NaN for a DoF that is not seen at all.
    """
    values, mask = y.double().numpy(), seen.numpy()
    result = np.full((y.shape[0], y.shape[2], points), np.nan)
    for b, stop in enumerate(keep.tolist()):
        wanted = np.linspace(0.0, stop, points)
        for d in range(y.shape[2]):
            times = mask[b, :, d].nonzero()[0]
            if len(times):
                result[b, d] = np.interp(wanted, times, values[b, times, d])
    return result.reshape(len(result), -1)


def _moments(values: Array) -> tuple[Array, Array]:
    """Mean and deviation [F] over the rows of values [N, F] that are not NaN; 0 for a column without any."""
    present = ~np.isnan(values)
    count = np.maximum(present.sum(0), 1)
    mean = np.where(present, values, 0.0).sum(0) / count
    deviation = np.sqrt((np.where(present, values - mean, 0.0) ** 2).sum(0) / count)
    # Rounding leaves a constant a deviation that is none.
    return mean, np.where(deviation > 1e-7 * np.abs(mean), deviation, 0.0)


def _require_sklearn() -> None:
    try:
        import sklearn  # noqa: F401
    except ImportError as error:
        raise ImportError("the regression baselines need scikit-learn: pip install 'torch-ebip[methods]'") from error
