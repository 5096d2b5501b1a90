"""The MuJoCo model: the UR5 of our URDF with capsules for links, the box it holds, the ball, table and floor.

MuJoCo reads the URDF itself, so that the simulated arm is the arm of `RobotArm` to the last digit. Links get the
masses and centres of mass that the manufacturer publishes ("DH parameters for calculations of kinematics and
dynamics", UR5), which count in the frames of the Denavit-Hartenberg table; our links' frames come before a row's
fixed part. Their tensors of inertia are those of the capsules.
"""

from __future__ import annotations

from importlib import resources
from typing import Any, NamedTuple

import numpy as np

from experiments.ball_catching.flight import BALL_MASS, BALL_RADIUS
from experiments.ball_catching.geometry import (
    BOX_DEPTH,
    BOX_WIDTH,
    BRACKET,
    DISTANCE,
    GRAVITY,
    TABLE_HEIGHT,
    Array,
)

STEP = 0.001
"""s, of the physics."""
BOX_MASS = 0.35
"""kg, of cardboard with a bracket."""
WALL = 0.008
"""m, thickness of the box's walls."""
DAMPING = {"box": 1.0, "else": 0.35}
"""Ratios of the contacts' damping. A soft ball jumps back from the box, which is lined, with about a seventh of its
speed, from anything else with two fifths (a unilateral spring and damper lets go where their force is 0)."""
CONTACT_TIME = 0.006
"""s, time constant of a contact."""
FRICTION = (0.6, 0.01, 0.003)
"""Of the ball with anything: sliding, and its resistance to spinning (m) and rolling (m)."""


class Link(NamedTuple):
    """One link: `mass` kg; `centre` of mass in its frame, m; capsules as (from, to, radius), m."""

    mass: float
    centre: tuple[float, float, float]
    capsules: tuple[tuple[tuple[float, float, float], tuple[float, float, float], float], ...]


# Upper arm and forearm run beside the joints' axes, by 0.136 and 0.017 m.
LINKS = {
    "shoulder_link": Link(3.7, (0.0, -0.00193, 0.063549), (((0, 0, 0.0), (0, 0, 0.089), 0.06),)),
    "upper_arm_link": Link(
        8.393,
        (-0.2125, 0.0, 0.11336),
        (((0, 0, 0.0), (0, 0, 0.136), 0.055), ((0, 0, 0.136), (-0.425, 0, 0.136), 0.05)),
    ),
    "forearm_link": Link(
        2.33,
        (-0.24225, 0.0, 0.0265),
        (((0, 0, 0.12), (0, 0, 0.017), 0.05), ((0, 0, 0.017), (-0.392, 0, 0.017), 0.04)),
    ),
    "wrist_1_link": Link(1.219, (0.0, -0.01634, 0.10735), (((0, 0, 0.03), (0, 0, 0.109), 0.037),)),
    "wrist_2_link": Link(1.219, (0.0, 0.01634, 0.09285), (((0, 0, 0.0), (0, 0, 0.095), 0.037),)),
    "wrist_3_link": Link(0.1879, (0.0, 0.0, 0.081141), (((0, 0, 0.03), (0, 0, 0.06), 0.035),)),
}
_ARM, _BOX, _BALL = (0.72, 0.76, 0.80, 1.0), (0.80, 0.62, 0.38, 0.40), (0.90, 0.25, 0.15, 1.0)


def load_mujoco() -> Any:
    """The module `mujoco`; SystemExit with an instruction if it is not installed."""
    try:
        import mujoco
    except ImportError as error:
        raise SystemExit("the simulator is missing: pip install 'torch-ebip[simulator]'") from error
    return mujoco


def build() -> Any:
    """The compiled scene, an `mjModel`: joints of the arm first, then the ball.

    Bodies `ur5/box` and `ball`; the site `ur5/box` is the tool of `tool_transform`.
    """
    mujoco = load_mujoco()
    spec = mujoco.MjSpec()
    spec.option.timestep = STEP
    spec.option.gravity = (0.0, 0.0, -GRAVITY)
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1280, 960
    _surroundings(mujoco, spec)
    _arm(mujoco, spec)
    ball = spec.worldbody.add_body(name="ball")
    ball.add_freejoint(name="ball")
    # A hollow ball: its own moment of inertia, two thirds of m r^2.
    ball.explicitinertial, ball.mass = True, BALL_MASS
    ball.inertia = np.full(3, 2 / 3 * BALL_MASS * BALL_RADIUS**2)
    sphere = ball.add_geom(name="ball", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=(BALL_RADIUS, 0, 0), rgba=_BALL)
    sphere.contype, sphere.conaffinity = 0, 1
    return spec.compile()


def _collider(geom: Any, lined: bool = False) -> None:
    """A geom that touches the ball only: of two geoms one must have the type that the other has an affinity to.

    Of two geoms the one with the higher priority says how their contact is.
    """
    geom.contype, geom.conaffinity = 1, 0
    geom.solref = (CONTACT_TIME, DAMPING["box" if lined else "else"])
    geom.friction, geom.condim, geom.priority = FRICTION, 6, 1


def _surroundings(mujoco: Any, spec: Any) -> None:
    """Light, floor with a chequered pattern, and the table under the robot."""
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = (0.45, 0.45, 0.45), (0.3, 0.3, 0.3)
    sun = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    spec.worldbody.add_light(type=sun, pos=(1.5, -2.0, 5.0), dir=(0.2, 0.5, -1.0), diffuse=(0.5, 0.5, 0.5))
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=(0.96, 0.97, 0.99),
        rgb2=(0.80, 0.85, 0.90),
        width=64,
        height=384,
    )
    spec.add_texture(
        name="floor",
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=(0.88, 0.89, 0.90),
        rgb2=(0.82, 0.83, 0.85),
        width=128,
        height=128,
    )
    material = spec.add_material(name="floor", texrepeat=(10, 10), reflectance=0.02)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "floor"
    plane = mujoco.mjtGeom.mjGEOM_PLANE
    _collider(spec.worldbody.add_geom(name="floor", type=plane, size=(5, 5, 0.1), pos=(2, 0, 0), material="floor"))
    half = TABLE_HEIGHT / 2
    cube = mujoco.mjtGeom.mjGEOM_BOX
    shape = {"size": (0.22, 0.22, half), "pos": (DISTANCE, 0.0, half), "rgba": (0.45, 0.47, 0.50, 1.0)}
    _collider(spec.worldbody.add_geom(name="table", type=cube, **shape))


def _arm(mujoco: Any, spec: Any) -> None:
    """The URDF's chain on the table, its capsules, masses and motors, and the box at its flange."""
    text = resources.files("torch_ebip.kinematics").joinpath("ur5.urdf").read_text(encoding="utf-8")
    arm = mujoco.MjSpec.from_string(text)
    for name, link in LINKS.items():
        body = arm.body(name)
        for start, end, radius in link.capsules:
            capsule = body.add_geom(
                type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=(*start, *end), size=(radius, 0, 0), rgba=_ARM
            )
            _collider(capsule)
        body.explicitinertial, body.mass, body.ipos = True, link.mass, link.centre
        body.inertia = _capsule_inertia(link)
    flange = arm.body("flange")
    flange.name = "box"
    _box(mujoco, flange)
    for joint in arm.joints:
        # Each motor can give the effort of the URDF, which MuJoCo took over as the joint's range of force.
        motor = arm.add_actuator(name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrllimited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.attach(arm, frame=spec.worldbody.add_frame(pos=(DISTANCE, 0.0, TABLE_HEIGHT)), prefix="ur5/")


def _box(mujoco: Any, flange: Any) -> None:
    """Five walls around the opening, and the site of the box's centre."""
    half, depth, centre = BOX_WIDTH / 2, BOX_DEPTH / 2, BRACKET + BOX_DEPTH / 2
    side = half + WALL / 2
    walls: list[tuple[tuple[float, float, float], tuple[float, float, float]]] = [
        ((half + WALL, half + WALL, WALL / 2), (0.0, 0.0, BRACKET - WALL / 2)),
        ((WALL / 2, half + WALL, depth), (side, 0.0, centre)),
        ((WALL / 2, half + WALL, depth), (-side, 0.0, centre)),
        ((half, WALL / 2, depth), (0.0, side, centre)),
        ((half, WALL / 2, depth), (0.0, -side, centre)),
    ]
    areas = np.array([8 * size[0] * size[1] * size[2] for size, _ in walls])
    for (size, pos), mass in zip(walls, BOX_MASS * areas / areas.sum(), strict=True):
        wall = flange.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, pos=pos, mass=mass, rgba=_BOX)
        _collider(wall, lined=True)
    flange.add_site(name="box", pos=(0.0, 0.0, centre))


def _capsule_inertia(link: Link) -> Array:
    """Principal moments [3], kg m^2, about the frame's axes, of the link's longest capsule as a solid cylinder."""
    start, end, radius = max(link.capsules, key=lambda c: float(np.abs(np.subtract(c[1], c[0])).sum()))
    length = np.abs(np.subtract(end, start))
    along, across = 0.5 * radius**2, 0.25 * radius**2 + float(length.max() + 2 * radius) ** 2 / 12
    return link.mass * np.where(length == length.max(), along, across)
