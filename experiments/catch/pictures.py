"""A strip of three throws, as in the paper's figure of sequences, and an animation; plotted where there is no GL."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure

from experiments.ball_catching.geometry import BOX_DEPTH, BOX_WIDTH, DISTANCE, GRAVITY, TABLE_HEIGHT, Array
from experiments.ball_catching.scene import Reach, World
from experiments.ball_catching.scene.camera import Camera, NoGraphicsError, Person, Picture
from experiments.catch.controllers import SessionController
from experiments.catch.jobs import Bench, Plan, Results, bench
from experiments.catch.throws import Toss
from experiments.catch.trial import run
from torch_ebip.common.files import atomic_write

STRIDE = 3
"""Control cycles from one frame of the animation to the next."""
FRAME_MS = 80
"""ms that a frame is shown: five eighths of the real speed."""


class Frame(NamedTuple):
    """One moment: `since` s after the release; joints of the scene; the box, and where it is expected to end."""

    since: float
    positions: Array
    person: Person
    box: tuple[Array, Array]
    expected: tuple[Array, Array] | None
    ball: Array


class Film(NamedTuple):
    """One throw, frame by frame, 60 a second."""

    toss: Toss
    frames: list[Frame]
    caught: bool


def film(bench: Bench, method: str, toss: Toss) -> Film:
    """Throw again, and look."""
    controller = bench.controller(method, toss)
    reach, frames = Reach(), list[Frame]()

    def watch(world: World) -> None:
        expected = None
        if isinstance(controller, SessionController) and world.touched is None:
            expected = reach.box(controller.session.forecast().mean.double().numpy())
        k = min(len(frames), len(toss.times) - 1)
        left_hand, head, right_foot, left_foot, pelvis = toss.figure[k]
        person = Person(toss.hand[k], left_hand, head, left_foot, right_foot, pelvis)
        since = world.time - toss.release
        frames.append(Frame(since, world.data.qpos.copy(), person, world.box, expected, world.ball))

    outcome = run(bench.world, toss, controller, bench.ready, bench.plan.drop, watch)
    return Film(toss, frames, outcome.caught)


def choose(bench: Bench, method: str, results: Results) -> list[Toss]:
    """Three aimed throws that were caught: with the lowest, a middling and the highest apex."""
    tosses = bench.tosses("aimed")
    caught = [tosses[row["number"]] for row in results[method, "aimed"] if row["caught"]] or tosses[:1]
    caught.sort(key=lambda toss: toss.position[2] + max(toss.velocity[2], 0.0) ** 2 / (2 * GRAVITY))
    return [caught[0], caught[len(caught) // 2], caught[-1]]


def draw_pictures(plan: Plan, method: str, results: Results, folder: Path) -> None:
    """Write ``throws.png`` and ``throws.gif`` of a method that was thrown at."""
    mine = bench(plan)
    films = [film(mine, method, toss) for toss in choose(mine, method, results)]
    try:
        with Camera(mine.world.model) as camera:
            rendered = [
                [camera.picture(frame.positions, frame.person, frame.expected) for frame in one.frames[::STRIDE]]
                for one in films
            ]
    except NoGraphicsError as error:
        print(f"{error}; plotted instead", file=sys.stderr)
        rendered = [[plotted(one, frame) for frame in one.frames[::STRIDE]] for one in films]
    with atomic_write(folder / "throws.png") as file:
        strip(films, rendered, method).savefig(file, format="png", dpi=110)
    animation(folder / "throws.gif", rendered)


def strip(films: list[Film], pictures: list[list[Picture]], method: str) -> Figure:
    """A row a throw: the wind-up, the release, the flight, the catch, and a second later."""
    figure = Figure(figsize=(15, 6.6), layout="constrained")
    axes = figure.subplots(len(films), 5, squeeze=False)
    for row, (one, shown) in enumerate(zip(films, pictures, strict=True)):
        moments = np.array([frame.since for frame in one.frames[::STRIDE]])
        distances = [np.linalg.norm(frame.ball - frame.box[0]) for frame in one.frames[::STRIDE]]
        contact = moments[int(np.argmax(np.array(distances) < 0.2))] if min(distances) < 0.2 else moments[-1]
        for column, moment in enumerate((-0.4, 0.0, 0.5 * contact, contact, contact + 0.8)):
            k = int(np.abs(moments - moment).argmin())
            axis = axes[row, column]
            axis.imshow(shown[k])
            axis.set_axis_off()
            which = f"{one.toss.style}, {'caught' if one.caught else 'missed'}: " if column == 0 else ""
            axis.set_title(f"{which}{moments[k]:+.2f} s", fontsize=10)
    figure.suptitle(
        f"{method}: three throws; seconds since the release; green: where the filter expects to catch", fontsize=12
    )
    return figure


def animation(path: Path, pictures: list[list[Picture]]) -> None:
    """All throws one after the other as a GIF."""
    from PIL import Image

    palette = Image.fromarray(np.concatenate([shown[len(shown) // 2] for shown in pictures])).quantize(64)
    frames = [
        Image.fromarray(picture)
        .resize((picture.shape[1] * 2 // 3, picture.shape[0] * 2 // 3))
        .quantize(palette=palette, dither=Image.Dither.NONE)
        for shown in pictures
        for picture in shown
    ]
    with atomic_write(path) as file:
        frames[0].save(
            file, format="GIF", save_all=True, append_images=frames[1:], duration=FRAME_MS, loop=0, optimize=True
        )


def plotted(one: Film, frame: Frame) -> Picture:
    """The same picture from the side and from above, without a renderer, uint8 [height, width, 3]."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    figure = Figure(figsize=(4.8, 2.4), dpi=100, layout="constrained")
    canvas = FigureCanvasAgg(figure)
    path = np.array([other.ball for other in one.frames if 0 <= other.since <= frame.since])
    for axis, (i, j), names in zip(figure.subplots(1, 2), ((0, 2), (0, 1)), ("xz", "xy"), strict=True):
        axis.plot(*np.array(frame.person)[[1, 2, 5, 2, 0]][:, [i, j]].T, "-", color="C0", lw=3)
        axis.plot(*np.array(frame.person)[[3, 5, 4]][:, [i, j]].T, "-", color="C0", lw=3)
        if len(path):
            axis.plot(path[:, i], path[:, j], ":", color="C3", lw=1)
        axis.plot(frame.ball[i], frame.ball[j], "o", color="C3", ms=5)
        for pose, style in ((frame.box, "-"), (frame.expected, "--")):
            if pose is not None:
                axis.plot(*_outline(pose)[:, [i, j]].T, style, color="C2", lw=1.2)
        axis.plot(DISTANCE, TABLE_HEIGHT if j == 2 else 0.0, "ks", ms=6)
        axis.set(xlabel=f"{names[0]} [m]", ylabel=f"{names[1]} [m]", aspect="equal", xlim=(-0.6, 4.3))
        axis.set_ylim(*((0.0, 3.5) if j == 2 else (-1.6, 1.6)))
    canvas.draw()
    picture: Picture = np.asarray(canvas.buffer_rgba())[..., :3].copy()
    return picture


def _outline(pose: tuple[Array, Array]) -> Array:
    """A line [10, 3] along the edges of the box: its rim, and its bottom."""
    w, d = BOX_WIDTH / 2, BOX_DEPTH / 2
    square = np.array([(-w, -w), (w, -w), (w, w), (-w, w), (-w, -w)])
    corners = np.concatenate([np.c_[square, np.full(5, z)] for z in (d, -d)])
    line: Array = pose[0] + corners @ pose[1].T
    return line
