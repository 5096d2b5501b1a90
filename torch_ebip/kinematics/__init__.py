"""Robot kinematics. The one place that knows pytorch-kinematics, imported when an arm is built."""

from torch_ebip.kinematics.arm import RobotArm

__all__ = ["RobotArm"]
