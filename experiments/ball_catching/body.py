"""The thrower's body: a tree of rigid segments whose motion is propagated from the pelvis outwards.

Velocities and accelerations follow the recursion of Newton-Euler dynamics (Craig, "Introduction to Robotics",
section 6.5), so that the inertial unit on the forearm and the ground reaction are exact for the given joint
motion. Segment lengths, masses and centres of mass are fractions of stature and body mass after Winter,
"Biomechanics and Motor Control of Human Movement", table 4.1 and figure 4.1. Shapes: N throws, T samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.ball_catching.geometry import GRAVITY, Array
from experiments.ball_catching.motion import Motion

COORDINATES = (
    "pelvis_x",
    "pelvis_y",
    "pelvis_z",
    "trunk_yaw",
    "trunk_pitch",
    "shoulder_plane",
    "shoulder_elevation",
    "shoulder_axial",
    "elbow",
    "pronation",
    "left_plane",
    "left_elevation",
    "left_elbow",
)
"""Generalised coordinates, m and rad. An arm at zero hangs; elevation lifts it forward, the plane turns that
lift about the trunk's vertical (negative: outward for the right arm), elbow flexion lifts the forearm."""
THROWING = slice(COORDINATES.index("trunk_yaw"), COORDINATES.index("elbow") + 1)
"""The six joints that carry the throwing hand."""

UPPER_ARM, FOREARM, GRIP, SHOULDER, HIP_HEIGHT, TRUNK = 0.186, 0.146, 0.054, 0.129, 0.530, 0.288
EYES, FOOT_LENGTH, FOOT_WIDTH = 0.936, 0.152, 0.055
MASS = {"upper_arm": 0.028, "forearm_hand": 0.022, "trunk_head": 0.578, "leg": 0.161}
IMU = 0.75
"""Where the inertial unit sits, as a share of the forearm from the elbow (above the wrist, like a watch)."""


@dataclass(frozen=True)
class Frame:
    """A moving frame seen from the world: rotation R [N, T, 3, 3], origin p, its velocity and acceleration
    [N, T, 3], angular velocity w and acceleration dw [N, T, 3]."""

    R: Array
    p: Array
    v: Array
    a: Array
    w: Array
    dw: Array

    def rotate(self, axis: int, q: Array, qd: Array, qdd: Array) -> Frame:
        """The frame turned about its own axis (0, 1, 2) by q [N, T] rad."""
        z = self.R[..., :, axis]
        c, s = np.cos(q), np.sin(q)
        i, j = (axis + 1) % 3, (axis + 2) % 3
        R = np.array(self.R)
        R[..., :, i] = self.R[..., :, i] * c[..., None] + self.R[..., :, j] * s[..., None]
        R[..., :, j] = self.R[..., :, j] * c[..., None] - self.R[..., :, i] * s[..., None]
        w = self.w + z * qd[..., None]
        dw = self.dw + z * qdd[..., None] + np.cross(self.w, z) * qd[..., None]
        return Frame(R, self.p, self.v, self.a, w, dw)

    def shift(self, r: Array) -> Frame:
        """The frame moved along with the body to r [N, 3], given in the frame's own axes, m."""
        lever = np.einsum("ntij,nj->nti", self.R, r)
        spin = np.cross(self.w, lever)
        a = self.a + np.cross(self.dw, lever) + np.cross(self.w, spin)
        return Frame(self.R, self.p + lever, self.v + spin, a, self.w, self.dw)


@dataclass(frozen=True)
class Body:
    """What the sensors need of the moving body. `head`: between the eyes, [N, T, 3] m; `masses`: of each
    segment kg [N, T], position and acceleration of its centre of mass [N, T, 3]."""

    right_hand: Frame
    left_hand: Frame
    imu: Frame
    trunk: Frame
    head: Array
    masses: list[tuple[Array, Array, Array]]

    def zero_moment_point(self) -> tuple[Array, Array]:
        """Where the ground pushes back, [N, T, 2] m, and how hard, [N, T] N.

        The ground reaction balances gravity and the inertia of every segment; its line of action meets the
        floor at the zero-moment point (Vukobratovic and Borovac, Int. J. Humanoid Robotics 1, 2004).
        """
        gravity = np.array([0.0, 0.0, GRAVITY])
        forces = [m[..., None] * (a + gravity) for m, _, a in self.masses]
        force = np.sum(forces, axis=0)
        moment = np.sum([np.cross(p, f) for (_, p, _), f in zip(self.masses, forces, strict=True)], axis=0)
        vertical = force[..., 2]
        return np.stack([-moment[..., 1], moment[..., 0]], axis=-1) / vertical[..., None], vertical


def _down(length: Array) -> Array:
    """The vector [N, 3] of a segment that hangs along its own -z axis."""
    return np.stack([np.zeros_like(length), np.zeros_like(length), -length], axis=-1)


def move(motion: Motion, stature: Array, mass: Array, feet: tuple[Motion, Motion] | None = None) -> Body:
    """The body's motion for generalised coordinates [N, T, 13], stature [N] m and mass [N] kg.

    Args:
        feet: left and right foot, [N, T, 3] each; without them the legs have no mass.
    """
    q, qd, qdd = motion

    def turn(frame: Frame, axis: int, name: str, sign: float = 1.0) -> Frame:
        c = COORDINATES.index(name)
        return frame.rotate(axis, sign * q[..., c], sign * qd[..., c], sign * qdd[..., c])

    zeros = np.zeros_like(q[..., :3])
    upright = np.broadcast_to(np.eye(3), (*q.shape[:2], 3, 3))
    pelvis = Frame(upright, q[..., :3], qd[..., :3], qdd[..., :3], zeros, zeros)
    trunk = turn(turn(pelvis, 2, "trunk_yaw"), 1, "trunk_pitch")
    up = -_down(stature * TRUNK)
    side = np.stack([np.zeros_like(stature), stature * SHOULDER, np.zeros_like(stature)], axis=-1)
    masses = [(MASS["trunk_head"] * mass, trunk.shift(0.66 * up))]

    def arm(shoulder: Frame, prefix: str, axial: bool) -> tuple[Frame, Frame]:
        upper = turn(shoulder, 2, f"{prefix}_plane")
        upper = turn(upper, 1, f"{prefix}_elevation", -1.0)
        if axial:
            upper = turn(upper, 2, "shoulder_axial")
        masses.append((MASS["upper_arm"] * mass, upper.shift(_down(0.436 * UPPER_ARM * stature))))
        elbow = upper.shift(_down(UPPER_ARM * stature))
        forearm = turn(elbow, 1, "elbow" if axial else "left_elbow", -1.0)
        masses.append((MASS["forearm_hand"] * mass, forearm.shift(_down(0.682 * FOREARM * stature))))
        return forearm, forearm.shift(_down((FOREARM + GRIP) * stature))

    forearm, right_hand = arm(trunk.shift(up - side), "shoulder", True)
    _, left_hand = arm(trunk.shift(up + side), "left", False)
    imu = turn(forearm, 2, "pronation").shift(_down(IMU * FOREARM * stature))
    head = trunk.shift(-_down(stature * (EYES - HIP_HEIGHT)))
    points = [(np.broadcast_to(m[:, None], q.shape[:2]), f.p, f.a) for m, f in masses]
    if feet is not None:
        leg = np.broadcast_to((MASS["leg"] * mass)[:, None], q.shape[:2])
        for foot in feet:
            points.append((leg, 0.553 * pelvis.p + 0.447 * foot.q, 0.553 * pelvis.a + 0.447 * foot.qdd))
    return Body(right_hand, left_hand, imu, trunk, head.p, points)
