"""The simulated counterpart of the paper's set-up (section V): a ball tossed 3.7 m to a UR5 with a box.

One physical account of every toss (`thrower`, `flight`, `teacher`) and sensors derived from it (`sensors`);
the frames are described in `geometry`. The robot's tool in metres: `geometry.base_transform() @
teacher.arm()(joints)` is the centre of the box in the world.
"""

from experiments.ball_catching.dataset import generate, load_or_generate
from experiments.ball_catching.geometry import BOX_WIDTH, base_transform, tool_transform
from experiments.ball_catching.sensors import LAYOUT, SUBSETS

__all__ = [
    "BOX_WIDTH",
    "LAYOUT",
    "SUBSETS",
    "base_transform",
    "generate",
    "load_or_generate",
    "tool_transform",
]
