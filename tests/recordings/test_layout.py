import pytest
import torch

from tests.conftest import layout
from torch_ebip import Layout, Modality


def test_columns_units_and_control() -> None:
    made = layout()
    assert made.dofs == ("hand.x", "hand.y", "gaze.yaw", "arm.1", "arm.2")
    assert made.units == ("m", "m", "rad", "rad", "rad")
    assert made.slice("gaze") == slice(2, 3)
    assert made.controlled.tolist() == [False, False, False, True, True]
    assert made.modality_of_dof.tolist() == [0, 0, 1, 2, 2]
    assert made["arm"].unit == "rad"


def test_masks_take_modalities_and_single_dofs() -> None:
    assert layout().mask(["gaze", "hand.y"]).tolist() == [False, True, True, False, False]
    assert layout().mask("hand").tolist() == [True, True, False, False, False]
    assert layout().mask([]).dtype == torch.bool


def test_equal_layouts_are_equal() -> None:
    assert layout() == layout()
    assert layout() != Layout([Modality("hand", ["hand.x"], "m")])


@pytest.mark.parametrize(
    "ask", [lambda made: made.mask(["nose"]), lambda made: made.slice("nose"), lambda m: m["nose"]]
)
def test_an_unknown_modality_is_named(ask) -> None:
    with pytest.raises(ValueError, match=r"nose.*hand, gaze, arm"):
        ask(layout())


def test_what_makes_no_modality() -> None:
    with pytest.raises(ValueError, match="needs at least one DoF"):
        Modality("empty", [], "m")
    with pytest.raises(ValueError, match="named more than once: x"):
        Modality("twice", ["x", "x"], "m")
    with pytest.raises(ValueError, match="needs a name and a unit"):
        Modality("unitless", ["x"], "")
    with pytest.raises(ValueError, match="sequence of names"):
        Modality("text", "xyz", "m")


def test_what_makes_no_layout() -> None:
    with pytest.raises(ValueError, match="at least one modality"):
        Layout([])
    with pytest.raises(ValueError, match="DoF named more than once: x"):
        Layout([Modality("a", ["x"], "m"), Modality("b", ["x"], "m")])
