"""Modes that a caller is in change neither numbers nor what is kept: autocast, inference, default device, graphs."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, layout
from torch_ebip import (
    AboveOne,
    BSplineBasis,
    Demonstrations,
    Filter,
    ForwardKinematicsLoss,
    GaussianBasis,
    InteractionPrimitive,
    InteractionSession,
    LiveFilter,
    RobotArm,
    StackedBasis,
    StudentT,
    Tuner,
    TuningSettings,
    bip,
    ebip,
    ebip_minus,
    particle_filter,
    select_basis,
)
from torch_ebip.filtering.functional import ensemble_covariance, ensemble_mean, ensemble_update, square_root_update
from torch_ebip.learning.losses import CRPSLoss, EnergyScoreLoss, TrajectoryLoss
from torch_ebip.learning.objective import ForecastObjective

STRONGER = torch.tensor(1.01)
MAKE: dict[str, Callable[[InteractionPrimitive], Filter]] = {
    "closed form": ebip,
    "all options": lambda p: ebip(
        p, square_root=True, weigh=True, context=BSplineBasis(4), inflation=AboveOne(STRONGER), robust=StudentT()
    ),
    "localised": lambda p: ebip(p, localise=True, weight_noise=0.1),
    "mixture": lambda p: ebip_minus(p, 20, max_components=1),
    "bip": bip,
    "particle": lambda p: particle_filter(p, softness=0.1),
}  # fmt: skip


@contextmanager
def elsewhere() -> Iterator[None]:
    """Whatever is made without saying where is made nowhere."""
    with torch.device("meta"):
        yield


MODES: dict[str, Callable[[], Any]] = {
    "autocast": lambda: torch.autocast("cpu", torch.bfloat16),
    "inference": torch.inference_mode,
    "no gradients": torch.no_grad,
    "default device": elsewhere,
    "nested": lambda: _both(),
}


@contextmanager
def _both() -> Iterator[None]:
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        yield


def seed() -> torch.Generator:
    return torch.Generator("cpu").manual_seed(0)


def generated() -> Demonstrations:
    return interactions(14)


KNOWN, Y = generated().subset(range(1, 14)), generated()[0][:20]
BASIS = StackedBasis([BSplineBasis(6)] * 5)
SEEN = torch.tensor([True, True, True, False, False]) & ~Y.isnan()


@pytest.mark.filterwarnings("ignore:no mixture")
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("kind", MAKE)
def test_filters(kind: str, mode: str) -> None:
    """Made and used in the mode, or made in it and used outside, or made outside and used in it."""
    end = torch.ones(1)

    def make() -> Filter:
        return MAKE[kind](InteractionPrimitive.fit(KNOWN, BASIS))

    def use(made: Filter) -> Tensor:
        trace = made(Y, SEEN, generator=seed())
        step, _ = made.update(made.predict(trace.state, made.dt, seed()), Y[-1], SEEN[-1], seed())
        return torch.cat([made.forecast(state, end).mean[0] for state in (trace.state, step)])

    outside = make()
    wanted = use(outside).detach()
    with torch.no_grad():
        wanted_live = use(outside)
    with MODES[mode]():
        inside = make()
        values = [use(inside).clone(), use(outside).clone()]
        state = outside.initial_state(generator=seed())
    for value in values:
        same = wanted if value.requires_grad else wanted_live
        assert torch.equal(value.detach(), same) or torch.allclose(value.detach(), wanted, rtol=1e-4, atol=1e-5)
    # And afterwards everything can be differentiated, written into, copied, continued.
    for made in (inside, outside):
        made.zero_grad()
        value = use(made)
        assert torch.equal(value.detach(), wanted)
        value.sum().backward()
        gradients = [p.grad for p in made.parameters() if p.grad is not None]
        assert gradients
        assert all(gradient.isfinite().all() for gradient in gradients)
        copy.deepcopy(made.state_dict())
    made(Y, SEEN, state=state, generator=seed()).log_likelihood.sum().backward()
    torch.optim.SGD(inside.parameters(), lr=1e-3).step()


@pytest.mark.parametrize("mode", MODES)
def test_live_filters_and_sessions(mode: str) -> None:
    primitive = InteractionPrimitive.fit(KNOWN, BASIS)
    made = MAKE["all options"](primitive)

    def live_and_session() -> tuple[LiveFilter, InteractionSession]:
        return LiveFilter(made, generator=seed()), InteractionSession(made, primitive)

    def step(live: LiveFilter, session: InteractionSession, t: int) -> Tensor:
        if t:
            live.predict()
        live.update(Y[t], SEEN[t])
        session.push("hand", Y[t, :2].tolist(), t / 30)
        answer = session.forecast(now=t / 30)
        return torch.cat([live.forecast(1.0).mean[0], answer.mean, live.phase[None], live.project((True,) * 5)])

    plain = live_and_session()
    wanted = [step(*plain, t) for t in range(8)]
    with MODES[mode]():
        made_inside = live_and_session()
    for pair, inside in ((live_and_session(), (0, 3, 4)), (made_inside, ()), (made_inside, (6, 7))):
        if pair is made_inside and inside:  # the same ones once more
            with MODES[mode]():
                pair = live_and_session()
        for t in range(8):
            if t in inside:
                with MODES[mode]():
                    got = step(*pair, t).clone()
            else:
                got = step(*pair, t)
            assert torch.equal(got, wanted[t])


@pytest.mark.parametrize("mode", MODES)
def test_fitting_and_tuning(mode: str) -> None:
    def tune() -> tuple[InteractionPrimitive, float]:
        basis = select_basis(KNOWN, [BSplineBasis(6), GaussianBasis(6, offset=True)])
        primitive = InteractionPrimitive.fit(KNOWN, basis)
        made = ebip(primitive, square_root=True)
        objective = ForecastObjective(primitive, layout().controlled)
        settings = TuningSettings(steps=2, batch_size=4, validate_every=1, folds=3, thinning=2)
        subsets = {"all": layout().mask(["hand", "gaze"])}
        tuner = Tuner(made, KNOWN, primitive, objective, layout().controlled, subsets, settings)
        return primitive, (tuner.run().validation[2] if torch.is_grad_enabled() else tuner.evaluate()["loss"])

    primitive, loss = tune()
    with MODES[mode]():
        again, other = tune()
        gradients = torch.is_grad_enabled()
    assert torch.equal(again.weights, primitive.weights)
    assert torch.equal(again.end_variance, primitive.end_variance)
    if gradients:
        assert other == loss
    assert not again.weights.is_inference()


@pytest.mark.parametrize("mode", MODES)
def test_arms_losses_and_kernels(mode: str) -> None:
    generator = seed()
    joints, target = torch.randn(4, 6, generator=generator), torch.randn(4, 6, generator=generator)
    members, draws = torch.randn(9, 5, generator=generator), torch.randn(9, 2, generator=generator)
    y, factor, scale, past = torch.randn(2, generator=generator), torch.eye(2), torch.ones(5), torch.randn(5)
    calls: dict[str, Callable[[], Tensor]] = {
        "arm": lambda: RobotArm.ur5()(joints),
        "loss": lambda: ForwardKinematicsLoss(RobotArm.ur5(), 0.1)(joints, target),
        "stochastic": lambda: ensemble_update(members, members[:, :2], y, factor, draws)[0],
        "square root": lambda: square_root_update(members, members[:, :2], y, factor)[0],
        "moments": lambda: torch.cat([ensemble_mean(members)[None], ensemble_covariance(members)]),
        "scores": lambda: CRPSLoss(scale)(members, past) + EnergyScoreLoss(scale)(members, past),
        "error": lambda: TrajectoryLoss(scale)(members[0], past),
        "basis": lambda: BASIS.project(members[:, 0], members[:, :1].expand(9, 30)),
        "another basis": lambda: GaussianBasis(5, offset=True)(members),
    }
    arm = RobotArm.ur5()
    wanted = {name: call() for name, call in calls.items()}
    with MODES[mode]():
        for name, call in calls.items():
            assert torch.equal(call(), wanted[name]), name
        arm(target)  # an evaluation before training
        loss = ForwardKinematicsLoss(arm)
    joints = joints.clone().requires_grad_()
    loss(joints, target.clone()).backward()
    fresh = joints.detach().clone().requires_grad_()
    ForwardKinematicsLoss(RobotArm.ur5())(fresh, target.clone()).backward()
    assert torch.equal(joints.grad, fresh.grad)


def test_demonstrations_leave_their_graph_behind() -> None:
    encoder = torch.nn.Linear(5, 5)
    generator = seed()
    paths = [encoder(torch.cumsum(torch.randn(40, 5, generator=generator), 0)) for _ in range(10)]
    made = Demonstrations(layout(), paths, 30.0)
    primitive = InteractionPrimitive.fit(made, BASIS)
    filter = ebip(primitive, square_root=True, weigh=True)
    for _ in range(2):
        filter(made[0]).log_likelihood.sum().backward()
    copy.deepcopy((made, primitive, filter))
    assert not any(tensor.requires_grad for tensor in (*made, *primitive.buffers(), *filter.buffers()))
    assert encoder.weight.grad is None
    # What is measured may carry one: an encoder can be trained through the filter.
    filter(encoder(torch.zeros(3, 5))).log_likelihood.sum().backward()
    assert encoder.weight.grad is not None


@pytest.mark.parametrize("kind", ["all options", "bip", "particle"])
def test_compiled_filters_give_the_same_numbers(kind: str) -> None:
    made = MAKE[kind](InteractionPrimitive.fit(KNOWN, BASIS))
    unseen = torch.where(SEEN, Y, torch.nan)

    def score() -> Tensor:
        made.zero_grad()
        trace = made(unseen, generator=seed())
        (made.forecast(trace.state, torch.ones(1)).mean.sum() + trace.log_likelihood.sum()).backward()
        return torch.cat([p.grad.flatten() for p in made.parameters() if p.grad is not None])

    wanted = score()
    whole = torch.compile(made, backend="aot_eager")
    assert torch.equal(whole(unseen, generator=seed()).projection, made(unseen, generator=seed()).projection)
    assert torch.equal(torch.compile(score, backend="aot_eager")(), wanted)


def test_compiled_and_mapped_arms() -> None:
    arm, joints = RobotArm.ur5().double(), torch.randn(3, 6, generator=seed(), dtype=torch.float64)
    poses = arm(joints)
    torch.testing.assert_close(torch.compile(arm, backend="aot_eager")(joints), poses)
    torch.testing.assert_close(torch.func.vmap(arm)(joints), poses)
    jacobians = torch.func.vmap(torch.func.jacrev(arm))(joints)
    for i in range(3):
        torch.testing.assert_close(jacobians[i], torch.autograd.functional.jacobian(arm, joints[i]))
    assert torch.func.vmap(torch.func.hessian(lambda q: arm(q)[0, 3]))(joints).shape == (3, 6, 6)


def test_what_cannot_be_mapped_says_so_in_a_line() -> None:
    made = ebip(InteractionPrimitive.fit(KNOWN, BASIS))
    with pytest.raises(RuntimeError, match=r"torch.vmap cannot look at values; a filter takes batches itself"):
        torch.func.vmap(lambda v: made(v).phase)(torch.ones(3, 4, 5))
    with pytest.raises(RuntimeError, match=r"torch.vmap cannot look at values; updates take batches themselves"):
        torch.func.vmap(lambda x: square_root_update(x, x[:, :2], torch.ones(2), torch.eye(2)))(torch.ones(3, 9, 5))
