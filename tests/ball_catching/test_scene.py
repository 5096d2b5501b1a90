"""The simulator's arm is our arm, its servo keeps the limits, its ball flies as balls do, and the box holds it."""

import sys
from typing import Any

import numpy as np
import pytest
import torch

from experiments.ball_catching import flight, teacher, thrower
from experiments.ball_catching.dataset import Session
from experiments.ball_catching.geometry import BOX_WIDTH, DISTANCE, TABLE_HEIGHT, Array, base_transform
from experiments.ball_catching.scene import Limits, Reach, World, camera, travel_time
from experiments.ball_catching.scene.camera import Camera, NoGraphicsError, Person
from experiments.ball_catching.scene.model import LINKS, STEP, load_mujoco

pytest.importorskip("mujoco")
READY = np.array(teacher.HABITS[0].ready)


@pytest.fixture(scope="module")
def world() -> World:
    return World()


def pose(joints: Array) -> Array:
    return (base_transform() @ teacher.arm()(torch.from_numpy(joints))).numpy()


def test_the_arm_is_the_arm_of_the_library(world: World) -> None:
    for joints in np.random.default_rng(0).uniform(-3, 3, (50, 6)):
        world.reset(joints)
        centre, axes = world.box
        wanted = pose(joints)
        np.testing.assert_allclose(centre, wanted[:3, 3], atol=1e-9)
        np.testing.assert_allclose(axes, wanted[:3, :3], atol=1e-9)


def test_links_weigh_what_the_manufacturer_publishes_where_he_says(world: World) -> None:
    """Centres of mass by the Denavit-Hartenberg table, in whose frames they are published."""
    a, d = (0, -0.425, -0.39225, 0, 0, 0), (0.089159, 0, 0, 0.10915, 0.09465, 0.0823)
    alpha = (np.pi / 2, 0, 0, np.pi / 2, -np.pi / 2, 0)
    published = (
        (3.7, (0, -0.02561, 0.00193)),
        (8.393, (0.2125, 0, 0.11336)),
        (2.33, (0.15, 0, 0.0265)),
        (1.219, (0, -0.0018, 0.01634)),
        (1.219, (0, 0.0018, 0.01634)),
        (0.1879, (0, 0, -0.001159)),
    )
    q = np.array([0.3, -1.1, 0.7, 0.2, -0.5, 0.9])
    world.reset(q)
    T = np.eye(4)
    T[:3, 3] = DISTANCE, 0.0, TABLE_HEIGHT
    for i, (name, (mass, centre)) in enumerate(zip(LINKS, published, strict=True)):
        c, s, ca, sa = np.cos(q[i]), np.sin(q[i]), np.cos(alpha[i]), np.sin(alpha[i])
        T = T @ np.array(
            [[c, -s * ca, s * sa, a[i] * c], [s, c * ca, -c * sa, a[i] * s], [0, sa, ca, d[i]], [0, 0, 0, 1]]
        )
        body = world.model.body(f"ur5/{name}").id
        assert world.model.body_mass[body] == mass
        np.testing.assert_allclose(world.data.xipos[body], (T @ [*centre, 1.0])[:3], atol=1e-9)


def drive(world: World, start: Array, goals: list[tuple[float, Array]], seconds: float) -> Array:
    """Joints [K, 6] at every millisecond; goals as (time, joints)."""
    world.reset(start)
    waiting, path = list(goals), []
    for _ in range(round(seconds / STEP)):
        while waiting and waiting[0][0] <= world.time + 1e-9:
            world.servo.command(*waiting.pop(0))
        world.step()
        path.append(world.joints)
    return np.array(path)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_the_servo_keeps_its_limits_and_arrives_in_time(share: float) -> None:
    limits = Limits().slowed(share)
    world = World(limits)
    goal = READY + np.array([1.2, 0.6, -0.5, 0.4, 0.2, -0.1])
    path = drive(world, READY, [(0.1, goal)], 2.0)
    speed = np.diff(path, axis=0) / STEP
    assert np.abs(speed).max() < 1.01 * limits.speed
    assert np.abs(np.diff(speed, axis=0) / STEP).max() < 1.05 * limits.acceleration
    assert np.abs(path[: round((0.1 + limits.delay) / STEP) - 1] - READY).max() < 1e-4  # gravity is compensated
    np.testing.assert_allclose(path[-1], goal, atol=1e-4)
    overshoot = (np.sign(goal - READY) * (path - goal)).max()
    assert overshoot < 2e-3
    arrived = [0.1 + travel_time(goal - READY, np.zeros(6), limits)[j] for j in range(6)]
    measured = [STEP * (1 + np.nonzero(np.abs(path[:, j] - goal[j]) > 2e-3)[0][-1]) for j in range(6)]
    np.testing.assert_allclose(measured, arrived, atol=0.025)


def test_a_goal_that_changes_on_the_way_is_no_trouble(world: World) -> None:
    rng = np.random.default_rng(1)
    goals = [(0.016 * k, READY + rng.normal(0, 0.4, 6)) for k in range(60)] + [(1.0, READY)]
    path = drive(world, READY, goals, 2.0)
    speed = np.diff(path, axis=0) / STEP
    assert np.abs(speed).max() < 1.01 * np.pi
    np.testing.assert_allclose(path[-1], READY, atol=1e-4)


def test_travel_time_by_brute_force() -> None:
    """Against a fine simulation of a double integrator that brakes as late as it can."""
    limits = Limits(2.0, 10.0, 0.0)
    for distance, speed in ((1.0, 0.0), (0.05, 0.0), (-0.3, 1.0), (0.02, 1.5), (0.5, -2.0), (3.0, 2.0)):
        x, v, t, h = 0.0, speed, 0.0, 1e-4
        while abs(distance - x) > 2e-4 or abs(v) > 0.05:
            ahead = distance - x
            wanted = np.sign(ahead) * min(np.sqrt(2 * limits.acceleration * abs(ahead)), limits.speed)
            v += np.clip(wanted - v, -limits.acceleration * h, limits.acceleration * h)
            x, t = x + h * v, t + h
        predicted = travel_time(np.array(distance), np.array(speed), limits)
        assert float(predicted) == pytest.approx(t, abs=0.02)


def test_no_joint_gets_more_torque_than_its_motor_has() -> None:
    """With set points that ask for far too much."""
    world = World(Limits(acceleration=3000.0))
    world.reset(READY)
    world.servo.command(0.0, READY + 1.0)
    largest = np.zeros(6)
    for _ in range(200):
        world.step()
        largest = np.maximum(largest, np.abs(world.data.qfrc_actuator[:6]))
    efforts = np.array([150.0, 150.0, 150.0, 28.0, 28.0, 28.0])
    assert (largest <= efforts + 1e-9).all()
    np.testing.assert_allclose(largest[:3], efforts[:3])


def test_the_ball_flies_as_in_the_demonstrations(world: World, session: Session) -> None:
    """Runge-Kutta with drag against the simulator, until something is touched."""
    for i in (0, 5, 9):
        world.reset(np.zeros(6))  # stretched out away from the thrower's side
        world.release(session.flight.position[i, 0], session.flight.velocity[i, 0])
        for k in range(1, 200):
            while world.time < k / 240 - 1e-9:
                world.step()
            if world.touched is not None:
                break
            exact = flight.Flight(session.flight.position[i : i + 1], session.flight.velocity[i : i + 1])
            np.testing.assert_allclose(world.ball, exact.at(np.array([[world.time]]))[0, 0], atol=1.5e-3)
        assert k > 100


def fall(world: World, above: Array, height: float) -> float:
    """Share of its speed that a ball keeps when it falls on what is below."""
    world.release(above + np.array([0.0, 0.0, height]), np.zeros(3))
    down = up = 0.0
    for _ in range(1500):
        world.step()
        speed = float(world.data.qvel[8])
        down, up = min(down, speed), max(up, speed)
        if world.touched is not None and world.time > world.touched + 0.15:
            break
    return -up / down


def upright(reach: Reach) -> Array:
    return reach.solve(np.array([DISTANCE - 0.5, 0.1, 0.9]), np.array([0.0, 0.0, 1.0]), READY, READY, 60).joints


def test_the_box_is_lined_and_the_floor_is_not(world: World) -> None:
    world.reset(upright(Reach()))
    centre, axes = world.box
    assert axes[2, 2] > 0.95
    assert 0.05 < fall(world, centre, 0.8) < 0.25
    assert world.touched_box == world.touched is not None
    for _ in range(1000):
        world.step()
    assert world.holds_ball()
    world.reset(upright(Reach()))
    assert 0.25 < fall(world, np.array([1.5, 0.0, 0.0]), 1.0) < 0.55
    assert world.touched_box is None
    assert not world.holds_ball()


def test_what_the_teacher_caught_is_caught(world: World, session: Session) -> None:
    """The recorded posture at the catch, held still: the ball stays in the box for a second."""
    final = session.lesson.joints(session.lesson.seconds[:, None])[0][:, 0]
    possible = np.nonzero(session.lesson.possible)[0][:12]
    caught = 0
    for i in possible:
        world.reset(final[i])
        world.release(session.flight.position[i, 0], session.flight.velocity[i, 0])
        while world.time < 3.0 and (world.touched_box is None or world.time < world.touched_box + 1.0):
            world.step()
        caught += world.touched_box is not None and world.holds_ball()
        assert world.touched_box == pytest.approx(session.lesson.seconds[i], abs=0.06)
    assert caught >= 11


def test_a_ball_that_passes_or_hits_the_rim_is_not_caught(world: World, session: Session) -> None:
    i = int(np.nonzero(session.lesson.possible)[0][0])
    final = session.lesson.joints(session.lesson.seconds[:, None])[0][i, 0]
    across = pose(final)[:3, 0]
    for offset in (BOX_WIDTH / 2 + 0.02, 1.0):
        world.reset(final)
        world.release(session.flight.position[i, 0] + offset * across, session.flight.velocity[i, 0])
        while world.time < 2.5:
            world.step()
        assert (world.touched_box is None) == (offset == 1.0)
        assert not world.holds_ball()


def test_inverse_kinematics_solve_what_they_say(session: Session) -> None:
    reach = Reach()
    for i in range(20):
        velocity = session.lesson.velocity[i]
        opening = -velocity / np.linalg.norm(velocity)
        posture = reach.solve(session.lesson.point[i], opening, READY, READY)
        wanted = pose(posture.joints)
        assert np.linalg.norm(wanted[:3, 3] - session.lesson.point[i]) == pytest.approx(posture.miss, abs=1e-6)
        assert np.linalg.norm(wanted[:3, 2] - opening) == pytest.approx(posture.turn, abs=1e-6)
        if session.lesson.possible[i]:
            assert posture.miss < 0.002
    assert reach.solve(np.array([1.0, 0.0, 1.0]), np.array([-1.0, 0.0, 0.0]), READY, READY).miss > 1.0


def test_a_blindfolded_thrower_does_not_see_and_throws_wider() -> None:
    sighted, blind = (thrower.plan(np.random.default_rng(3), 200, blindfolded) for blindfolded in (False, True))
    assert sighted.sighted
    assert not blind.sighted

    def at_robot(throw: thrower.Throw) -> Array:
        hand = throw.body(throw.release[:, None]).right_hand
        path = flight.fly(hand.p[:, 0], hand.v[:, 0], 2.0).position
        return path[np.arange(200), (path[..., 0] > DISTANCE - 0.5).argmax(1)][:, 1:]

    assert (at_robot(blind).std(0) > 1.15 * at_robot(sighted).std(0)).all()


def test_without_the_simulator_there_is_an_instruction(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(SystemExit, match=r"pip install 'torch-ebip\[simulator\]'"):
        load_mujoco()


def test_a_picture_shows_the_ball_and_the_thrower(world: World) -> None:
    points = np.array([[0.3, -0.3, 1.2], [0.2, 0.3, 1.0], [0, 0, 1.6], [0.1, 0.1, 0.1], [0, -0.1, 0.1], [0, 0, 0.9]])
    world.reset(READY)
    try:
        with Camera(world.model, 120, 80) as eye:
            pictures = []
            for ball, shift in ((0.0, 0.0), (1.5, 0.0), (0.0, 0.4)):
                positions = world.data.qpos.copy()
                positions[6:9] = 0.6 + ball, 0.0, 1.4
                pictures.append(eye.picture(positions, Person(*(points + np.array([0.0, shift, 0.0]))), None))
            expected = eye.picture(positions, Person(*points), (np.array([1.5, 0.0, 1.2]), np.eye(3)))
    except NoGraphicsError as error:
        pytest.skip(str(error))
    assert pictures[0].shape == (80, 120, 3)
    assert pictures[0].std() > 20  # not a blank
    for other in (pictures[1], pictures[2], expected):
        assert (np.abs(pictures[0].astype(int) - other).max(-1) > 30).sum() > 3


def test_without_graphics_there_is_an_instruction(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def none(mujoco: Any) -> Any:
        raise ImportError("libEGL.so.1: cannot open")

    monkeypatch.setattr(camera, "_context", none)
    with pytest.raises(NoGraphicsError, match=r"libEGL.*apt install libegl1"):
        Camera(world.model)
