"""A recurrent network that reads the sensors and says what will be: what deep learning offers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from experiments.baselines.common import futures, places_of, until
from experiments.baselines.network import Data, RecurrentSettings, Trained, train
from experiments.baselines.stretches import all_features, cumulative, features_of, moments
from experiments.evaluate import END, Answer
from torch_ebip import Demonstrations, Forecast


class RecurrentMethod:
    """A few small GRUs that forecast what is asked at every step; trained when made, one set for all sensors.

    They see the standardised means of short stretches of samples (the one before where nothing was measured, 0 before
    the first), whether there were any, and the change from one stretch to the next. Every batch shows random ones of
    the subsets of sensors and every step of a demonstration counts, so that all subsets and horizons are served.
    Nobody tells them how long an interaction will last. Means are trained by squared error; variances by the Gaussian
    likelihood without touching the mean, and then scaled to what was left out.

    Args:
        demonstrations: of the training part.
        targets: bool [D], DoFs whose values are learned.
        subsets: the sensors that will be shown together, bool [D] by name.
        settings: of building and training.
        ahead: how many seconds later, A times; infinity: the end.

    Raises:
        ValueError: fewer than two demonstrations a network, or no subset.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        targets: Tensor,
        subsets: Mapping[str, Tensor],
        settings: RecurrentSettings | None = None,
        ahead: Sequence[float] = END,
    ) -> None:
        self.settings = settings = RecurrentSettings() if settings is None else settings
        if len(demonstrations) < 2 * max(5, settings.networks):
            raise ValueError(f"{len(demonstrations)} demonstrations are too few for {settings.networks} networks")
        if not subsets:
            raise ValueError("at least one subset of sensors is needed, got none")
        self.targets, self.ahead = targets, tuple(ahead)
        # The network has no use for inputs that are in no subset.
        self.inputs = torch.stack(list(subsets.values())).any(0)
        subset_masks = torch.stack([mask[self.inputs] for mask in subsets.values()])
        self.every = max(1, round(float(demonstrations.lengths.double().median()) / settings.steps_shown))
        values, measured = demonstrations.pad()
        values, measured = values[..., self.inputs].float(), measured[..., self.inputs]
        self._center, self._scale = moments(values.flatten(0, 1), measured.flatten(0, 1))
        every = torch.arange(values.shape[1]).expand(len(demonstrations), -1)
        every = torch.minimum(every, demonstrations.lengths.unsqueeze(-1) - 1)
        later = futures(demonstrations, every, self.ahead, targets).flatten(-2).float()
        self._target_center, self._target_scale = moments(later.flatten(0, 1), ~later.flatten(0, 1).isnan())
        data = Data(
            all_features((values - self._center) / self._scale, measured, self.every),
            demonstrations.lengths,
            (later - self._target_center) / self._target_scale,
            subset_masks,
        )
        generator = torch.Generator().manual_seed(settings.seed)
        parts = torch.randperm(len(demonstrations), generator=generator).tensor_split(max(5, settings.networks))
        self._subsets = subset_masks
        self._networks: list[list[Trained]] = []
        for i in range(settings.networks):
            training = torch.cat([part for j, part in enumerate(parts) if j != i])
            trained = train(data, training, parts[i], self.every, settings, settings.seed + i, generator)
            self._networks.append(trained)

    @torch.no_grad()
    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`.

        Raises:
            ValueError: DoFs are asked for that are no targets, or seconds that were not learned.
        """
        asked = places_of(ahead, self.ahead)
        if (dofs & ~self.targets).any():
            raise ValueError("DoFs are asked for that were not among the targets")
        values = (y[..., self.inputs].float() - self._center) / self._scale
        shown = observed.any(0).any(0)[self.inputs]
        forecasts = [
            self._forecast(values, until(observed, keep[:, k])[..., self.inputs], keep[:, k] + 1, shown)
            for k in range(keep.shape[1])
        ]
        means, variances = zip(*forecasts, strict=True)
        wanted = dofs[self.targets]
        shape = (*keep.shape, len(self.ahead), -1)
        mean, variance = (
            torch.stack(part, 1).view(shape)[..., asked, :][..., wanted].to(y) for part in (means, variances)
        )
        one = torch.ones_like(mean[..., 0])
        return Answer(Forecast(mean, variance, one), torch.full_like(one[..., 0], torch.nan))

    def _forecast(self, values: Tensor, seen: Tensor, stop: Tensor, shown: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and variance [B, M], in units of the targets, from the samples before stop [B] of sensors bool [I]."""
        # The last stretch is a full one; what does not fit is at the beginning, as it was in training.
        first = (stop - 1) % self.every + 1
        last = (stop - first) // self.every
        features = features_of(*cumulative(values, seen), first, int(last.max()) + 1, self.every)
        rows = torch.arange(len(values))
        # Sensors that were never shown together in training are served by the subset that differs least.
        subset = int((self._subsets != shown).sum(-1).argmin())
        means, variances = [], []
        for network, factor in (trained[subset] for trained in self._networks):
            mean, log_variance = (part[rows, last] for part in network(features))
            means.append(mean)
            variances.append(log_variance.exp() * factor)
        mean = torch.stack(means).mean(0)
        # Of the mixture: where the networks disagree they know less.
        variance = torch.stack(variances).mean(0) + torch.stack(means).var(0, correction=0)
        return mean * self._target_scale + self._target_center, variance * self._target_scale.square()
