"""Figures show what they say."""

import matplotlib.pyplot as plt
import numpy as np
import torch

from experiments.figures import noise_figure
from tests.conftest import small_primitive
from torch_ebip import BSplineBasis, ebip


def test_the_learned_noise_is_drawn_over_phase() -> None:
    primitive = small_primitive()
    made = ebip(primitive, context=BSplineBasis(4))
    with torch.no_grad():
        made.model.measurement_noise.gates[-1, 0] = 2.0  # of the hand, at the end
        made.model.measurement_noise.variance.raw[2] = 1.0  # of the gaze, throughout
    figure = noise_figure(made, primitive.residual_variance, primitive.layout, ["hand", "gaze"])
    hand, gaze = figure.axes[0].lines
    np.testing.assert_allclose(hand.get_ydata()[[0, -1]], [1, np.exp(2)], rtol=1e-4)
    np.testing.assert_allclose(gaze.get_ydata(), np.exp(1.0), rtol=1e-4)
    plt.close(figure)
