"""The parts of an update: put together in one order, narrowed together, refused where they do not fit."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from tests.conftest import interactions, small_primitive
from torch_ebip import (
    BasisProjection,
    BSplineBasis,
    ConstantVelocityPhase,
    DemonstrationPrior,
    EnsembleFilter,
    GaussianPrior,
    Huber,
    Inflation,
    InteractionFilter,
    InteractionNoise,
    LiveFilter,
    MeasurementNoise,
    PhaseNoise,
    SquareRoot,
    StateSpace,
    Stochastic,
    StudentT,
    Update,
    bip,
    ebip,
    ebip_minus,
    functional,
    particle_filter,
)
from torch_ebip.filtering.updates import Rule
from torch_ebip.filtering.updates.rules import Columns
from torch_ebip.interaction import InteractionEnsembleFilter

HUMAN = torch.tensor([True, True, True, False, False])
PRIMITIVE = small_primitive(torch.float64)


@pytest.mark.parametrize("batch", [(), (3,)])
@pytest.mark.parametrize("rule", [Stochastic(), SquareRoot()], ids=["stochastic", "square root"])
def test_a_rule_and_its_twin_for_columns_move_alike(rule: Rule, batch: tuple[int, ...]) -> None:
    generator = torch.Generator().manual_seed(0)
    E, K = 12, 4

    def draws(*shape: int) -> Tensor:
        return torch.randn(*batch, *shape, generator=generator, dtype=torch.float64)

    projections, y, deviation, noise = draws(E, K), draws(K), draws(K).abs() + 0.1, draws(E, K)
    innovation = functional.innovation_of(projections, y, torch.diag_embed(deviation))
    assert innovation is not None
    moves = rule(innovation, noise if rule.perturbs else None) / innovation.scale.unsqueeze(-2)
    anomalies = (projections - projections.mean(-2, keepdim=True)).transpose(-1, -2).contiguous()
    S = anomalies @ anomalies.transpose(-1, -2) / (E - 1) + torch.diag_embed(deviation.square())
    right, solved = (draws(E + 1, K).transpose(-1, -2) for _ in range(2))
    right[..., E] = y - projections.mean(-2)
    views = (right[..., :E], solved[..., :E], solved[..., E:])
    columns = Columns(
        anomalies, right[..., E:], deviation.unsqueeze(-1), torch.linalg.cholesky(S), right, solved, *views
    )
    found, shift = rule.columns(columns, noise.transpose(-1, -2) if rule.perturbs else None)
    torch.testing.assert_close(found.transpose(-1, -2), moves)
    torch.testing.assert_close(shift.squeeze(-1), torch.linalg.solve(S, y - projections.mean(-2)))


def test_robust_weights_compose() -> None:
    """Each judges by what those before it left of a value's weight; both engines agree."""
    plain = ebip(PRIMITIVE, square_root=True)
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:15], torch.nan)
    y[5] *= 100
    ends = []
    for trust in ([StudentT()], [StudentT(), Huber(1.5)], [Huber(1.5), StudentT()]):
        made = InteractionEnsembleFilter(plain.model, plain.prior, 24, Update(SquareRoot(), trust))
        made = made.double()
        dense = made(y, generator=torch.Generator().manual_seed(0))
        with torch.no_grad():
            span = made(y, generator=torch.Generator().manual_seed(0), engine="span")
        torch.testing.assert_close(dense.state.members, span.state.members)
        ends.append(dense.state.mean.detach())
    assert not torch.allclose(ends[0], ends[1])
    assert not torch.allclose(ends[1], ends[2])


PRESETS: dict[str, tuple[Callable[[], InteractionFilter], str | None]] = {
    "ebip": (lambda: ebip(PRIMITIVE), None),
    "everything in the span": (
        lambda: ebip(
            PRIMITIVE, 10, square_root=True, weigh=True, inflation=1.01, robust=StudentT(), context=BSplineBasis(4)
        ),
        None,
    ),
    "ebip_minus": (lambda: ebip_minus(PRIMITIVE, 20, max_components=1), None),
    "weight noise": (lambda: ebip(PRIMITIVE, weight_noise=0.1), "weights have process noise"),
    "localised": (lambda: ebip(PRIMITIVE, localise=True), "covariances are localised"),
    "bip": (lambda: bip(PRIMITIVE), "has the dense engine only"),
    "particle_filter": (lambda: particle_filter(PRIMITIVE), "has the dense engine only"),
}


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.filterwarnings("ignore:no mixture")
def test_every_preset_says_which_engine_it_gets_and_why(name: str) -> None:
    make, reason = PRESETS[name]
    made = make()
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:4], torch.nan)
    assert made(y).engine == "dense"
    with torch.no_grad():
        assert made(y).engine == ("dense" if reason else "span")
        assert made(y, engine="dense").engine == "dense"
        if reason is None:
            assert made(y, engine="span").engine == "span"
        else:
            with pytest.raises(ValueError, match=f'engine="span" cannot serve this: .*{reason}'):
                made(y, engine="span")
    if isinstance(made, InteractionEnsembleFilter) and reason is not None:
        with pytest.raises(ValueError, match=reason):  # when it is made, not at the first update
            LiveFilter(made)


def test_why_the_span_engine_is_refused_for_a_call() -> None:
    made = ebip(PRIMITIVE, weigh=True)
    y = torch.zeros(2, 3, 5, dtype=torch.float64)
    with torch.no_grad():
        for arguments, reason in (
            ({"dt": torch.tensor([0.1, 0.2])}, "a dt of their own"),
            (
                {"state": made.initial_state((2,))._replace(memory=ebip(PRIMITIVE).initial_state((2,)).memory)},
                "by hand",
            ),
            ({"y": y.expand(2, 2, 3, 5)}, "one batch dimension at most"),
        ):
            with pytest.raises(ValueError, match=reason):
                made(**{"y": y, "engine": "span", **arguments})  # type: ignore[arg-type]


def test_parts_that_do_not_fit_are_refused_when_a_filter_is_made() -> None:
    tuned = ebip(PRIMITIVE, weigh=True, localise=True)
    prior = GaussianPrior(torch.zeros(32).double(), torch.eye(32).double())
    with pytest.raises(ValueError, match="EvidenceWeighting asks as which of the prior's states members started"):
        EnsembleFilter(tuned.model, prior, 24, Update(weighting=tuned.analysis.weighting))
    with pytest.raises(ValueError, match="a GaussianPrior knows no demonstrations"):
        InteractionEnsembleFilter(tuned.model, prior, 24)
    few = tuned.model.select(tuned.model.view(HUMAN))
    with pytest.raises(ValueError, match="the localisation is for 5 DoFs, the model has 3"):
        EnsembleFilter(few, tuned.prior, 24, Update(localisation=tuned.analysis.localisation))
    with pytest.raises(ValueError, match="the weighting is for 5 DoFs, the model has 3"):
        EnsembleFilter(few, tuned.prior, 24, Update(weighting=tuned.analysis.weighting))


def test_a_part_that_is_exchanged_is_the_one_that_acts() -> None:
    made = ebip(PRIMITIVE, square_root=True)
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][0], torch.nan)
    before = made.update(made.initial_state(), y)[0].covariance.diagonal().sum()
    made.analysis.inflation = Inflation(2.0)
    after = made.update(made.initial_state(), y)[0].covariance.diagonal().sum()
    torch.testing.assert_close(after, 4 * before)


class Walk(torch.nn.Module):
    """Of one's own: x stirred alike everywhere, which nobody says to leave anything at rest."""

    def forward(self, members: Tensor, dt: Tensor, generator: torch.Generator | None = None) -> Tensor:
        return members + 0.01 * torch.randn(members.shape, generator=generator, dtype=members.dtype)


def test_a_noise_of_ones_own_takes_the_dense_engine() -> None:
    made = ebip(PRIMITIVE)
    made.model.process_noise = Walk()
    assert made.model.moving is None
    assert made.model.leading == 2
    with torch.no_grad():
        trace = made(torch.zeros(3, 5, dtype=torch.float64), generator=torch.Generator().manual_seed(0))
    assert trace.engine == "dense"
    assert trace.states.shape == (3, 2)


class Faster:
    """A mixin: everything takes half the time."""

    def forward(self, members: Tensor, dt: Tensor) -> Tensor:
        return super().forward(members, 2 * dt)  # type: ignore[misc, no-any-return]


class FasterPhase(Faster, ConstantVelocityPhase): ...


class Held(ConstantVelocityPhase):
    def hold(self, phase: Tensor) -> Tensor:
        return 0.9 * super().hold(phase)


class Louder(InteractionNoise):
    def forward(self, members: Tensor, dt: Tensor, generator: object = None) -> Tensor:
        return super().forward(members, 4 * dt, generator)  # type: ignore[arg-type]


class LouderInPlace(InteractionNoise):
    def add_(self, members: Tensor, dt: Tensor, generator: object = None) -> Tensor:
        return super().add_(members, 4 * dt, generator)  # type: ignore[arg-type]


class Shifted(BasisProjection):
    def forward(self, members: Tensor) -> Tensor:
        return super().forward(members) + 0.1


class ShiftedRows(BasisProjection):
    def rows(self, *arguments: object) -> Tensor:
        return super().rows(*arguments) + 0.1  # type: ignore[arg-type]


class Timid(SquareRoot):
    def forward(self, innovation: object, perturbations: Tensor | None) -> Tensor:
        return 0.5 * super().forward(innovation, perturbations)  # type: ignore[arg-type]


class Twice(DemonstrationPrior):
    def forward(self, *arguments: object) -> Tensor:
        return 2 * super().forward(*arguments)  # type: ignore[arg-type]


@pytest.mark.parametrize("kind", [FasterPhase, Held, Louder, LouderInPlace, Shifted, ShiftedRows, Timid, Twice])
def test_a_subclass_that_overrides_a_plain_method_is_what_acts_on_every_way(kind: type) -> None:
    """Its fast twins would compute something else: they are not taken; restricted, it is still the subclass."""
    made = ebip(PRIMITIVE, square_root=True)
    model = made.model
    if issubclass(kind, ConstantVelocityPhase):
        model.dynamics = kind()
    elif issubclass(kind, InteractionNoise):
        model.process_noise = kind(PhaseNoise(torch.tensor(0.5, dtype=torch.float64)))
    elif issubclass(kind, BasisProjection):
        model.measurement = kind(model.measurement.basis)
    elif issubclass(kind, SquareRoot):
        made.analysis.rule = kind()
    else:
        made.prior = kind(made.prior.states)
    y = torch.where(HUMAN, interactions(2, seed=9, dtype=torch.float64)[1][:12], torch.nan)
    plain = ebip(PRIMITIVE, square_root=True)(y, generator=torch.Generator().manual_seed(0))
    trace = made(y, generator=torch.Generator().manual_seed(0))
    assert not torch.allclose(trace.log_likelihood, plain.log_likelihood)
    with torch.no_grad():
        auto = made(y, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(auto.log_likelihood, trace.log_likelihood)
    if kind is Shifted:  # with `forward` alone it cannot be asked for some DoFs; all of them is the whole
        return
    part = made.restrict(torch.ones(5, dtype=torch.bool))
    again = part(y, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(again.log_likelihood, trace.log_likelihood)


def test_a_general_model_that_stands_still_in_part_is_narrowed_and_centred() -> None:
    """g moves the first entry only, h sees one further entry a DoF: nothing of it knows of interactions."""

    class Clock(torch.nn.Module):
        moving = 1

        def forward(self, x: Tensor, dt: Tensor) -> Tensor:
            return torch.cat([x[..., :1] + dt, x[..., 1:]], -1)

        def select(self, view: object) -> Clock:
            return self

    class Own(torch.nn.Module):
        def forward(self, x: Tensor) -> Tensor:
            return x[..., :1] * x[..., 1:]

        def entries(self, dofs: Tensor) -> Tensor:
            return 1 + dofs.nonzero().squeeze(-1)

        def select(self, view: object) -> Own:
            return self

    states = torch.randn(40, 4, generator=torch.Generator().manual_seed(0)).double() + 100.0
    model = StateSpace(Clock(), Own(), None, MeasurementNoise(torch.ones(3).double()), ("a", "b", "c"), 0.1)
    made = EnsembleFilter(model, DemonstrationPrior(states), 40, Update(SquareRoot()))
    state = made.initial_state()
    assert state.centre is not None
    assert float(state.deviations[:, 1:].abs().max()) < 10
    part = made.restrict(torch.tensor([True, False, True]))
    y = torch.tensor([[1e4, torch.nan, 1.01e4]] * 3).double()
    whole, some = made(y), part(y[:, [0, 2]])
    torch.testing.assert_close(whole.log_likelihood, some.log_likelihood)
    torch.testing.assert_close(whole.projection[:, [0, 2]], some.projection)
    assert whole.states.shape == (3, 1)


def test_the_old_name_of_chosen_demonstrations_is_still_taken() -> None:
    made, chosen = ebip(PRIMITIVE), torch.tensor([3, 1, 4])
    with pytest.warns(DeprecationWarning, match="is now called demonstrations=") as caught:
        old = made.initial_state(members=chosen)
    with pytest.warns(DeprecationWarning, match="is now called demonstrations="):
        live = LiveFilter(made, members=chosen)
    assert caught[0].filename == __file__
    new = made.initial_state(demonstrations=chosen)
    assert torch.equal(old.members, new.members)
    assert torch.equal(live.state.members, new.members)
    assert new.memory.origin.tolist() == [3, 1, 4]
