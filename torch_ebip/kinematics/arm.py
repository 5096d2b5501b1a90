"""A serial robot arm as an `nn.Module`: joint angles in, pose of the tool out, differentiable.

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
from importlib import resources
from os import PathLike
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from torch_ebip.ambient import own_modes, owned, without_autocast
from torch_ebip.arguments import as_values
from torch_ebip.kinematics.urdf import UrdfJoint, Vector, chain_of_joints, followed, read_urdf
from torch_ebip.meaning import Meaning


class _Chain(NamedTuple):
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


class RobotArm(Meaning):
    """Forward kinematics of the chain from a root link to `end_link`, followed by a fixed tool.

    Args:
        urdf: path of a URDF file, or the text of one (recognised by its first non-blank character, "<").
        end_link: link whose frame carries the tool.
        tool: homogeneous transform from `end_link` to the tool, shape [4, 4], metres; identity if left out.
        root_link: link whose frame poses are given in; default: the root of the URDF's tree.

    Raises:
        ValueError: a URDF that cannot be read or gives no pose, no such link, or no such transform.

    `joint_names` is a tuple in the order of the joint vector: joints that mimic another are not in it.

    Example:
        >>> RobotArm.ur5()(torch.zeros(6))[:3, 3]  # the flange, metres
        tensor([-0.8173, -0.1915, -0.0055])
    """

    tool: Tensor

    def __init__(
        self,
        urdf: str | PathLike[str],
        end_link: str,
        tool: Tensor | None = None,
        root_link: str | None = None,
    ) -> None:
        super().__init__()
        root, joints = chain_of_joints(read_urdf(urdf), end_link, root_link)
        follows = followed(joints)
        moving = [joint for joint in joints if joint.kind != "fixed"]
        self.joint_names: tuple[str, ...] = tuple(joint.name for joint in moving if joint.mimic is None)
        with own_modes(inference=True), torch.device("cpu"):
            self._master = _constants(root, joints, follows, self.joint_names)
        self._limits, self._speeds = _limits(moving, follows, self.joint_names)
        self._free = [joint.mimic is None for joint in moving]
        self._units = tuple("m" if _named(moving, name).kind == "prismatic" else "rad" for name in self.joint_names)
        self._chains: dict[tuple[torch.dtype, torch.device], _Chain] = {}
        self.register_buffer("tool", owned(_checked_tool(tool)))

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
    def joint_units(self) -> tuple[str, ...]:
        """Unit of every joint's value: "rad", or "m" where it slides."""
        return self._units

    @property
    def joint_limits(self) -> Tensor:
        """Lower and upper limit of every joint, [n_joints, 2] rad or m; infinite where the URDF states none.

        Those of joints that mimic it count as well.
        """
        return torch.tensor(self._limits, dtype=self.tool.dtype, device=self.tool.device).view(-1, 2)

    @property
    def velocity_limits(self) -> Tensor:
        """Largest speed of every joint, [n_joints] rad/s or m/s; infinite where the URDF states none."""
        return torch.tensor(self._speeds, dtype=self.tool.dtype, device=self.tool.device)

    @without_autocast
    def forward(self, joints: Tensor) -> Tensor:
        """Pose of the tool in the arm's base frame, in the wider of the joints' and the module's dtype.

        Args:
            joints: [..., n_joints], rad (m where a joint slides), on the module's device. With a value for each joint
                that mimics another as well, as drivers publish them: those are not looked at.

        Returns:
            homogeneous transforms [..., 4, 4], metres.

        Raises:
            ValueError: another number of joints, another device.
        """
        if not isinstance(joints, Tensor):
            joints = as_values("joints", joints, self.joint_names, self.tool)
        if joints.ndim > 0 and len(self._free) > self.n_joints == joints.shape[-1] - self._free.count(False):
            joints = joints[..., [place for place, free in enumerate(self._free) if free]]
        if joints.ndim == 0 or joints.shape[-1] != self.n_joints:
            raise ValueError(
                f"joints: expected shape [..., {self.n_joints}] ({', '.join(self.joint_names)}), "
                f"got {list(joints.shape)}"
            )
        if joints.device != self.tool.device:
            raise ValueError(f"joints: expected on the arm's device, {self.tool.device}, got {joints.device}")
        dtype = torch.promote_types(joints.dtype, self.tool.dtype)
        chain = self._chain(dtype, joints.device)
        values = joints.to(dtype)
        return _pose(values, chain) @ self.tool.to(dtype)

    def extra_repr(self) -> str:
        """Sizes."""
        return f"n_joints={self.n_joints}"

    def meant(self) -> str:
        """What its tool is the tool of, see `Meaning`: joints, and where the end link is at a few of their values."""
        zeros = torch.zeros(self.n_joints, dtype=torch.float64, device="cpu")
        chain = self._chain(torch.float64, zeros.device)
        ends = [(_pose(zeros + value, chain))[:3].flatten().tolist() for value in (0.0, 0.5)]
        return (
            f"joints={', '.join(self.joint_names)}; ends={[round(number, 6) + 0.0 for end in ends for number in end]}"
        )

    def _chain(self, dtype: torch.dtype, device: torch.device) -> _Chain:
        """The constants in one dtype on one device, cast once from the float64 originals."""
        key = (dtype, device)
        if key not in self._chains:
            with own_modes(inference=True):  # whoever asks first, everybody may differentiate
                cast = (part.to(device, dtype if part.is_floating_point() else None) for part in self._master)
                self._chains[key] = _Chain(*cast)
        return self._chains[key]


def _pose(joints: Tensor, chain: _Chain) -> Tensor:
    """Pose [..., 4, 4] of the end link at some values [..., n_joints] of the free joints."""
    if chain.sources.numel() == 0:
        return chain.end.expand(*joints.shape[:-1], 4, 4)
    values = torch.addcmul(chain.shifts, joints[..., chain.sources], chain.multipliers)
    motions = chain.offsets @ _motions(values, chain)
    pose = motions[..., 0, :, :]
    for joint in range(1, motions.shape[-3]):
        pose = pose @ motions[..., joint, :, :]
    return pose @ chain.end


def _motions(values: Tensor, chain: _Chain) -> Tensor:
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


def _named(joints: Sequence[UrdfJoint], name: str) -> UrdfJoint:
    return next(joint for joint in joints if joint.name == name)


def _limits(
    moving: Sequence[UrdfJoint], follows: Sequence[tuple[str, float, float]], free: Sequence[str]
) -> tuple[list[list[float]], list[float]]:
    """Positions and speeds that the free joints may take, so that all that follow them keep within theirs."""
    limits = {name: [-math.inf, math.inf] for name in free}
    speeds = dict.fromkeys(free, math.inf)
    for joint, (source, multiplier, offset) in zip(moving, follows, strict=True):
        if multiplier == 0:
            continue
        if joint.limits is not None:
            ends = sorted((end - offset) / multiplier for end in joint.limits)
            limits[source] = [max(limits[source][0], ends[0]), min(limits[source][1], ends[1])]
        if joint.speed is not None:
            speeds[source] = min(speeds[source], joint.speed / abs(multiplier))
    return list(limits.values()), list(speeds.values())


def _checked_tool(tool: Tensor | None) -> Tensor:
    """The tool transform as an own [4, 4] floating-point tensor."""
    if tool is None:
        return torch.eye(4, device="cpu")
    if tool.shape != (4, 4):
        raise ValueError(f"tool: expected a homogeneous transform of shape [4, 4], got {list(tool.shape)}")
    if not tool.is_floating_point():
        tool = tool.to(torch.get_default_dtype())
    if not torch.equal(tool[3].cpu(), torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=tool.dtype, device="cpu")):
        raise ValueError(f"tool: expected the last row 0, 0, 0, 1 (a homogeneous transform), got {tool[3].tolist()}")
    return tool.detach().clone()


def _constants(
    root: str, joints: Sequence[UrdfJoint], follows: Sequence[tuple[str, float, float]], free: Sequence[str]
) -> _Chain:
    """The constants of a chain in float64, its frames by pytorch-kinematics."""
    # Imported here: it pulls in matplotlib, which nobody without an arm should wait for.
    from pytorch_kinematics import Transform3d
    from pytorch_kinematics.chain import Chain, SerialChain
    from pytorch_kinematics.frame import Frame, Joint, Link

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
    chain = SerialChain(Chain(first, dtype=torch.float64), joints[-1].child if joints else root, dtype=torch.float64)
    offsets, offset = [], torch.eye(4, dtype=torch.float64, device="cpu")
    # Frame 0 is the root link's, which no joint moves.
    for joint, place in zip(joints, chain.joint_offsets[1:], strict=True):
        offset = offset if place is None else offset @ place[0]
        if joint.kind != "fixed":
            offsets.append(offset)
            offset = torch.eye(4, dtype=torch.float64, device="cpu")
    slides = [joint.kind == "prismatic" for joint in joints if joint.kind != "fixed"]
    sources, multipliers, shifts = zip(*follows, strict=True) if follows else ((), (), ())
    return _Chain(
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
