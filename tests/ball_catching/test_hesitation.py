"""A thrower who hesitates: consistent derivatives, and the same throw, later."""

from __future__ import annotations

import numpy as np

from experiments.ball_catching import thrower
from experiments.ball_catching.hesitation import RAMP, Hesitation, hesitating
from experiments.catch.throws import draw


def test_the_clock_stands_still_for_as_long_as_was_said_and_its_derivatives_are_right() -> None:
    hesitation = Hesitation(np.array([0.5, np.inf]), np.array([0.4, 0.0]))
    t = np.linspace(0, 3, 30001) * np.ones((2, 1))
    clock = hesitation.clock(t)
    np.testing.assert_allclose(np.gradient(clock.time, t[0], axis=1), clock.speed, atol=1e-3)
    np.testing.assert_allclose(np.gradient(clock.speed, t[0], axis=1), clock.change, atol=5e-2)
    standing = clock.speed[0] < 1e-9
    np.testing.assert_allclose(standing.sum() * 1e-4, 0.4, atol=0.01)
    np.testing.assert_allclose(t[0, -1] - clock.time[0, -1], 0.4 + RAMP)
    np.testing.assert_allclose(clock.time[1], t[1])
    np.testing.assert_allclose(hesitation.later(np.array([0.4, 2.0])), [0.4, 2.0])
    np.testing.assert_allclose(hesitation.later(np.array([1.0, 2.0])), [1.55, 2.0])


def test_every_second_thrower_throws_the_same_later() -> None:
    planned = thrower.plan(np.random.default_rng(0), 6)
    made = hesitating(np.random.default_rng(1), planned)
    lost = made.release - planned.release
    assert (lost[::2] == 0).all()
    assert ((lost[1::2] > 0.3) & (lost[1::2] < 1.0 + RAMP)).all()
    before, after = planned.body(planned.release[:, None]), made.body(made.release[:, None])
    np.testing.assert_allclose(after.right_hand.p, before.right_hand.p, atol=0.15)  # they sway on meanwhile
    np.testing.assert_allclose(after.right_hand.v, before.right_hand.v, atol=0.6)
    # Velocities and accelerations are those of the positions.
    t = np.linspace(0, 2.5, 5001) * np.ones((6, 1))
    hand = made.body(t).right_hand
    np.testing.assert_allclose(np.gradient(hand.p, t[0], axis=1)[:, 5:-5], hand.v[:, 5:-5], atol=0.05)
    motion = made.motion(t)
    np.testing.assert_allclose(np.gradient(motion.qd, t[0], axis=1)[:, 5:-5], motion.qdd[:, 5:-5], atol=2.0)


def test_disturbed_throws_are_the_same_throws() -> None:
    usual, late = draw("aimed", 4, 0), draw("aimed", 4, 0, disturbance="late")
    for i, (a, b) in enumerate(zip(usual, late, strict=True)):
        assert a.release == b.release
        first = min(packet.time for packet in b.packets)
        assert (first == 0) if i % 2 == 0 else 0.2 * b.release - 0.02 < first < 0.5 * b.release + 0.02
    slow = draw("aimed", 4, 0, disturbance="hesitate")
    assert [a.style for a in usual] == [b.style for b in slow]
    assert slow[0].release == usual[0].release
    assert 0.3 < slow[1].release - usual[1].release < 1.2
