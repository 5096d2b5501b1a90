"""Which demonstrations speak: a state's weights as an affine combination of the demonstrations' weights.

Without process noise on the weights, every update adds multiples of members' deviations to members, so all of
them stay in the affine span of the demonstrations, and with them every forecast: h is linear in the weights.
"""

from __future__ import annotations

import torch
from torch import Tensor


def affine_coefficients(demonstrations: Tensor, weights: Tensor) -> Tensor:
    """Coefficients c with sum_i c_i = 1 and sum_i c_i w_i = w; of many solutions the smallest in norm.

    There is one solution if the demonstrations are affinely independent, as N of them in general are where N - 1
    is at most the number of weights.

    Args:
        demonstrations: w_i, [N, n_weights].
        weights: w, [..., n_weights], in the affine span of the demonstrations.

    Returns:
        [..., N], without unit; negative ones push away from a demonstration.

    Raises:
        ValueError: weights outside the span, by more than one percent of a standard deviation.
    """
    mean = demonstrations.double().mean(0)
    anomalies = demonstrations.double() - mean
    spread = anomalies.square().mean(0).sqrt()
    spread = torch.where(spread > 0, spread, 1)
    anomalies = anomalies / spread
    departure = (weights.double() - mean) / spread
    rounding = torch.finfo(demonstrations.dtype).eps * max(anomalies.shape)
    coefficients = departure @ torch.linalg.pinv(anomalies, rtol=rounding)
    outside = (coefficients @ anomalies - departure).detach().square().mean(-1).sqrt().max()
    if not bool(outside < 0.01 * max(1.0, float(departure.detach().square().mean(-1).sqrt().max()))):
        raise ValueError(
            f"weights lie outside the span of the demonstrations by {float(outside):.2g} of their standard deviations"
        )
    result: Tensor = coefficients + 1 / len(demonstrations)
    return result.to(weights.dtype)
