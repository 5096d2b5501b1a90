"""RobotArm against the closed form of the Denavit-Hartenberg table, and its manners as a module."""

import copy
import io
import math
import subprocess
import sys

import numpy as np
import pytest
import torch

from torch_ebip import RobotArm

A = [0.0, -0.425, -0.39225, 0.0, 0.0, 0.0]
D = [0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823]
ALPHA = [math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0]

TWO_LINKS = """
<robot name="planar">
  <link name="base"/><link name="one"/><link name="two"/><link name="tip"/><link name="side"/>
  <joint name="j1" type="continuous"><parent link="base"/><child link="one"/><axis xyz="0 0 1"/></joint>
  <joint name="branch" type="fixed"><parent link="one"/><child link="side"/></joint>
  <joint name="j2" type="revolute"><parent link="one"/><child link="two"/><origin xyz="0.5 0 0" rpy="0 0 0"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="2" velocity="3" effort="1"/></joint>
  <joint name="end" type="fixed"><parent link="two"/><child link="tip"/><origin xyz="0.25 0 0"/></joint>
</robot>"""


def denavit_hartenberg(joints: np.ndarray) -> list[np.ndarray]:
    """Poses of the base and after each row of the table, A_i = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i)."""
    poses = [np.eye(4)]
    for q, a, d, alpha in zip(joints, A, D, ALPHA, strict=True):
        c, s, ca, sa = math.cos(q), math.sin(q), math.cos(alpha), math.sin(alpha)
        row = np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0, 0, 0, 1]])
        poses.append(poses[-1] @ row)
    return poses


def random_joints(*shape: int, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    return (torch.rand(*shape, 6, generator=generator, dtype=torch.float64) * 4 - 2).mul(math.pi).to(dtype)


def translation(x: float, y: float, z: float, dtype: torch.dtype = torch.float64) -> torch.Tensor:
    tool = torch.eye(4, dtype=dtype)
    tool[:3, 3] = torch.tensor([x, y, z], dtype=dtype)
    return tool


def test_all_joints_at_zero() -> None:
    flange = RobotArm.ur5().double()(torch.zeros(6, dtype=torch.float64))
    torch.testing.assert_close(
        flange[:3, 3], torch.tensor([-0.81725, -0.19145, -0.005491], dtype=torch.float64), atol=1e-12, rtol=0
    )


def test_agrees_with_the_table() -> None:
    joints = random_joints(1000)
    poses = RobotArm.ur5().double()(joints)
    expected = np.stack([denavit_hartenberg(q)[-1] for q in joints.numpy()])
    np.testing.assert_allclose(poses.numpy(), expected, atol=1e-12, rtol=0)


def test_single_precision_is_good_to_a_micrometre() -> None:
    joints = random_joints(1000)
    single = RobotArm.ur5()(joints.float()).double()
    np.testing.assert_allclose(single[:, :3, 3], RobotArm.ur5().double()(joints)[:, :3, 3], atol=3e-6, rtol=0)


def test_tool_is_applied_in_the_flange_frame() -> None:
    tool = translation(0.0, 0.0, 0.2)
    joints = random_joints(20)
    expected = RobotArm.ur5().double()(joints) @ tool
    torch.testing.assert_close(RobotArm.ur5(tool)(joints), expected)


def test_gradients() -> None:
    arm = RobotArm.ur5(translation(0.05, -0.02, 0.2)).double()
    joints = random_joints(3).requires_grad_()
    assert torch.autograd.gradcheck(arm, (joints,))
    assert torch.autograd.gradgradcheck(arm, (joints,))


def test_tip_velocity_is_the_cross_product_of_axis_and_lever() -> None:
    arm = RobotArm.ur5().double()
    joints = random_joints(1)[0]
    jacobian = torch.autograd.functional.jacobian(lambda q: arm(q)[:3, 3], joints)
    poses = denavit_hartenberg(joints.numpy())
    for i in range(6):  # joint i turns about the z axis of the frame before it
        velocity = np.cross(poses[i][:3, 2], poses[6][:3, 3] - poses[i][:3, 3])
        np.testing.assert_allclose(jacobian[:, i].numpy(), velocity, atol=1e-12)


@pytest.mark.parametrize("shape", [(), (0,), (1,), (4,), (2, 3), (2, 0, 3)])
def test_leading_batch_dimensions(shape: tuple[int, ...]) -> None:
    arm = RobotArm.ur5().double()
    joints = random_joints(*shape)
    poses = arm(joints)
    assert poses.shape == (*shape, 4, 4)
    for pose, q in zip(poses.reshape(-1, 4, 4), joints.reshape(-1, 6), strict=True):
        torch.testing.assert_close(pose, arm(q))


def test_follows_dtype() -> None:
    arm = RobotArm.ur5()
    assert arm(random_joints(2, dtype=torch.float32)).dtype == torch.float32
    # Casting there and back loses nothing: the chain is cast from its float64 original.
    back = arm.double().float().double()
    assert back(random_joints(2)).dtype == torch.float64
    torch.testing.assert_close(back(random_joints(2)), RobotArm.ur5().double()(random_joints(2)), atol=0, rtol=0)
    assert back.joint_limits.dtype == torch.float64


def test_computes_in_the_wider_dtype() -> None:
    joints = random_joints(5)
    torch.testing.assert_close(RobotArm.ur5()(joints), RobotArm.ur5().double()(joints), atol=0, rtol=0)
    assert RobotArm.ur5()(torch.zeros(6, dtype=torch.long)).dtype == torch.float32


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
def test_follows_device() -> None:
    joints = random_joints(5)
    poses = RobotArm.ur5().double().cuda()(joints.cuda())
    assert poses.is_cuda
    torch.testing.assert_close(poses.cpu(), RobotArm.ur5().double()(joints))
    with pytest.raises(ValueError, match=r"joints: expected on the arm's device, cuda:0, got cpu"):
        RobotArm.ur5().cuda()(joints)


def test_limits() -> None:
    arm = RobotArm.ur5().double()
    assert arm.n_joints == 6
    assert arm.joint_names[:3] == ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint")
    expected = torch.tensor([[-2 * math.pi, 2 * math.pi]] * 6, dtype=torch.float64)
    torch.testing.assert_close(arm.joint_limits, expected, atol=0, rtol=0)
    torch.testing.assert_close(arm.velocity_limits, torch.full((6,), math.pi, dtype=torch.float64), atol=0, rtol=0)


def test_survives_copy_pickle_and_state_dict() -> None:
    arm = RobotArm.ur5(translation(0.0, 0.0, 0.1, torch.float32))
    joints = random_joints(2, dtype=torch.float32)
    poses = arm(joints)
    torch.testing.assert_close(copy.deepcopy(arm)(joints), poses)
    buffer = io.BytesIO()
    torch.save(arm, buffer)
    buffer.seek(0)
    torch.testing.assert_close(torch.load(buffer, weights_only=False)(joints), poses)
    other = RobotArm.ur5()
    other.load_state_dict(arm.state_dict())
    torch.testing.assert_close(other(joints), poses)


def test_other_robots_from_text_and_file(tmp_path) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "planar.urdf"
    path.write_text(TWO_LINKS)
    for source in (TWO_LINKS, path, str(path)):
        arm = RobotArm(source, "tip").double()
        assert arm.joint_names == ("j1", "j2")
        tip = arm(torch.tensor([0.3, 0.4], dtype=torch.float64))[:2, 3]
        expected = [
            0.5 * math.cos(0.3) + 0.25 * math.cos(0.7),
            0.5 * math.sin(0.3) + 0.25 * math.sin(0.7),
        ]
        np.testing.assert_allclose(tip.numpy(), expected, atol=1e-15)
    assert torch.isinf(arm.joint_limits[0]).all()
    assert arm.joint_limits[1].tolist() == [-1.0, 2.0]


def test_errors_say_what_was_expected_and_what_came(tmp_path) -> None:  # type: ignore[no-untyped-def]
    arm = RobotArm.ur5()
    with pytest.raises(ValueError, match=r"joints: expected shape \[\.\.\., 6\].*got \[3, 5\]"):
        arm(torch.zeros(3, 5))
    with pytest.raises(ValueError, match=r"joints: .*got \[\]"):
        arm(torch.tensor(0.0))
    with pytest.raises(ValueError, match=r"tool: .*\[4, 4\], got \[3\]"):
        RobotArm.ur5(torch.zeros(3))
    with pytest.raises(ValueError, match=r"tool: .*last row"):
        RobotArm.ur5(torch.ones(4, 4))
    with pytest.raises(ValueError, match=r"urdf: .*missing\.urdf"):
        RobotArm(tmp_path / "missing.urdf", "flange")
    with pytest.raises(ValueError, match=r"urdf: .*does not parse"):
        RobotArm("<robot name='x'><link", "flange")
    with pytest.raises(ValueError, match=r"end_link: expected one of .*'hand'"):
        RobotArm(TWO_LINKS, "hand")
    with pytest.raises(ValueError, match=r"urdf: expected joints of type .*j1"):
        RobotArm(TWO_LINKS.replace("continuous", "floating"), "tip")


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"0.5 0 0"', '"nan 0 0"', "joint 'j2': expected a finite number, got 'nan'"),
        ('"0.5 0 0"', '"1e300 0 0"', "joint 'j2': expected a finite number"),
        ('rpy="0 0 0"', 'rpy="0 inf 0"', "joint 'j2': expected a finite number"),
        ('"0.5 0 0"', '"0.5 0"', "expected three numbers in xyz"),
        ('<axis xyz="0 0 1"/><limit', '<axis xyz="0 0 0"/><limit', "expected an axis with a direction"),
        ('upper="2"', 'upper="nan"', "joint 'j2': expected a finite number"),
        ('upper="2"', 'upper="-2"', "expected limits, got -1.0 to -2.0"),
        ('velocity="3"', 'velocity="fast"', "joint 'j2': expected a finite number, got 'fast'"),
        ('name="j2"', 'name="j1"', "joints of different names"),
        ('<child link="side"/>', '<child link="tip"/>', "two joints above 'tip'"),
        ("<robot", "<sdf", "does not parse"),
    ],
)
def test_numbers_that_give_no_pose_are_refused(old: str, new: str, message: str) -> None:
    assert old in TWO_LINKS
    with pytest.raises(ValueError, match=f"urdf: .*{message}"):
        RobotArm(TWO_LINKS.replace(old, new), "tip")


@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-7"])
def test_entities_are_refused_in_any_encoding(tmp_path, encoding: str) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "evil.urdf"
    evil = f'<?xml version="1.0" encoding="{encoding}"?><!DOCTYPE r [<!ENTITY tip SYSTEM "file:///etc/passwd">]>'
    path.write_bytes((evil + TWO_LINKS.strip().replace('"tip"', '"&tip;"')).encode(encoding))
    with pytest.raises(ValueError, match="urdf: "):
        RobotArm(path, "tip")


def test_a_joint_without_an_axis_turns_about_x() -> None:
    arm = RobotArm(TWO_LINKS.replace('<axis xyz="0 0 1"/>', ""), "tip")
    turned = arm(torch.tensor([math.pi / 2, 0.0]))
    torch.testing.assert_close(turned[:3, 0], torch.tensor([1.0, 0.0, 0.0]))


@pytest.mark.parametrize(("count", "works"), [(100, True), (101, False), (20_000, False)])
def test_chains_are_as_long_as_can_be_copied(count: int, works: bool) -> None:
    links = "".join(f'<link name="{i}"/>' for i in range(count + 1))
    joints = "".join(
        f'<joint name="j{i}" type="continuous"><parent link="{i}"/><child link="{i + 1}"/></joint>'
        for i in range(count)
    )
    text = f"<robot>{links}{joints}</robot>"
    if works:
        assert RobotArm(text, str(count))(torch.zeros(count)).isfinite().all()
    else:
        with pytest.raises(ValueError, match="urdf: expected at most 100 joints from the root"):
            RobotArm(text, str(count))


def test_building_an_arm_is_quiet_and_importing_is_light() -> None:
    script = (
        "import sys, torch; before = torch.random.get_rng_state(); import torch_ebip.kinematics as k;"
        "assert 'pytorch_kinematics' not in sys.modules and 'matplotlib' not in sys.modules;"
        "k.RobotArm.ur5()(torch.zeros(6));"
        "assert torch.equal(before, torch.random.get_rng_state())"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_a_loop_of_links_is_no_tree() -> None:
    back = '<joint name="back" type="fixed"><parent link="tip"/><child link="base"/></joint></robot>'
    with pytest.raises(ValueError, match="urdf: expected a tree of links, got a loop"):
        RobotArm(TWO_LINKS.replace("</robot>", back), "tip")


def test_a_tool_of_whole_numbers() -> None:
    arm = RobotArm.ur5(torch.eye(4, dtype=torch.int64))
    assert arm.tool.dtype == torch.get_default_dtype()
    assert torch.equal(arm(torch.zeros(6)), RobotArm.ur5()(torch.zeros(6)))
    assert "n_joints=6" in repr(arm)
