"""The teacher: a person who guides the UR5 by hand so that its box meets the ball.

pytorch-kinematics' own inverse kinematics starts from random postures drawn from torch's global generator and
returns whichever branch it falls into, for a full six-dimensional pose. A guided arm stays in one branch and
leaves the box's turn about its opening to habit, so a damped least-squares solver on `RobotArm` is used
instead: it starts from a fixed posture, and its answers are continuous in the target.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from experiments.ball_catching import geometry
from experiments.ball_catching.flight import STEP, Flight
from experiments.ball_catching.geometry import DISTANCE, Array
from experiments.ball_catching.motion import Motion, Wobble, through
from torch_ebip import RobotArm


@dataclass(frozen=True)
class Habit:
    """How a teacher likes to catch. `reach`: how far before the robot, m; `height`: where best, m; `tilt`:
    the box's opening is tilted up by this against the incoming ball, rad; `turn`: preferred angle of the last
    joint, rad; `ready`: joints while waiting, rad; `eager`: when the arm begins to move, s after the release;
    `hurry`: share of the way that the first guess goes; `share`: how often this habit is seen."""

    reach: float
    height: float
    tilt: float
    turn: float
    ready: tuple[float, ...]
    eager: float
    hurry: float
    share: float


HABITS = (
    Habit(0.54, 1.00, 0.00, 0.0, (-0.30, -1.40, 2.30, -1.90, 1.30, 0.0), -0.08, 0.75, 0.5),
    Habit(0.48, 0.92, 0.25, 0.5, (-0.20, -1.60, 2.40, -2.00, 1.40, 0.4), -0.02, 0.60, 0.3),
    Habit(0.60, 1.08, -0.10, 0.0, (-0.40, -1.20, 2.20, -1.90, 1.20, 0.1), -0.14, 0.85, 0.2),
)
SPEED = 0.97 * np.pi
"""rad/s; a guided UR5 stops itself at pi rad/s, so such a recording does not exist."""
LOWEST = 0.55
"""m, centre of the box: below, it would hit the table."""


def interception(flight: Flight, habit: np.ndarray, slack: Array) -> tuple[Array, Array, Array]:
    """When [N] (s after release), where [N, 3] and how fast [N, 3] the ball arrives where this teacher
    catches it best.

    The teacher's favourite places form a bow of `reach` around the robot at the favourite height; of all
    points on the ball's way the one nearest to it is taken, a height being worth less than a reach. `slack`
    [N] m shifts the bow.
    """
    reach = np.array([HABITS[h].reach for h in habit]) + slack
    height = np.array([HABITS[h].height for h in habit])
    x, y, z = np.moveaxis(flight.position, -1, 0)
    bow = np.hypot((x - DISTANCE) / reach[:, None], y / 1.15) - 1.0
    cost = (bow / 0.10) ** 2 + ((z - height[:, None]) / 0.22) ** 2
    best = np.clip(cost.argmin(axis=1), 1, cost.shape[1] - 2)
    rows = np.arange(len(best))
    # Parabola through the three costs around the smallest: the instant between grid points.
    a, b, c = cost[rows, best - 1], cost[rows, best], cost[rows, best + 1]
    seconds = STEP * (best + np.clip(0.5 * (a - c) / np.maximum(a - 2 * b + c, 1e-12), -0.5, 0.5))
    return seconds, flight.at(seconds[:, None])[:, 0], flight.velocity_at(seconds[:, None])[:, 0]


def arm() -> RobotArm:
    """The UR5 with the box, float64; `geometry.base_transform()` times its output is the box in the world."""
    return RobotArm.ur5(geometry.tool_transform()).double()


def solve(robot: RobotArm, box: Array, opening: Array, posture: Array, turn: Array) -> tuple[Array, Array]:
    """Joints [N, 6] that put the box's centre at `box` [N, 3] and its opening along `opening` [N, 3] (unit),
    and how far off the centre stays, [N] m.

    Levenberg-Marquardt on three residuals, each over what a hand-guided arm tolerates: position 2 mm, opening
    0.15 rad (a box that catches need not face the ball exactly), and posture 2 rad around the waiting one,
    which keeps the solution in its branch. `turn` [N] is where the last joint, free otherwise, is liked, to
    0.2 rad.
    """
    base = geometry.base_transform()
    at, along = torch.from_numpy(box), torch.from_numpy(opening)
    liked = torch.from_numpy(np.concatenate([posture[:, :5], turn[:, None]], axis=-1))
    tolerance = torch.tensor([2.0, 2.0, 2.0, 2.0, 2.0, 0.2], dtype=torch.float64)
    q = torch.from_numpy(posture.copy())

    def task(q: Tensor, copies: int = 1) -> Tensor:
        pose = base @ robot(q)
        position = (pose[:, :3, 3] - at.repeat(copies, 1)) / 0.002
        axis = (pose[:, :3, 2] - along.repeat(copies, 1)) / 0.15
        return torch.cat([position, axis], dim=-1)

    def habit(q: Tensor) -> Tensor:
        return (q - liked) / tolerance

    damping = torch.full((len(q), 1, 1), 1e3, dtype=torch.float64)
    identity = torch.eye(6, dtype=torch.float64)
    slope = torch.diag(1.0 / tolerance).expand(len(q), 6, 6)
    for _ in range(30):
        # One copy of the joints for each of the task's residuals: a single backward pass gives all rows.
        leaf = q.repeat(6, 1).requires_grad_()
        copies = task(leaf, 6).view(6, len(q), 6)
        (rows,) = torch.autograd.grad(copies.diagonal(dim1=0, dim2=2).sum(), leaf)
        J = torch.cat([rows.view(6, len(q), 6).transpose(0, 1), slope], dim=1)
        r = torch.cat([copies[0].detach(), habit(q)], dim=-1)
        normal = J.transpose(1, 2) @ J + damping * identity
        step = torch.linalg.solve(normal, J.transpose(1, 2) @ r[..., None])[..., 0].clamp(-0.4, 0.4)
        with torch.no_grad():
            tried = torch.cat([task(q - step), habit(q - step)], dim=-1)
        better = tried.square().sum(-1) < r.square().sum(-1)
        q = torch.where(better[:, None], q - step, q)
        damping = torch.where(better[:, None, None], damping * 0.3, damping * 5.0).clamp(1e-6, 1e9)
    with torch.no_grad():
        miss = (base @ robot(q))[:, :3, 3] - at
    return q.numpy(), miss.norm(dim=-1).numpy()


@dataclass(frozen=True)
class Lesson:
    """What the teacher does in N tosses. `habit` [N]; `seconds` from release to catch; `point`, `velocity` of
    the ball there [N, 3]; `possible` [N]: whether the arm gets there within its reach and speed."""

    habit: np.ndarray
    seconds: Array
    point: Array
    velocity: Array
    possible: np.ndarray
    coordinates: tuple[tuple[Array, Array, Array, Array], ...]
    wobble: Wobble

    def joints(self, t: Array) -> Motion:
        """Joint angles [N, T, 6], rad, at times [N, T] after the release: a guess, then a correction."""
        first, second = (through(t, *part) for part in self.coordinates)
        return first + second + self.wobble.at(t)


def teach(rng: np.random.Generator, robot: RobotArm, flight: Flight) -> Lesson:
    """Guides the arm in N tosses. Two overlapping minimum-jerk movements, as in hand-guided reaching to a
    target that becomes clearer (Flash and Henis, J. Cogn. Neurosci. 3, 1991): one from what the thrower's
    movement betrays, which is wrong by decimetres, and one a visual reaction time after the ball is in the
    air."""
    n = len(flight.position)
    habit = rng.choice(len(HABITS), size=n, p=[h.share for h in HABITS])

    def liking(name: str) -> Array:
        return np.array([getattr(HABITS[h], name) for h in habit], dtype=np.float64)

    seconds, point, velocity = interception(flight, habit, rng.normal(0.0, 0.03, n))
    opening = -velocity / np.linalg.norm(velocity, axis=-1, keepdims=True)
    tilt = liking("tilt") + rng.normal(0.0, 0.08, n)
    # Tilted up in the vertical plane of the ball's way.
    heading = np.arctan2(opening[:, 1], opening[:, 0])
    rise = np.minimum(np.arcsin(opening[:, 2]) + tilt, 1.45)
    opening = np.stack([np.cos(rise) * np.cos(heading), np.cos(rise) * np.sin(heading), np.sin(rise)], axis=-1)
    ready = liking("ready") + rng.normal(0.0, 0.04, (n, 6))
    turn = liking("turn") + rng.normal(0.0, 0.08, n)
    box = point + rng.normal(0.0, 0.022, (n, 3))
    centre = np.array([DISTANCE - 0.5, 0.0, 1.0])
    guess = centre + 0.8 * (point - centre) + rng.normal(0.0, 1.0, (n, 3)) * np.array([0.06, 0.20, 0.10])
    both, misses = solve(
        robot,
        *(np.concatenate(pair) for pair in ((box, guess), (opening, opening), (ready, ready), (turn, turn))),
    )
    final, miss, guessed = both[:n], misses[:n], both[n:]
    halfway = ready + liking("hurry")[:, None] * (guessed - ready)

    begin = liking("eager") + rng.normal(0.0, 0.05, n)
    notice = np.maximum(rng.normal(0.24, 0.03, n), 0.15)
    arrive = seconds - rng.uniform(0.0, 0.08, n)
    # The first movement lasts into the second, which corrects it.
    first_end = np.minimum(begin + rng.normal(0.62, 0.05, n), arrive)
    zero = np.zeros_like(ready)
    rest = (np.stack([zero, zero], 1), np.stack([zero, zero], 1))
    coordinates = (
        (np.stack([begin, first_end], 1), np.stack([ready, halfway], 1), *rest),
        (np.stack([notice, arrive], 1), np.stack([zero, final - halfway], 1), *rest),
    )
    wobble = Wobble(rng, n, np.full(6, 0.004), np.full(6, 2.0))
    lesson = Lesson(habit, seconds, point, velocity, np.zeros(n, bool), coordinates, wobble)
    fine = np.linspace(-0.6, 1.0, 240) * np.ones((n, 1))
    fine = np.minimum(fine * seconds[:, None], seconds[:, None])
    fastest = np.abs(lesson.joints(fine).qd).max(axis=(1, 2))
    limits = robot.joint_limits.numpy()
    within = ((final > limits[:, 0]) & (final < limits[:, 1])).all(-1)
    possible = (miss < 0.03) & (fastest < SPEED) & within & (box[:, 2] > LOWEST) & (arrive - notice > 0.25)
    return Lesson(habit, seconds, point, velocity, possible, coordinates, wobble)
