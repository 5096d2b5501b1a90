"""A serial robot arm as an `nn.Module`: joint angles in, pose of the tool out, differentiable.

The kinematic chain itself is pytorch-kinematics' (https://github.com/UM-ARM-Lab/pytorch_kinematics), with
three things put right around it:

- its URDF reader rounds every origin to float32, takes a joint without an axis to turn about z instead of x, and
  expects well-meant files: here the tree is assembled in float64 from what `urdf.py` reads;
- its chains are plain objects, so `arm.double()` or `arm.to("cuda")` would leave them behind: here one chain
  a dtype and device is cast from the float64 original when it is first needed, so that casting there and
  back loses nothing;
- its default backward pass is a `torch.autograd.Function` whose own derivative is silently wrong: here the
  chain is differentiated by autograd, which is right to any order.
"""

from __future__ import annotations

import copy
import math
from importlib import resources
from os import PathLike
from typing import Any

import torch
from torch import Tensor, nn

from torch_ebip.kinematics.urdf import Vector, chain_of_joints, read_urdf


class RobotArm(nn.Module):
    """Forward kinematics of the chain from a URDF's root link to `end_link`, followed by a fixed tool.

    Args:
        urdf: path of a URDF file, or the text of one (recognised by its first non-blank character, "<").
        end_link: link whose frame carries the tool.
        tool: homogeneous transform from `end_link` to the tool, shape [4, 4], metres; identity if left out.

    Raises:
        ValueError: a URDF that cannot be read or gives no pose, no such link, or no such transform.

    `joint_names` is a tuple in the order of the joint vector.
    """

    tool: Tensor

    def __init__(self, urdf: str | PathLike[str], end_link: str, tool: Tensor | None = None) -> None:
        super().__init__()
        self._master = _build_chain(read_urdf(urdf), end_link)
        self._chains: dict[tuple[torch.dtype, torch.device], Any] = {}
        self.joint_names: tuple[str, ...] = tuple(self._master.get_joint_parameter_names())
        self.register_buffer("tool", _checked_tool(tool))

    @classmethod
    def ur5(cls, tool: Tensor | None = None) -> RobotArm:
        """Universal Robots UR5 (CB3 series), in the manufacturer's Denavit-Hartenberg base frame.

        Args:
            tool: homogeneous transform flange -> tool, shape [4, 4], metres; identity if left out.
        """
        text = resources.files("torch_ebip.kinematics").joinpath("ur5.urdf").read_text(encoding="utf-8")
        return cls(text, "flange", tool)

    @property
    def n_joints(self) -> int:
        """How many joints move."""
        return len(self.joint_names)

    @property
    def joint_limits(self) -> Tensor:
        """Lower and upper limit of every joint, [n_joints, 2] rad; infinite where the URDF states none."""
        return torch.tensor(self._master.get_joint_limits(), dtype=self.tool.dtype, device=self.tool.device).T

    @property
    def velocity_limits(self) -> Tensor:
        """Largest speed of every joint, [n_joints] rad/s; infinite where the URDF states none."""
        _, speed = self._master.get_joint_velocity_limits()
        return torch.tensor(speed, dtype=self.tool.dtype, device=self.tool.device)

    def forward(self, joints: Tensor) -> Tensor:
        """Pose of the tool in the arm's base frame, in the wider of the joints' and the module's dtype.

        Args:
            joints: angles [..., n_joints], rad, on the module's device.

        Returns:
            homogeneous transforms [..., 4, 4], metres.
        """
        if joints.ndim == 0 or joints.shape[-1] != self.n_joints:
            raise ValueError(
                f"joints: expected shape [..., {self.n_joints}] ({', '.join(self.joint_names)}), "
                f"got {list(joints.shape)}"
            )
        if joints.device != self.tool.device:
            raise ValueError(f"joints: expected on the arm's device, {self.tool.device}, got {joints.device}")
        dtype = torch.promote_types(joints.dtype, self.tool.dtype)
        chain = self._chain(dtype, joints.device)
        flat = joints.to(dtype).reshape(math.prod(joints.shape[:-1]), self.n_joints)
        # The last frame is the end link: the chain is serial and its frames are numbered from the root.
        flange = chain.forward_kinematics_tensor(flat, analytical_grad=False)[-1]
        pose: Tensor = flange @ self.tool.to(dtype)
        return pose.reshape(*joints.shape[:-1], 4, 4)

    def extra_repr(self) -> str:
        """Sizes."""
        return f"n_joints={self.n_joints}"

    def _chain(self, dtype: torch.dtype, device: torch.device) -> Any:
        """pytorch-kinematics' chain in one dtype on one device, cast once from the float64 original."""
        key = (dtype, device)
        if key not in self._chains:
            self._chains[key] = copy.deepcopy(self._master).to(dtype=dtype, device=device)
        return self._chains[key]


def _checked_tool(tool: Tensor | None) -> Tensor:
    """The tool transform as an own [4, 4] floating-point tensor."""
    if tool is None:
        return torch.eye(4)
    if tool.shape != (4, 4):
        raise ValueError(f"tool: expected a homogeneous transform of shape [4, 4], got {list(tool.shape)}")
    if not tool.is_floating_point():
        tool = tool.to(torch.get_default_dtype())
    if not torch.equal(tool[3].cpu(), torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=tool.dtype)):
        raise ValueError(f"tool: expected the last row 0, 0, 0, 1 (a homogeneous transform), got {tool[3].tolist()}")
    return tool.detach().clone()


def _build_chain(text: str, end_link: str) -> Any:
    """pytorch-kinematics' `SerialChain` in float64 from the root link to `end_link`."""
    # Imported here: it pulls in matplotlib, which nobody without an arm should wait for.
    from pytorch_kinematics import Transform3d
    from pytorch_kinematics.chain import Chain, SerialChain
    from pytorch_kinematics.frame import Frame, Joint, Link

    link, joints = chain_of_joints(text, end_link)
    root = Frame(link, Link(link), Joint(dtype=torch.float64))
    tip = root
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
                limits=joint.limits,
                velocity_limits=None if joint.speed is None else (-joint.speed, joint.speed),
            ),
        )
        tip.add_child(frame)
        tip = frame
    return SerialChain(Chain(root, dtype=torch.float64), end_link, dtype=torch.float64)


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
    )
