"""The data set: tosses that were caught, as recordings, made from a seed and kept in the user's cache."""

from __future__ import annotations

import hashlib
import os
import warnings
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

import numpy as np
import torch
from platformdirs import user_cache_dir

from experiments.ball_catching import flight as ballistics
from experiments.ball_catching import sensors, teacher, thrower
from experiments.ball_catching.flight import Flight
from experiments.ball_catching.geometry import RATE, Array
from experiments.ball_catching.sensors import LAYOUT
from experiments.ball_catching.teacher import Lesson
from experiments.ball_catching.thrower import STYLES, Throw
from torch_ebip import Demonstrations, RobotArm

BATCH = 64
"""Tosses simulated at once. Part of what a seed means."""


@dataclass(frozen=True)
class Session:
    """N tosses as they happened: the account that all sensors derive from, before noise.

    `t`: sample times [N, T] since the toss began, s; recording i has the first `lengths[i]` of them, the last
    of which is the instant of the catch. `truth`: exact readings [N, T, D] on `LAYOUT`, the ball's position
    also while it is in the hand.
    """

    throw: Throw
    flight: Flight
    lesson: Lesson
    t: Array
    lengths: np.ndarray
    truth: Array


def simulate(rng: np.random.Generator, robot: RobotArm, n: int = BATCH) -> Session:
    """N tosses, caught or not (`lesson.possible` says which)."""
    throw = thrower.plan(rng, n)
    hand = throw.body(throw.release[:, None]).right_hand
    flight = ballistics.fly(hand.p[:, 0], hand.v[:, 0], 2.0)
    lesson = teacher.teach(rng, robot, flight)
    end = throw.release + lesson.seconds
    lengths = np.floor(end * RATE).astype(np.int64) + 1
    k = np.arange(lengths.max())
    t = end[:, None] + (k - lengths[:, None] + 1) / RATE
    since = t - throw.release[:, None]
    in_hand = (since < 0)[..., None]
    ball = np.where(in_hand, throw.body(t).right_hand.p, flight.at(since))
    truth = sensors.exact(rng, throw, t, ball, lesson.joints(since).q)
    return Session(throw, flight, lesson, t, lengths, truth)


def generate(n: int = 221, seed: int = 0) -> Demonstrations:
    """N demonstrations of a ball tossed to the robot and caught: float32, 60 Hz, 48 DoFs, fixed by the seed.

    Like a real collection it holds the tosses that were caught; those out of the arm's reach or speed are
    left out. A longer data set of one seed begins with the shorter one.

    Columns: `release` s and `release_phase`; `person`, `style` and `teacher`; `interception` [N, 3] m, where
    the ball truly is at the end.

    Raises:
        ValueError: n is not positive.
    """
    if n < 1:
        raise ValueError(f"n: expected at least one demonstration, got {n}")
    robot = teacher.arm()
    trajectories: list[torch.Tensor] = []
    columns: dict[str, list[object]] = {
        name: [] for name in ("release", "release_phase", "person", "style", "teacher", "interception")
    }
    batch = 0
    while len(trajectories) < n:
        rng = np.random.default_rng([seed, batch])
        session = simulate(rng, robot)
        # The hand lets go of the ball gradually: the camera sees it 1 to 4 samples after the release.
        seen = session.throw.release + rng.uniform(0.01, 0.06, BATCH)
        for i in range(BATCH):
            length = int(session.lengths[i])
            t = session.t[i, :length]
            values = sensors.measure(rng, session.truth[i, :length], int((t < seen[i]).sum()))
            if not session.lesson.possible[i] or len(trajectories) == n:
                continue
            release = session.throw.release[i] - t[0]
            trajectories.append(torch.from_numpy(values.astype(np.float32)))
            columns["release"].append(release)
            columns["release_phase"].append(release / (t[-1] - t[0]))
            columns["person"].append(int(session.throw.person[i]))
            columns["style"].append(STYLES[session.throw.style[i]].name)
            columns["teacher"].append(int(session.lesson.habit[i]))
            columns["interception"].append(session.lesson.point[i])
        batch += 1
    return Demonstrations(LAYOUT, trajectories, RATE, {name: np.array(column) for name, column in columns.items()})


def load_or_generate(n: int = 221, seed: int = 0, cache_dir: str | os.PathLike[str] | None = None) -> Demonstrations:
    """`generate(n, seed)`, kept in a file.

    Args:
        cache_dir: folder of the file; the user's cache folder if left out. The file's name holds a digest of
            the simulation's source, so that data of another version of it are never taken for these.
    """
    folder = Path(cache_dir) if cache_dir is not None else Path(user_cache_dir("torch_ebip"))
    path = folder / f"ball_catching-{_digest()}-n{n}-seed{seed}.npz"
    if path.exists():
        try:
            return Demonstrations.load(path)
        except ValueError as error:
            warnings.warn(f"{path} cannot be read and is made anew ({error})", stacklevel=2)
    demonstrations = generate(n, seed)
    try:
        demonstrations.save(path)
    except OSError as error:
        warnings.warn(f"the demonstrations could not be kept in {path} ({error})", stacklevel=2)
    return demonstrations


def _digest() -> str:
    """Twelve hexadecimal digits of the source of everything the data depend on."""
    here = Path(__file__).parent
    names = ("geometry", "flight", "motion", "body", "thrower", "soles", "sensors", "teacher", "dataset")
    digest = hashlib.sha256()
    for name in names:
        digest.update((here / f"{name}.py").read_bytes())
    for name in ("arm.py", "urdf.py", "ur5.urdf"):
        digest.update(resources.files("torch_ebip.kinematics").joinpath(name).read_bytes())
    return digest.hexdigest()[:12]
