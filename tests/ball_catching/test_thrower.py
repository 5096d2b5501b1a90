"""The moving body: derivatives that match, a ball that leaves with the hand, sensors at rest."""

import numpy as np
import pytest

from experiments.ball_catching import body, sensors, soles
from experiments.ball_catching.dataset import Session
from experiments.ball_catching.geometry import GRAVITY
from experiments.ball_catching.motion import Motion, Wobble, through
from experiments.ball_catching.thrower import LOWER, UPPER, jacobian


def test_quintic_passes_its_via_points_and_its_derivatives_match() -> None:
    rng = np.random.default_rng(0)
    knots = np.cumsum(rng.uniform(0.2, 0.5, (3, 4)), axis=1)
    q, qd, qdd = rng.normal(size=(3, 3, 4, 2))
    qd[:, [0, -1]] = qdd[:, [0, -1]] = 0.0
    for state, wanted in zip(through(knots, knots, q, qd, qdd), (q, qd, qdd), strict=True):
        np.testing.assert_allclose(state, wanted, atol=1e-9)
    assert_derivatives_match(lambda t: through(t, knots, q, qd, qdd), 1e-3)


def test_wobble_has_its_scale_and_its_derivatives_match() -> None:
    wobble = Wobble(np.random.default_rng(0), 4000, np.array([0.02, 0.5]), np.array([3.0, 1.0]))
    np.testing.assert_allclose(wobble.at(np.zeros((4000, 1))).q.std(0)[0], [0.02, 0.5], rtol=0.1)
    assert_derivatives_match(wobble.at, 1e-3, n=4000)


def assert_derivatives_match(motion, tolerance: float, n: int = 3) -> None:  # type: ignore[no-untyped-def]
    h = 1e-5
    t = np.linspace(0.05, 1.9, 11) * np.ones((n, 1))
    before, now, after = motion(t - h), motion(t), motion(t + h)
    np.testing.assert_allclose(now.qd, (after.q - before.q) / (2 * h), atol=tolerance)
    np.testing.assert_allclose(now.qdd, (after.qd - before.qd) / (2 * h), atol=tolerance * 10)


def test_velocities_and_accelerations_are_derivatives_of_the_motion(session: Session) -> None:
    h = 2e-4
    t = session.throw.release[:, None] + np.linspace(-0.5, 0.4, 19)
    before, now, after = (session.throw.body(t + dt) for dt in (-h, 0.0, h))
    for name in ("right_hand", "left_hand", "imu"):
        b, c, a = (getattr(part, name) for part in (before, now, after))
        np.testing.assert_allclose(c.v, (a.p - b.p) / (2 * h), atol=2e-3)
        np.testing.assert_allclose(c.a, (a.v - b.v) / (2 * h), atol=0.5)
        # dR/dt = [w] R
        spin = np.einsum("ntij,ntkj->ntik", (a.R - b.R) / (2 * h), c.R)
        rate = np.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], axis=-1)
        np.testing.assert_allclose(c.w, rate, atol=2e-3)


def test_jacobian(session: Session) -> None:
    _, q, _, _ = session.throw.coordinates
    J = jacobian(q[:, 3], session.throw.stature)
    h, still = 1e-6, np.zeros((len(q), 1, len(body.COORDINATES)))
    for k, c in enumerate(range(body.THROWING.start, body.THROWING.stop)):
        shifted = []
        for sign in (1, -1):
            posture = q[:, 3:4].copy()
            posture[..., c] += sign * h
            shifted.append(body.move(Motion(posture, still, still), session.throw.stature, session.throw.mass))
        slope = (shifted[0].right_hand.p - shifted[1].right_hand.p)[:, 0] / (2 * h)
        np.testing.assert_allclose(J[..., k], slope, atol=1e-8)


def test_the_ball_leaves_with_the_hand(session: Session) -> None:
    hand = session.throw.body(session.throw.release[:, None]).right_hand
    np.testing.assert_allclose(session.flight.position[:, 0], hand.p[:, 0], atol=1e-12)
    np.testing.assert_allclose(session.flight.velocity[:, 0], hand.v[:, 0], atol=1e-12)
    ball, hands = (session.truth[..., sensors.LAYOUT.slice(name)] for name in ("ball", "hands"))
    held = session.t < session.throw.release[:, None]
    np.testing.assert_allclose(ball[held], hands[..., :3][held], atol=1e-12)


def test_joints_stay_near_their_anatomical_range(session: Session) -> None:
    q = session.throw.motion(session.t).q[..., body.THROWING]
    valid = np.arange(session.t.shape[1]) < session.lengths[:, None]
    excess = np.maximum(LOWER - q[valid], q[valid] - UPPER)
    assert excess.max() < 0.45
    assert np.quantile(excess.max(-1), 0.99) < 0.15


def standing(stature: float, mass: float) -> tuple[body.Body, tuple[Motion, Motion], np.ndarray]:
    q = np.zeros((1, 2, len(body.COORDINATES)))
    q[..., 2] = body.HIP_HEIGHT * stature
    still = np.zeros_like(q)
    feet = []
    for side in (0.12, -0.12):
        place = np.zeros((1, 2, 3))
        place[..., 1:] = [side, 0.07]
        feet.append(Motion(place, np.zeros_like(place), np.zeros_like(place)))
    moving = body.move(Motion(q, still, still), np.array([stature]), np.array([mass]), (feet[0], feet[1]))
    return moving, (feet[0], feet[1]), np.array([stature])


def test_segment_masses_add_up() -> None:
    moving, _, _ = standing(1.75, 70.0)
    assert sum(m[0, 0] for m, _, _ in moving.masses) == pytest.approx(70.0)


def test_inertial_unit_at_rest_reads_the_support() -> None:
    moving, _, _ = standing(1.75, 70.0)
    _, force, rate = sensors.inertial(moving)
    np.testing.assert_allclose(force, np.broadcast_to([0.0, 0.0, GRAVITY], force.shape), atol=1e-12)
    np.testing.assert_allclose(rate, 0.0, atol=1e-12)


def test_soles_at_rest_carry_the_body() -> None:
    moving, feet, stature = standing(1.75, 70.0)
    point, force = moving.zero_moment_point()
    left, right = soles.loads(point, force, feet, stature, np.ones((1, 2)))
    np.testing.assert_allclose(left.sum(-1) + right.sum(-1), 70.0 * GRAVITY, rtol=1e-12)
    # A body that is the same on both sides stands on both feet alike, straight above its centre of mass.
    np.testing.assert_allclose(left, right, rtol=1e-6)
    masses = moving.masses
    centre = np.sum([m[..., None] * p for m, p, _ in masses], axis=0) / 70.0
    np.testing.assert_allclose(point, centre[..., :2], atol=1e-12)


def test_cells_balance_about_the_centre_of_pressure() -> None:
    rng = np.random.default_rng(0)
    along, across = rng.uniform(-0.15, 0.15, (2, 200))
    weights = soles.distribute(along, across)
    assert (weights > 0).all()
    np.testing.assert_allclose(weights.sum(-1), 1.0)
    # Within the sole's outline the cells' centre follows the wanted one, drawn in a little at the edge.
    centres = np.stack([weights @ soles._ALONG, weights @ soles._ACROSS], axis=-1)
    assert np.corrcoef(centres[:, 0], along)[0, 1] > 0.97
    assert np.corrcoef(centres[:, 1], across)[0, 1] > 0.97
    assert np.isfinite(soles.distribute(np.array([9.0, -9.0]), np.array([-9.0, 9.0]))).all()


def test_a_lifted_foot_carries_nothing(session: Session) -> None:
    throw, t = session.throw, session.t
    lifted = (t > throw.lift[:, None]) & (t < throw.land[:, None])
    assert lifted.any()
    loads = session.truth[..., sensors.LAYOUT.slice("shoe_left")].sum(-1)
    np.testing.assert_allclose(loads[lifted], 0.0, atol=1e-9)
    left = throw.feet(t)[0].q
    assert (left[lifted][:, 2] > 0.07).all()
    np.testing.assert_allclose(left[~lifted][:, 2], 0.07, atol=1e-9)


def test_soles_carry_the_inertia_of_the_throw(session: Session) -> None:
    _, force = session.throw.body(session.t).zero_moment_point()
    shoes = [session.truth[..., sensors.LAYOUT.slice(name)] for name in ("shoe_left", "shoe_right")]
    np.testing.assert_allclose(shoes[0].sum(-1) + shoes[1].sum(-1), force, rtol=1e-9)
    weight = session.throw.mass[:, None] * GRAVITY
    valid = np.arange(session.t.shape[1]) < session.lengths[:, None]
    ratio = (force / weight)[valid]
    assert 0.4 < ratio.min() < 0.95 < 1.05 < ratio.max() < 1.9  # nobody jumps
    assert ratio.mean() == pytest.approx(1.0, abs=0.03)
