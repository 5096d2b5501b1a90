"""The set-up: world frame, where the robot stands, and what it holds. Metres throughout.

World frame: origin on the floor under the thrower, x towards the robot, y to the thrower's left, z up.
The UR5 stands on a table 3.7 m away. Its base frame (the manufacturer's Denavit-Hartenberg base, see
`torch_ebip.kinematics.RobotArm`) has the axes of the world, so at pan angle 0 the arm points at the thrower.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

Array = NDArray[np.float64]

RATE = 60.0
"""Samples per second of every sensor."""
GRAVITY = 9.81
"""m/s^2"""
DISTANCE = 3.7
"""From the thrower to the robot's base axis."""
TABLE_HEIGHT = 0.75
BOX_WIDTH = 0.32
"""Both sides of the box's square opening."""
BOX_DEPTH = 0.24
BRACKET = 0.03
"""From the flange to the bottom of the box."""


def base_transform(dtype: torch.dtype = torch.float64) -> Tensor:
    """Homogeneous transform [4, 4] from the UR5's base frame to the world: p_world = T p_base."""
    transform = torch.eye(4, dtype=dtype)
    transform[:3, 3] = torch.tensor([DISTANCE, 0.0, TABLE_HEIGHT], dtype=dtype)
    return transform


def tool_transform(dtype: torch.dtype = torch.float64) -> Tensor:
    """Homogeneous transform [4, 4] from the flange to the box's centre; its z axis leaves by the opening."""
    transform = torch.eye(4, dtype=dtype)
    transform[2, 3] = BRACKET + BOX_DEPTH / 2
    return transform
