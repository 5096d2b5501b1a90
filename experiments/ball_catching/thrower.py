"""The thrower: people with their habits, styles of throwing, and the plan of one toss.

A toss is planned backwards, as a physicist would: the aim point and the wish for a flat or a high throw give
the velocity at release (`flight.release_velocity`); the arm's posture at release gives, through its Jacobian,
joint velocities that produce it; the wind-up is as wide as accelerating to them takes. Repetition is not
exact: the wobble of every joint is part of the motion, so the ball leaves with what the hand really does, not
with what was intended.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from experiments.ball_catching import body, flight
from experiments.ball_catching.body import COORDINATES, THROWING
from experiments.ball_catching.geometry import DISTANCE, Array
from experiments.ball_catching.motion import Motion, Wobble, through


@dataclass(frozen=True)
class Person:
    """Stature m, mass kg; `styles`: how often underhand, overhand, sidearm; `tempo`: duration of the wind-up
    against the average; `steps`: how often the left foot steps into the throw; `stance`: distance between the
    feet, m, sideways and along x; `gaze`: share of the gaze's turn done by the head; `loft`: habit of
    throwing higher, rad; `facing`: share of the turn towards the target done by the trunk; `bend`: habit of
    bending the elbow at release, rad."""

    stature: float
    mass: float
    styles: tuple[float, float, float]
    tempo: float
    steps: float
    stance: tuple[float, float]
    gaze: float
    loft: float
    facing: float
    bend: float


PEOPLE = (
    Person(1.76, 74.0, (0.80, 0.15, 0.05), 1.00, 0.1, (0.26, 0.16), 0.75, 0.00, 0.60, 0.00),
    Person(1.64, 58.0, (0.90, 0.00, 0.10), 1.10, 0.0, (0.20, 0.06), 0.85, 0.05, 0.80, 0.15),
    Person(1.88, 88.0, (0.15, 0.75, 0.10), 0.92, 0.7, (0.30, 0.24), 0.60, -0.02, 0.45, -0.10),
    Person(1.70, 66.0, (0.45, 0.45, 0.10), 0.96, 0.3, (0.24, 0.20), 0.70, 0.02, 0.55, 0.05),
    Person(1.82, 79.0, (0.10, 0.40, 0.50), 1.05, 0.5, (0.32, 0.18), 0.80, 0.00, 0.70, -0.05),
)


@dataclass(frozen=True)
class Style:
    """One way to throw with the right arm. Angles rad, times s; postures in the order of `body.THROWING`
    (trunk yaw, trunk pitch, shoulder plane, elevation, axial, elbow).

    `share`: how readily each joint contributes to the release velocity; `elevation`: launch angle; `back`,
    `forward`: duration of the back swing and of the acceleration; `left_arm`: plane, elevation, elbow in the
    back swing.
    """

    name: str
    hold: tuple[float, ...]
    release: tuple[float, ...]
    share: tuple[float, ...]
    elevation: float
    back: float
    forward: float
    pronation: tuple[float, float]
    left_arm: tuple[float, float, float]


STYLES = (
    Style(
        "underhand",
        hold=(0.0, 0.10, -0.05, 0.10, 0.1, 0.80),
        release=(0.06, 0.16, -0.10, 0.90, 0.0, 0.55),
        share=(0.10, 0.005, 0.15, 1.0, 0.10, 0.20),
        elevation=1.08,
        back=0.40,
        forward=0.34,
        pronation=(0.2, 0.9),
        left_arm=(0.3, 0.45, 0.9),
    ),
    Style(
        "overhand",
        hold=(0.0, 0.06, -0.45, 0.55, -0.4, 1.90),
        release=(0.10, 0.10, -1.00, 1.60, -0.80, 1.60),
        share=(0.40, 0.03, 0.50, 1.0, 1.0, 0.30),
        elevation=0.64,
        back=0.33,
        forward=0.23,
        pronation=(-0.3, -1.0),
        left_arm=(0.2, 1.15, 0.5),
    ),
    Style(
        "sidearm",
        hold=(0.0, 0.09, -0.25, 0.15, 0.3, 0.95),
        release=(0.22, 0.12, -0.75, 1.00, 0.35, 0.75),
        share=(0.50, 0.01, 0.60, 0.60, 0.45, 0.50),
        elevation=0.90,
        back=0.32,
        forward=0.25,
        pronation=(0.0, 0.4),
        left_arm=(0.6, 0.70, 0.7),
    ),
)

RELAXED = (0.0, 0.04, -0.1, 0.25, 0.0, 0.5)
"""Posture after the follow-through, as `Style.hold`."""
LOWER = np.array([-0.9, -0.2, -1.7, -0.9, -1.5, 0.15])
UPPER = np.array([0.9, 0.7, 0.6, 2.9, 1.2, 2.6])
"""Range of the six joints within which via points are kept, rad."""

# Differences between repetitions, standard deviations: via postures, and wobble of every coordinate.
POSTURE_SPREAD = np.array([0.04, 0.02, 0.05, 0.06, 0.05, 0.07])
WOBBLE = np.array([0.004, 0.004, 0.001, 0.012, 0.005, 0.015, 0.015, 0.02, 0.018, 0.05, 0.03, 0.03, 0.04])
FASTEST = np.array([0.8, 0.8, 0.8, 1.5, 0.8, 3.0, 3.0, 3.0, 3.0, 3.0, 2.5, 2.5, 2.5])
"""Highest frequency of the wobble, Hz: a trunk sways, a forearm trembles."""


@dataclass(frozen=True)
class Throw:
    """N planned tosses; times in seconds since the toss began. `aim`: where the thrower wants the ball [N,
    3]; `look`: when the head turns to it [N]; `lift`, `land`: when the left foot leaves and meets the floor
    (inf: it stays); `sighted`: whether the eyes follow the ball."""

    person: np.ndarray
    style: np.ndarray
    aim: Array
    look: Array
    release: Array
    stature: Array
    mass: Array
    gaze: Array
    lift: Array
    land: Array
    coordinates: tuple[Array, Array, Array, Array]
    wobble: Wobble
    foot: tuple[Array, Array, Array]
    sighted: bool = True

    def motion(self, t: Array) -> Motion:
        """Generalised coordinates [N, T, 13] at times [N, T]."""
        return through(t, *self.coordinates) + self.wobble.at(t)

    def feet(self, t: Array) -> tuple[Motion, Motion]:
        """Left and right foot (a point on the instep), [N, T, 3] m, at times [N, T]."""
        left, right, stride = self.foot
        zero = np.zeros_like(left)
        # A foot that stays has a "step" of no length and no height at an arbitrary time.
        steps = np.isfinite(self.lift)
        lift, land = np.where(steps, self.lift, 0.1), np.where(steps, self.land, 0.4)
        horizontal = np.where(steps[:, None], stride, 0.0)
        end = left + horizontal
        path = through(t, np.stack([lift, land], 1), np.stack([left, end], 1), *[np.stack([zero, zero], 1)] * 2)
        rise = np.zeros((len(t), 3, 3))
        rise[:, 1, 2] = np.where(steps, 0.07, 0.0)
        still = np.zeros_like(rise)
        path += through(t, np.stack([lift, (lift + land) / 2, land], 1), rise, still, still)
        rest = np.broadcast_to(right[:, None], path.q.shape)
        return path, Motion(rest, np.zeros_like(rest), np.zeros_like(rest))

    def body(self, t: Array) -> body.Body:
        """The moving body at times [N, T]."""
        return body.move(self.motion(t), self.stature, self.mass, self.feet(t))


def jacobian(posture: Array, stature: Array) -> Array:
    """Velocity of the right hand per unit speed of each throwing joint, [N, 3, 6], at coordinates [N, 13]."""
    columns = []
    for c in range(THROWING.start, THROWING.stop):
        speed = np.zeros_like(posture)
        speed[:, c] = 1.0
        motion = Motion(posture[:, None], speed[:, None], np.zeros_like(speed)[:, None])
        columns.append(body.move(motion, stature, stature).right_hand.v[:, 0])
    return np.stack(columns, axis=-1)


BLIND_AIM = np.array([0.10, 0.25, 0.12])
"""m, standard deviations of what a blindfolded thrower takes for the robot's place, beyond the sighted one's aims."""
BLIND_ERROR = np.array([0.15, 0.12, 0.12])
"""m, of where the ball then goes, against what was intended."""


def plan(rng: np.random.Generator, n: int, blindfolded: bool = False) -> Throw:
    """Draws people, styles and aims, and plans N tosses.

    Blindfolded, people remember roughly where the robot is, throw less accurately, look where they believe it to
    be and do not follow the ball.
    """
    who = rng.integers(len(PEOPLE), size=n)
    people = [PEOPLE[i] for i in who]
    kind = np.array([rng.choice(len(STYLES), p=person.styles) for person in people])
    styles = [STYLES[i] for i in kind]

    def of_person(name: str) -> Array:
        return np.array([getattr(person, name) for person in people], dtype=np.float64)

    def of_style(name: str) -> Array:
        return np.array([getattr(style, name) for style in styles], dtype=np.float64)

    stature, mass = of_person("stature"), of_person("mass")

    # Where to: anywhere in the catchable region, which bends around the robot.
    aim_y = rng.uniform(-0.8, 0.8, n)
    aim = np.stack([DISTANCE - 0.52 * np.sqrt(1 - (aim_y / 1.15) ** 2), aim_y, rng.normal(1.0, 0.13, n)], axis=-1)
    if blindfolded:
        aim = aim + rng.normal(0.0, 1.0, (n, 3)) * BLIND_AIM
    bearing = np.arctan2(aim[:, 1], aim[:, 0])

    # When: idle, back swing, acceleration, follow-through, relaxing.
    tempo = of_person("tempo") * np.exp(rng.normal(0.0, 0.06, n))
    start = rng.uniform(0.02, 0.12, n)
    turn = start + of_style("back") * tempo * np.exp(rng.normal(0.0, 0.06, n))
    forward = of_style("forward") * tempo * np.exp(rng.normal(0.0, 0.05, n))
    release = turn + forward
    follow = rng.uniform(0.28, 0.40, n)
    knots = np.stack([np.zeros(n), start, turn, release, release + follow, release + follow + 0.75], axis=-1)

    # Feet and pelvis: weight on the rear foot in the back swing, on the front one at release.
    width, length = of_person("stance").T
    width, length = width + rng.normal(0, 0.015, n), length + rng.normal(0, 0.02, n)
    steps = rng.random(n) < of_person("steps")
    centre = np.stack([rng.normal(0.0, 0.04, n), rng.normal(0.0, 0.04, n)], axis=-1)
    instep = np.full(n, 0.07)
    stride = np.stack([np.where(steps, rng.normal(0.30, 0.04, n), 0.0), 0.2 * bearing, np.zeros(n)], axis=-1)
    length = np.where(steps, 0.06, length)
    left = np.stack([centre[:, 0] + length / 2, centre[:, 1] + width / 2, instep], axis=-1)
    right = np.stack([centre[:, 0] - length / 2, centre[:, 1] - width / 2, instep], axis=-1)
    lift = np.where(steps, turn - 0.45 * (turn - start), np.inf)
    land = np.where(steps, turn + 0.55 * forward, np.inf)

    def weight(share_left: Array) -> Array:
        spot: Array = share_left[:, None] * (left + stride) + (1 - share_left)[:, None] * right
        return spot[:, :2]

    q = np.zeros((n, 6, len(COORDINATES)))
    qd, qdd = np.zeros_like(q), np.zeros_like(q)
    begin = (left + right)[:, :2] / 2 + rng.normal(0, 0.008, (n, 2))
    q[:, :2, :2] = begin[:, None]
    # In a movement this fast the centre of mass travels a small part of the way that the weight does: their
    # amplitudes have the ratio 1 + z w^2 / g of a pendulum upside down (Winter, section 5.2.9).
    lag = np.where(steps, 0.30, 0.14)[:, None]
    q[:, 2, :2] = begin + 0.14 * (weight(rng.normal(0.20, 0.05, n)) - begin)
    front = begin + lag * (weight(rng.normal(0.80, 0.05, n)) - begin)
    # ... and towards the target, against which the legs push.
    front += 0.06 * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    q[:, 3, :2] = q[:, 2, :2] + 0.5 * (front - q[:, 2, :2])
    qd[:, 3, :2] = (front - q[:, 2, :2]) / (forward + follow)[:, None] * 1.5
    q[:, 4, :2] = front
    q[:, 5, :2] = begin + 1.3 * (front - begin)
    hip = body.HIP_HEIGHT * stature
    dip = rng.uniform(0.02, 0.05, n) * np.where(kind == 0, 1.3, 0.8)
    q[..., 2] = hip[:, None]
    q[:, 2, 2] -= dip
    q[:, 3, 2] -= 0.2 * dip
    q[:, 4, 2] -= 0.1 * dip

    # Posture: how the ball is held, and the arm at release; the trunk turns with the target.
    def posture(name: str) -> Array:
        drawn: Array = of_style(name) + rng.normal(0.0, 1.0, (n, 6)) * POSTURE_SPREAD
        return drawn

    q[:, :2, THROWING] = posture("hold")[:, None]
    q[:, :2, 3] += (0.25 * of_person("facing") * bearing)[:, None]
    at_release = posture("release")
    at_release[:, 0] += of_person("facing") * bearing
    at_release[:, 2] += 0.6 * (1 - of_person("facing")) * bearing
    at_release[:, 5] += of_person("bend")
    q[:, 3, THROWING] = at_release

    # People stand balanced: the pelvis makes up for how far the held arm and the lean carry the mass.
    zero = np.zeros((n, 1, len(COORDINATES)))
    foot = [Motion(x[:, None], zero[..., :3], zero[..., :3]) for x in (left, right)]
    segments = body.move(Motion(q[:, :1], zero, zero), stature, mass, (foot[0], foot[1])).masses
    centre_of_mass = np.sum([m[..., None] * p for m, p, _ in segments], axis=0)[:, 0, :2] / mass[:, None]
    q[:, :, :2] -= (centre_of_mass - begin)[:, None]

    # How fast: the release velocity that reaches the aim, and the joint velocities that produce it.
    still = Motion(q[:, 3:4], qd[:, 3:4], qdd[:, 3:4])
    hand = body.move(still, stature, mass).right_hand.p[:, 0]
    elevation = of_style("elevation") + of_person("loft") + rng.normal(0.0, 0.07, n)
    hit = aim + rng.normal(0.0, 1.0, (n, 3)) * BLIND_ERROR if blindfolded else aim
    seconds = flight.flight_time(hand, hit, elevation)
    wanted = flight.release_velocity(hand, hit, seconds)
    J = jacobian(q[:, 3], stature)
    share = of_style("share") * np.exp(rng.normal(0.0, 0.1, (n, 6)))
    weighted = share[:, :, None] * J.transpose(0, 2, 1)
    carried = np.concatenate([qd[:, 3, :2], np.zeros((n, 1))], axis=-1)
    speed = (weighted @ np.linalg.solve(J @ weighted, (wanted - carried)[..., None]))[..., 0]
    qd[:, 3, THROWING] = speed

    # Wind-up: with acceleration `c v / T` at the turning point and none at release, the speed rises as a
    # cubic and the joint covers v T (1/2 + c/12). Follow-through: the mirror image, as far as the joints'
    # range allows.
    c = 1.2
    T = forward[:, None]
    back = at_release - speed * T * (0.5 + c / 12)
    q[:, 2, THROWING] = np.clip(back + rng.normal(0, 0.3, (n, 6)) * POSTURE_SPREAD, LOWER, UPPER)
    # Where that posture was out of the joint's range or habit moved it: the acceleration fits the way left.
    way = (at_release - q[:, 2, THROWING]) / np.where(np.abs(speed) > 0.2, speed * T, np.inf)
    qdd[:, 2, THROWING] = np.clip(12 * (way - 0.5), 0.0, 2.0) * speed / T
    q[:, 4, THROWING] = np.clip(at_release + 0.45 * speed * follow[:, None], LOWER, UPPER)
    q[:, 5, THROWING] = np.array(RELAXED) + rng.normal(0.0, 1.0, (n, 6)) * POSTURE_SPREAD
    q[:, 5, 3] += 0.5 * of_person("facing") * bearing

    # The rest of the body follows: the forearm's pronation, and the left arm as a counterweight.
    c_pronation = COORDINATES.index("pronation")
    turn_in, turn_out = of_style("pronation").T
    q[:, :3, c_pronation] = (turn_in + rng.normal(0, 0.15, n))[:, None]
    q[:, 3, c_pronation] = q[:, 2, c_pronation] + 0.45 * (turn_out - turn_in)
    qd[:, 3, c_pronation] = (turn_out - turn_in) / (forward + follow)
    q[:, 4:, c_pronation] = (turn_out + rng.normal(0, 0.15, n))[:, None]
    left_arm = of_style("left_arm") + rng.normal(0, 0.12, (n, 3))
    resting = np.array([0.1, 0.1, 0.35]) + rng.normal(0, 0.08, (n, 3))
    q[:, :2, 10:13] = resting[:, None]
    q[:, 2, 10:13] = left_arm
    q[:, 3, 10:13] = 0.45 * left_arm + 0.55 * resting
    qd[:, 3, 10:13] = (resting - left_arm) / (forward + follow)[:, None]
    q[:, 4:, 10:13] = resting[:, None]
    return Throw(
        person=who,
        style=kind,
        aim=aim,
        look=start + rng.uniform(-0.05, 0.25, n),
        release=release,
        stature=stature,
        mass=mass,
        gaze=of_person("gaze") * np.exp(rng.normal(0.0, 0.08, n)),
        lift=lift,
        land=land,
        coordinates=(knots, q, qd, qdd),
        wobble=Wobble(rng, n, WOBBLE, FASTEST),
        foot=(left, right, stride),
        sighted=not blindfolded,
    )
