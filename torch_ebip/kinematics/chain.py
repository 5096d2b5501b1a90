"""The kinematic chain of an arm: constants of its joints, and the product along it.

The kinematic chain itself is pytorch-kinematics' (https://github.com/UM-ARM-Lab/pytorch_kinematics), with
three things put right around it:

- its URDF reader rounds every origin to float32, takes a joint without an axis to turn about z instead of x, and
  expects well-meant files: here the tree is assembled in float64 from what `urdf.py` reads;
- its chains are plain objects, so `arm.double()` or `arm.to("cuda")` would leave them behind: here one chain
  a dtype and device is cast from the float64 original when it is first needed, so that casting there and
  back loses nothing;
- its product along the chain writes in place, which `torch.vmap` cannot do, and its default backward pass is a
  `torch.autograd.Function` whose own derivative is silently wrong: here its matrices are multiplied out of place and
  differentiated by autograd, which is right to any order;
- it takes a joint that mimics another for a free one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_ebip.common.brief import brief
from torch_ebip.kinematics.urdf import UrdfJoint, Vector


class Chain(NamedTuple):
    """What of an arm's n joints is constant, in one dtype on one device.

    Attributes:
        offsets: [n, 4, 4], from the frame before each joint to the joint's own.
        axes: [n, 3], of their motion.
        slides: bool [n, 1, 1], whether a joint is prismatic.
        end: [4, 4], from the last joint to the end link.
        sources: int64 [n], which free joint each follows.
        multipliers, shifts: [n], how.
    """

    offsets: Tensor
    axes: Tensor
    slides: Tensor
    end: Tensor
    sources: Tensor
    multipliers: Tensor
    shifts: Tensor

    def __repr__(self) -> str:
        return brief(self)


def pose_of(joints: Tensor, chain: Chain) -> Tensor:
    """Pose [..., 4, 4] of the end link at some values [..., n_joints] of the free joints."""
    if chain.sources.numel() == 0:
        return chain.end.expand(*joints.shape[:-1], 4, 4)
    values = torch.addcmul(chain.shifts, joints[..., chain.sources], chain.multipliers)
    motions = chain.offsets @ _motions(values, chain)
    pose = motions[..., 0, :, :]
    for joint in range(1, motions.shape[-3]):
        pose = pose @ motions[..., joint, :, :]
    return pose @ chain.end


def _motions(values: Tensor, chain: Chain) -> Tensor:
    """Homogeneous transforms [..., n, 4, 4] of joints at some values [..., n]."""
    from pytorch_kinematics.transforms.rotation_conversions import axis_and_angle_to_matrix_33

    axes = chain.axes.expand(*values.shape, 3)
    identity = torch.eye(4, dtype=values.dtype, device=values.device)
    turned = axis_and_angle_to_matrix_33(axes, values)
    motions = functional.pad(turned, (0, 1, 0, 1)) + identity[3:].T @ identity[3:]
    if bool(chain.slides.any()):
        slid = identity + functional.pad((axes * values.unsqueeze(-1)).unsqueeze(-1), (3, 0, 0, 1))
        motions = torch.where(chain.slides, slid, motions)
    return motions


def constants_of(
    root: str, joints: Sequence[UrdfJoint], follows: Sequence[tuple[str, float, float]], free: Sequence[str]
) -> Chain:
    """The constants of a chain in float64, its frames by pytorch-kinematics."""
    try:  # imported here: it pulls in matplotlib, which nobody without an arm should wait for
        from pytorch_kinematics import Transform3d
        from pytorch_kinematics.chain import Chain as Tree
        from pytorch_kinematics.chain import SerialChain
        from pytorch_kinematics.frame import Frame, Joint, Link
    except ImportError as error:
        raise ImportError(f"arms need pytorch-kinematics: pip install pytorch-kinematics ({error})") from error

    first = Frame(root, Link(root), Joint(dtype=torch.float64))
    tip = first
    for joint in joints:
        frame = Frame(
            joint.child,
            Link(joint.child),
            Joint(
                joint.name,
                offset=Transform3d(matrix=_origin(joint.xyz, joint.rpy), dtype=torch.float64),
                joint_type=joint.kind,
                # The axis of a fixed joint may be anything, and is divided by its length.
                axis=None if joint.kind == "fixed" else joint.axis,
                dtype=torch.float64,
            ),
        )
        tip.add_child(frame)
        tip = frame
    chain = SerialChain(Tree(first, dtype=torch.float64), joints[-1].child if joints else root, dtype=torch.float64)
    offsets, offset = [], torch.eye(4, dtype=torch.float64, device="cpu")
    # Frame 0 is the root link's, which no joint moves.
    for joint, place in zip(joints, chain.joint_offsets[1:], strict=True):
        offset = offset if place is None else offset @ place[0]
        if joint.kind != "fixed":
            offsets.append(offset)
            offset = torch.eye(4, dtype=torch.float64, device="cpu")
    slides = [joint.kind == "prismatic" for joint in joints if joint.kind != "fixed"]
    sources, multipliers, shifts = zip(*follows, strict=True) if follows else ((), (), ())
    return Chain(
        torch.stack(offsets) if offsets else offset.new_empty(0, 4, 4),
        chain.axes.to(torch.float64),
        torch.tensor(slides, dtype=torch.bool, device="cpu").view(-1, 1, 1),
        offset,
        torch.tensor([free.index(name) for name in sources], dtype=torch.long, device="cpu"),
        offset.new_tensor(multipliers),
        offset.new_tensor(shifts),
    )


def _origin(xyz: Vector, rpy: Vector) -> Tensor:
    """A URDF <origin xyz rpy> as a homogeneous transform [4, 4]; R = Rz(yaw) Ry(pitch) Rx(roll)."""
    roll, pitch, yaw = rpy
    cr, sr, cp, sp = math.cos(roll), math.sin(roll), math.cos(pitch), math.sin(pitch)
    cy, sy = math.cos(yaw), math.sin(yaw)
    x, y, z = xyz
    return torch.tensor(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr, x],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr, y],
            [-sp, cp * sr, cp * cr, z],
            [0, 0, 0, 1],
        ],
        dtype=torch.float64,
        device="cpu",
    )
