"""Make the recordings that `torch_ebip.recordings.example` gives: simulated hand-overs to a UR5.

A person carries something from the side of the body to a place in reach of the arm. The hand follows a bowed path at
the speed of a reach (minimum jerk), the gaze goes ahead of it, and the arm sets out later and is there with it.
"""

from __future__ import annotations

from pathlib import Path

import torch
from torch import Tensor

import torch_ebip
from experiments.command_line import command, experiment_parser
from torch_ebip import Demonstrations, Layout, Modality, RobotArm

COUNT, RATE = 30, 30.0
HOME = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
"""Of the arm, rad."""
PLACE = Path(torch_ebip.__file__).parent / "recordings" / "example.npz"


def make(seed: int = 0) -> Demonstrations:
    """The recordings of a seed."""
    draws = torch.Generator().manual_seed(seed)
    arm = RobotArm.ur5()
    home = torch.tensor(HOME, dtype=torch.float64)
    middle = arm(home)[:3, 3]
    paths = []
    for _ in range(COUNT):
        place = middle + torch.tensor([0.10, 0.15, 0.12]) * torch.randn(3, generator=draws, dtype=torch.float64)
        length = int(torch.randint(45, 76, (), generator=draws))
        phase = torch.linspace(0, 1, length, dtype=torch.float64).unsqueeze(-1)
        rest = place + torch.tensor([-0.55, 0.0, -0.35]) + 0.04 * torch.randn(3, generator=draws).double()
        bow = 0.06 * torch.randn(3, generator=draws).double() + torch.tensor([0.0, 0.0, 0.08])
        hand = rest + (place - rest) * _reach(phase) + bow * (16 * phase**2 * (1 - phase) ** 2)
        aim = place - (rest + torch.tensor([-0.2, 0.0, 0.6]))
        angles = torch.stack([torch.atan2(aim[1], aim[0]), torch.atan2(aim[2], aim[:2].norm())])
        gaze = angles * _reach((phase / 0.45).clamp(max=1)) + 0.03 * torch.randn(length, 2, generator=draws).double()
        goal = _joints_at(arm, home, place)
        goal[-1] = angles[0]  # the gripper turns to where the person comes from
        joints = home + (goal - home) * _reach(((phase - 0.3) / 0.7).clamp(min=0))
        hand = hand + 0.004 * torch.randn(length, 3, generator=draws).double()
        paths.append(torch.cat([hand, gaze, joints], -1).float())
    layout = Layout(
        [
            Modality("hand", ["hand.x", "hand.y", "hand.z"], "m"),
            Modality("gaze", ["gaze.yaw", "gaze.pitch"], "rad"),
            Modality("robot", arm.joint_names, "rad", controlled=True),
        ]
    )
    return Demonstrations(layout, paths, RATE)


def _reach(phase: Tensor) -> Tensor:
    """Flash and Hogan's minimum jerk, from 0 to 1."""
    return 10 * phase**3 - 15 * phase**4 + 6 * phase**5


def _joints_at(arm: RobotArm, start: Tensor, place: Tensor) -> Tensor:
    """Joints [6] near a start that bring the flange to a place [3] m: damped least squares."""
    joints = start.clone()
    for _ in range(50):
        jacobian = torch.autograd.functional.jacobian(lambda q: arm(q)[:3, 3], joints)
        error = place - arm(joints)[:3, 3]
        square = jacobian @ jacobian.T + 1e-3 * torch.eye(3, dtype=joints.dtype)  # type: ignore[operator,union-attr]
        joints = joints + jacobian.T @ torch.linalg.solve(square, error)  # type: ignore[operator,union-attr]
    return joints


@command
def main(arguments: list[str] | None = None) -> None:
    """Run from the command line."""
    parser = experiment_parser("example", __doc__)
    parser.add_argument("--seed", type=int, default=0, help="of all draws (default: 0)")
    parser.add_argument("--out", default=str(PLACE), metavar="FILE.npz", help="default: where the package has them")
    options = parser.parse_args(arguments)
    demonstrations = make(options.seed)
    demonstrations.save(options.out)
    print(f"{demonstrations}; written to {options.out}")


if __name__ == "__main__":
    main()
