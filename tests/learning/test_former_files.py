"""Model files that earlier versions wrote are read, and say what they said then.

Each in `former/` is a small model as a commit of before saved it, beside recorded values and what it forecast of
them: the first version of the format, evidence with one memory, with two whose sharpness could only grow,
surprise that did not ask for a direction and surprise that did, forecasts without analogues, and analogues that
followed the filter alike however sure it was.
"""

from pathlib import Path

import numpy as np
import pytest
import torch

from torch_ebip.learning import InteractionModel

FORMER = Path(__file__).parent / "former"
NAMES = ["first", "one_memory", "two_memories", "surprise", "direction", "analogues"]


@pytest.mark.parametrize("name", NAMES)
def test_a_model_of_before_says_what_it_said(name: str) -> None:
    said = np.load(FORMER / f"{name}.npz")
    model = InteractionModel.load(FORMER / f"{name}.safetensors")
    forecast = model.forecast(torch.from_numpy(said["values"]), ahead=said["ahead"].tolist())
    np.testing.assert_allclose(forecast.mean.numpy(), said["mean"], rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(forecast.variance.numpy(), said["variance"], rtol=1e-3, atol=1e-7)
    assert model.report["chosen"] in model.report["stages"]


@pytest.mark.parametrize("name", NAMES)
def test_it_is_saved_as_models_are_now(name: str, tmp_path: Path) -> None:
    model = InteractionModel.load(FORMER / f"{name}.safetensors")
    model.save(tmp_path / "again.safetensors")
    again = InteractionModel.load(tmp_path / "again.safetensors")
    states = model.filter.state_dict(), again.filter.state_dict()
    assert states[0].keys() == states[1].keys()
    for key, ours in states[0].items():
        if isinstance(ours, torch.Tensor):
            torch.testing.assert_close(ours, states[1][key], equal_nan=True)
