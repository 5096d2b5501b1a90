"""Ballistics against closed forms and against itself."""

import numpy as np

from experiments.ball_catching import flight
from experiments.ball_catching.dataset import Session
from experiments.ball_catching.flight import DRAG, STEP
from experiments.ball_catching.geometry import GRAVITY
from experiments.ball_catching.sensors import LAYOUT

BALL = LAYOUT.slice("ball")


def test_terminal_speed() -> None:
    # Where drag balances gravity the ball no longer accelerates: k v^2 = g.
    falling = np.array([[0.0, 0.0, -np.sqrt(GRAVITY / DRAG)]])
    np.testing.assert_allclose(flight.acceleration(falling), 0.0, atol=1e-12)


def test_vertical_fall_has_a_closed_form() -> None:
    # From rest: v(t) = -v_T tanh(g t / v_T), z(t) = -(v_T^2 / g) log cosh(g t / v_T).
    fall = flight.fly(np.zeros((1, 3)), np.zeros((1, 3)), 1.0)
    terminal, t = np.sqrt(GRAVITY / DRAG), np.arange(fall.position.shape[1]) * STEP
    z = -(terminal**2) / GRAVITY * np.log(np.cosh(GRAVITY * t / terminal))
    np.testing.assert_allclose(fall.position[0, :, 2], z, atol=1e-9)
    between = np.linspace(0.0, 0.9, 77)
    z = -(terminal**2) / GRAVITY * np.log(np.cosh(GRAVITY * between / terminal))
    np.testing.assert_allclose(fall.at(between[None])[0, :, 2], z, atol=1e-8)


def test_release_velocity_reaches_the_target() -> None:
    rng = np.random.default_rng(0)
    start = rng.normal([0.5, -0.2, 1.2], 0.2, (30, 3))
    target = rng.normal([3.2, 0.0, 1.0], 0.3, (30, 3))
    seconds = flight.flight_time(start, target, rng.uniform(0.6, 1.1, 30))
    velocity = flight.release_velocity(start, target, seconds)
    arrival = flight.fly(start, velocity, 2.0).at(seconds[:, None])[:, 0]
    np.testing.assert_allclose(arrival, target, atol=1e-8)
    # Against the drag the ball has to leave faster than in a vacuum.
    vacuum = (target - start + 0.5 * GRAVITY * seconds[:, None] ** 2 * [0, 0, 1]) / seconds[:, None]
    assert (np.linalg.norm(velocity, axis=1) > np.linalg.norm(vacuum, axis=1)).all()


def test_the_ball_in_the_air_feels_gravity_and_drag_only(session: Session) -> None:
    ball = session.truth[..., BALL]
    h = 1.0 / 60.0
    for i, length in enumerate(session.lengths):
        first = int((session.t[i] < session.throw.release[i]).sum())
        p = ball[i, first:length]
        velocity = (p[2:] - p[:-2]) / (2 * h)
        measured = (p[2:] - 2 * p[1:-1] + p[:-2]) / h**2
        np.testing.assert_allclose(measured, flight.acceleration(velocity), atol=2e-3)
