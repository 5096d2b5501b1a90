"""Where the arm can hold its box: inverse kinematics by damped least squares on MuJoCo's Jacobians."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from experiments.ball_catching.geometry import Array
from experiments.ball_catching.scene.model import build, load_mujoco

# What counts as one unit of error, as the teacher feels it (`teacher.solve`): m, of a unit vector, rad.
POSITION, OPENING, POSTURE = 0.002, 0.15, 2.0


class Posture(NamedTuple):
    """Joints [6], rad; how far the box's centre stays off, m; distance between unit vectors along its opening."""

    joints: Array
    miss: float
    turn: float


class Reach:
    """Solves for postures one after the other, in the branch of arm postures that it starts from."""

    def __init__(self) -> None:
        self._mujoco = load_mujoco()
        self.model: Any = build()
        self._data: Any = self._mujoco.MjData(self.model)
        self._site = self.model.site("ur5/box").id
        self._jacobian = np.zeros((2, 3, self.model.nv))

    def box(self, joints: Array) -> tuple[Array, Array]:
        """The box's centre [3], m, and axes [3, 3] for joints [6], rad."""
        self._data.qpos[:6] = joints
        self._mujoco.mj_kinematics(self.model, self._data)
        site = self._data.site(self._site)
        return np.array(site.xpos), np.array(site.xmat).reshape(3, 3)

    def solve(self, point: Array, opening: Array, start: Array, liked: Array, rounds: int = 25) -> Posture:
        """Joints that put the box's centre at a point [3], m, its opening along a unit vector [3].

        Args:
            point, opening: in the world.
            start: joints [6] to start from, rad.
            liked: joints [6] that the solution is drawn to where the task leaves a choice.
            rounds: iterations at most.
        """
        joints, damping = np.array(start, dtype=np.float64), 1e2
        error, jacobian = self._residual(joints, point, opening, liked)
        for _ in range(rounds):
            normal = jacobian.T @ jacobian
            step = np.linalg.solve(normal + damping * np.eye(6), jacobian.T @ error)
            tried = joints - np.clip(step, -0.5, 0.5)
            after, slope = self._residual(tried, point, opening, liked)
            gained = error @ error - after @ after
            if gained > 0:
                joints, error, jacobian, damping = tried, after, slope, max(0.2 * damping, 1e-6)
                if gained < 1e-3 * (1 + error @ error):
                    break
            else:
                damping *= 6.0
        return Posture(
            joints, float(np.linalg.norm(error[:3])) * POSITION, float(np.linalg.norm(error[3:6])) * OPENING
        )

    def _residual(self, joints: Array, point: Array, opening: Array, liked: Array) -> tuple[Array, Array]:
        centre, axes = self.box(joints)
        self._mujoco.mj_comPos(self.model, self._data)
        self._mujoco.mj_jacSite(self.model, self._data, self._jacobian[0], self._jacobian[1], self._site)
        along = axes[:, 2]
        move, turn = self._jacobian[0, :, :6], self._jacobian[1, :, :6]
        error = np.concatenate([(centre - point) / POSITION, (along - opening) / OPENING, (joints - liked) / POSTURE])
        swing = np.cross(turn.T, along).T  # d(along) = omega x along
        return error, np.concatenate([move / POSITION, swing / OPENING, np.eye(6) / POSTURE])
