"""The simulated world: one arm, one ball, and what becomes of a toss.

Time runs in steps of a millisecond. Until its release the ball is carried along by the hand and touches nothing;
then it flies under gravity and drag, and meets box, arm, table and floor.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from experiments.ball_catching.flight import BALL_MASS, BALL_RADIUS, DRAG
from experiments.ball_catching.geometry import BOX_DEPTH, BOX_WIDTH, GRAVITY, Array
from experiments.ball_catching.scene.model import STEP, build, load_mujoco
from experiments.ball_catching.scene.servo import Limits, Servo


class World:
    """One scene, to be used for one toss after the other.

    Args:
        limits: of the arm.
    """

    def __init__(self, limits: Limits | None = None) -> None:
        self._mujoco = load_mujoco()
        self.model: Any = build()
        self.data: Any = self._mujoco.MjData(self.model)
        self.servo = Servo(self.model, self.data, limits)
        self._box, self._ball = self.model.body("ur5/box").id, self.model.body("ball").id
        self._site = self.model.site("ur5/box").id
        self._body_of_geom = np.array(self.model.geom_bodyid)
        self._ball_collides = int(self.model.geom("ball").conaffinity[0])
        self.reset(np.zeros(6))

    def reset(self, joints: Array) -> None:
        """Time 0: the arm rests at joints [6], rad; the ball is out of the way."""
        self._mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:6] = joints
        self.servo.start(joints)
        self.carry(np.array([0.0, 0.0, 1.0]))
        self._mujoco.mj_forward(self.model, self.data)
        self.touched_box: float | None = None
        self.touched: float | None = None

    @property
    def time(self) -> float:
        """Seconds since `reset`."""
        return float(self.data.time)

    @property
    def joints(self) -> Array:
        """[6], rad."""
        return np.array(self.data.qpos[:6])

    @property
    def ball(self) -> Array:
        """Position [3], m."""
        return np.array(self.data.qpos[6:9])

    @property
    def box(self) -> tuple[Array, Array]:
        """The box's centre [3], m, and its axes as columns [3, 3]; the third one leaves by the opening."""
        site = self.data.site(self._site)
        return np.array(site.xpos), np.array(site.xmat).reshape(3, 3)

    def carry(self, position: Array) -> None:
        """Put the ball into the hand, [3] m: it stays there and touches nothing until `release`."""
        self._carried = np.array(position)
        self.model.geom("ball").conaffinity[:] = 0
        self.data.qpos[6:13] = (*position, 1.0, 0.0, 0.0, 0.0)
        self.data.qvel[6:] = 0.0

    def release(self, position: Array, velocity: Array) -> None:
        """Let the ball go at a position [3], m, with a velocity [3], m/s."""
        self._carried = None
        self.model.geom("ball").conaffinity[:] = self._ball_collides
        self.data.qpos[6:9] = position
        # The integrator takes a step with the velocity at its end: half a step's fall ahead makes gravity exact.
        self.data.qvel[6:9] = velocity + np.array([0.0, 0.0, 0.5 * GRAVITY * STEP])

    def step(self) -> None:
        """One millisecond."""
        data = self.data
        self.servo.drive(self.time)
        if self._carried is None:
            velocity = np.array(data.qvel[6:9])
            data.xfrc_applied[self._ball, :3] = -BALL_MASS * DRAG * np.linalg.norm(velocity) * velocity
        else:
            data.qpos[6:9], data.qvel[6:] = self._carried, 0.0
        self._mujoco.mj_step(self.model, data)
        if data.ncon and self._carried is None:
            bodies = self._body_of_geom[data.contact.geom[: data.ncon]]
            met = bodies[(bodies == self._ball).any(-1)]
            if len(met):
                self.touched = self.time if self.touched is None else self.touched
                if self.touched_box is None and (met == self._box).any():
                    self.touched_box = self.time

    def holds_ball(self) -> bool:
        """Whether the ball's centre is within the box's walls and below its rim."""
        centre, axes = self.box
        place = axes.T @ (self.ball - centre)
        half = BOX_WIDTH / 2
        return bool(np.abs(place[:2]).max() < half and -BOX_DEPTH / 2 - BALL_RADIUS < place[2] < BOX_DEPTH / 2)
