"""A serial robot arm as an `nn.Module`: joint angles in, pose of the tool out, differentiable.

The chain, and what is put right around pytorch-kinematics, is in `chain`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from importlib import resources
from os import PathLike

import torch
from torch import Tensor

from torch_ebip.common.ambient import own_modes, owned, without_autocast
from torch_ebip.common.arguments import as_values
from torch_ebip.common.meaning import Meaning
from torch_ebip.kinematics.chain import Chain, constants_of, pose_of
from torch_ebip.kinematics.urdf import UrdfJoint, chain_of_joints, followed, read_urdf


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
        >>> import torch
        >>> from torch_ebip import RobotArm
        >>> RobotArm.ur5()(torch.zeros(6))[:3, 3]  # the flange, metres
        tensor([-0.8173, -0.1914, -0.0055])
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
            self._master = constants_of(root, joints, follows, self.joint_names)
        self._limits, self._speeds = _limits(moving, follows, self.joint_names)
        self._free = [joint.mimic is None for joint in moving]
        self._units = tuple("m" if _named(moving, name).kind == "prismatic" else "rad" for name in self.joint_names)
        self._chains: dict[tuple[torch.dtype, torch.device], Chain] = {}
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
        return pose_of(values, chain) @ self.tool.to(dtype)

    def extra_repr(self) -> str:
        """Sizes."""
        return f"n_joints={self.n_joints}"

    def meant(self) -> str:
        """What its tool is the tool of, see `Meaning`: joints, and where the end link is at a few of their values."""
        zeros = torch.zeros(self.n_joints, dtype=torch.float64, device="cpu")
        chain = self._chain(torch.float64, zeros.device)
        ends = [(pose_of(zeros + value, chain))[:3].flatten().tolist() for value in (0.0, 0.5)]
        return (
            f"joints={', '.join(self.joint_names)}; ends={[round(number, 6) + 0.0 for end in ends for number in end]}"
        )

    def _chain(self, dtype: torch.dtype, device: torch.device) -> Chain:
        """The constants in one dtype on one device, cast once from the float64 originals."""
        key = (dtype, device)
        if key not in self._chains:
            with own_modes(inference=True):  # whoever asks first, everybody may differentiate
                cast = (part.to(device, dtype if part.is_floating_point() else None) for part in self._master)
                self._chains[key] = Chain(*cast)
        return self._chains[key]


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
