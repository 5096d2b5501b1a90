"""The scene in a physics simulator (MuJoCo): the arm with its limits, the box, the ball.

Only this folder imports the simulator.
"""

from experiments.ball_catching.scene.reach import Posture, Reach
from experiments.ball_catching.scene.servo import Limits, travel_time
from experiments.ball_catching.scene.world import World

__all__ = ["Limits", "Posture", "Reach", "World", "travel_time"]
