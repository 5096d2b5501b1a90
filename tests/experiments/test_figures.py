"""Figures show what they say."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
import torch

from experiments.figures import forecast_figure, noise_figure
from experiments.frames_figures import frames_figure
from tests.conftest import interactions, small_primitive
from tests.interaction.analogous import bent
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


def test_one_dof_of_a_modality_is_drawn_with_those_it_is_forecast_with() -> None:
    """A view that cut through them would be refused."""
    primitive, tests = small_primitive(), interactions(2, seed=5)
    layout, filter = tests.layout, bent(primitive, weigh=True)
    with pytest.raises(ValueError, match="forecast together"):
        filter.restrict(~layout.controlled | layout.mask(["arm.2"]))
    drawn = forecast_figure({"bent": filter}, tests, 0, ~layout.controlled, ["arm.2"], (0.5,))
    frames = frames_figure("bent", filter, tests[0], layout, ~layout.controlled, "arm.2")
    assert all(np.isfinite(line.get_ydata()).all() for line in drawn.axes[0].lines[:2])
    assert len(frames.axes) >= 2
    plt.close("all")
