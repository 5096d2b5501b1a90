"""URDFs from the wild: limits left out, joints that mimic others, any order of links, another root, too many tags."""

from __future__ import annotations

import itertools
import math
import time

import pytest
import torch

from torch_ebip import ForwardKinematicsLoss, RobotArm
from torch_ebip.kinematics.urdf import MOST_ELEMENTS

ONE = """<robot name="r"><link name="a"/><link name="b"/><joint name="j" type="{}">
<parent link="a"/><child link="b"/><origin xyz="0 0 1"/><axis xyz="0 0 1"/>{}</joint></robot>"""

LEVEL = """<robot name="parallel"><link name="base"/><link name="upper"/><link name="fore"/><link name="hand"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="1"/></joint>
<joint name="level" type="revolute"><parent link="upper"/><child link="fore"/><origin xyz="0 0 1"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="3" velocity="0.5"/><mimic joint="{}" multiplier="{}" offset="{}"/></joint>
<joint name="wrist" type="prismatic"><parent link="fore"/><child link="hand"/><axis xyz="1 0 0"/></joint></robot>"""


@pytest.mark.parametrize("kind", ["revolute", "prismatic", "continuous", "fixed"])
@pytest.mark.parametrize(
    "limit", ["", "<limit/>", '<limit lower="-1" upper="1" effort="5"/>', '<limit velocity="2"/>']
)
def test_limits_that_are_left_out(kind: str, limit: str) -> None:
    arm = RobotArm(ONE.format(kind, limit), "b")
    if kind == "fixed":
        assert arm.velocity_limits.shape == (0,)
        assert arm.joint_limits.shape == (0, 2)
        assert arm(torch.zeros(3, 0)).shape == (3, 4, 4)
        assert arm(torch.zeros(0))[2, 3] == 1
        return
    assert arm.velocity_limits.tolist() == [2.0 if "velocity" in limit else math.inf]
    expected = [-math.inf, math.inf]
    if limit and kind != "continuous":
        expected = [-1.0, 1.0] if "lower" in limit else [0.0, 0.0]  # the format's defaults
    assert arm.joint_limits.tolist() == [expected]
    assert arm.joint_units == ("m" if kind == "prismatic" else "rad",)


def test_a_mimic_joint_follows_its_joint() -> None:
    """A parallel linkage keeps the forearm level, whatever a driver says of the passive joint."""
    arm = RobotArm(LEVEL.format("shoulder", -1, 0), "hand").double()
    assert arm.joint_names == ("shoulder", "wrist")
    assert arm.joint_units == ("rad", "m")
    q = torch.tensor([[0.5, 0.0], [1.2, 0.3]], dtype=torch.float64, requires_grad=True)
    pose = arm(q)
    torch.testing.assert_close(torch.atan2(pose[:, 0, 2], pose[:, 0, 0]), torch.zeros(2, dtype=torch.float64))
    torch.testing.assert_close(pose[:, 0, 3], q[:, 0].sin() + q[:, 1])
    published = torch.stack([q[:, 0], torch.full_like(q[:, 0], math.nan), q[:, 1]], -1)
    torch.testing.assert_close(arm(published), pose)
    assert torch.autograd.gradcheck(lambda joints: arm(joints)[..., :3, 3], q)
    assert ForwardKinematicsLoss(arm)(q, q.detach() + 0.1) > 0
    with pytest.raises(ValueError, match=r"expected shape \[..., 2\] \(shoulder, wrist\), got \[4\]"):
        arm(torch.zeros(4))


def test_multipliers_offsets_and_limits_of_what_follows() -> None:
    arm = RobotArm(LEVEL.format("shoulder", -2, 0.5), "hand").double()
    angle = torch.tensor([0.3, 0.0], dtype=torch.float64)
    pitch = arm(angle)
    assert math.atan2(pitch[0, 2], pitch[0, 0]) == pytest.approx(0.3 - 2 * 0.3 + 0.5)
    # level = 0.5 - 2 shoulder within -1 to 3 and at most half a radian a second.
    assert arm.joint_limits[0].tolist() == [-1.25, 0.75]
    assert arm.velocity_limits.tolist() == [0.25, math.inf]
    still = RobotArm(LEVEL.format("shoulder", 0, 0.5), "hand")
    assert still.joint_limits[0].tolist() == [-2.0, 2.0]


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("level", "joint 'level' mimics itself"),
        ("finger", "joint 'level' mimics 'finger', which does not move on the way"),
        ("", "the name of the joint that it mimics, got none"),
    ],
)
def test_what_can_not_be_followed_is_named(source: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        RobotArm(LEVEL.format(source, 1, 0), "hand")


def test_the_order_of_a_file_says_nothing() -> None:
    """The root is the link that no joint is above, wherever it stands."""
    text = LEVEL.format("shoulder", -1, 0)
    head, tail = text.index("<link"), text.rindex("</robot>")
    parts = text[head:tail].replace("\n<limit", "<limit").split("\n")
    parts = [part for part in parts if part]
    assert len(parts) == 4
    q = torch.tensor([0.4, 0.2])
    expected = RobotArm(text, "hand")(q)
    for order in itertools.permutations(parts):
        mixed = text[:head] + "\n".join(order) + text[tail:]
        mixed = mixed.replace('<link name="base"/><link name="upper"/>', '<link name="upper"/><link name="base"/>')
        torch.testing.assert_close(RobotArm(mixed, "hand")(q), expected)


def test_another_root() -> None:
    """Poses in the frame of any link on the way: the rest of the robot is left out."""
    whole = RobotArm(LEVEL.format("shoulder", -1, 0).replace("<mimic", "<ignored"), "hand").double()
    part = RobotArm(LEVEL.format("shoulder", -1, 0).replace("<mimic", "<ignored"), "hand", root_link="upper").double()
    assert part.joint_names == ("level", "wrist")
    q = torch.tensor([0.4, -0.3, 0.2], dtype=torch.float64)
    upper = RobotArm(LEVEL.format("shoulder", -1, 0), "upper").double()(q[:1])
    torch.testing.assert_close(upper @ part(q[1:]), whole(q))
    with pytest.raises(ValueError, match="joint 'level' mimics 'shoulder'"):
        RobotArm(LEVEL.format("shoulder", -1, 0), "hand", root_link="upper")
    with pytest.raises(ValueError, match="root_link: expected one of the URDF's links"):
        RobotArm(LEVEL.format("shoulder", -1, 0), "hand", root_link="nowhere")
    with pytest.raises(ValueError, match=r"root_link: expected a link on the way from 'base' to 'upper', got 'hand'"):
        RobotArm(LEVEL.format("shoulder", -1, 0), "upper", root_link="hand")


def test_a_million_elements_are_refused_at_once() -> None:
    began = time.monotonic()
    with pytest.raises(ValueError, match=f"more than {MOST_ELEMENTS} elements"):
        RobotArm("<robot>" + "<a/>" * 2_000_000 + "</robot>", "b")
    assert time.monotonic() - began < 5
