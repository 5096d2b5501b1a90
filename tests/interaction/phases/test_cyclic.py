"""A phase on a circle: the contract of every filter, a textbook's filter, and what makes no difference on it."""

from __future__ import annotations

import math
from functools import partial

import numpy as np
import pytest
import torch

from tests.conftest import small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.cyclic import HUMAN, small_circle, waving
from tests.interaction.phases.textbook import updated
from tests.interaction.test_ebip import silent
from torch_ebip import (
    AcceleratingPhase,
    Analogues,
    ConstantVelocityPhase,
    CyclicPhase,
    InteractionFilter,
    InteractionModel,
    InteractionPrimitive,
    InteractionSession,
    LiveFilter,
    PhaseBank,
    bip,
    ebip,
    ebip_minus,
    load_model,
    particle_filter,
)
from torch_ebip.interaction.course import apart, circular_of, within
from torch_ebip.interaction.table import DemonstrationTable


class Waving(FilterContract):
    """Sequences that repeat."""

    def sequences(self, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
        values, observed = waving(3, seed=7, dtype=dtype).recordings.pad()
        values, observed = values[:, :20], observed[:, :20] & HUMAN
        observed[1, 4:8] = False
        return values, observed


class TestEnsemble(Waving):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        primitive = small_circle(dtype)
        variance = 10 * primitive.residual_variance
        return ebip(primitive, square_root=True, weigh=True, inflation=1.01, residual_variance=variance)

    def make_without_draws(self) -> InteractionFilter:
        return silent(ebip(small_circle(torch.float64), square_root=True, weigh=True))  # type: ignore[return-value]


class TestWithABank(Waving):
    """Of recordings that begin anywhere."""

    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        primitive = small_circle(dtype, True)
        variance = 10 * primitive.residual_variance
        return ebip(primitive, square_root=True, weigh=True, residual_variance=variance, pace=PhaseBank.of(primitive))

    def make_without_draws(self) -> InteractionFilter:
        return silent(self.make(torch.float64))  # type: ignore[return-value]


class TestExtended(Waving):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        return bip(small_circle(dtype), residual_variance=10 * small_circle(dtype).residual_variance)

    def make_without_draws(self) -> InteractionFilter:
        return self.make(torch.float64)


class TestParticles(Waving):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        primitive = small_circle(dtype)
        variance = 1e3 * primitive.residual_variance
        return particle_filter(primitive, residual_variance=variance, softness=0.2, pace=PhaseBank.of(primitive))

    def make_without_draws(self) -> InteractionFilter:
        made = silent(self.make(torch.float64))
        made.threshold = 0.0  # type: ignore[attr-defined]
        return made  # type: ignore[return-value]


def test_the_extended_filter_is_that_of_the_textbook() -> None:
    """Dense matrices in numpy, with a phase that just goes on: sines know nothing of whole cycles."""
    primitive = small_circle(torch.float64)
    made = bip(primitive, residual_variance=100 * primitive.residual_variance)
    y = waving(2, seed=9, dtype=torch.float64).recordings[1][:70].numpy()
    state = made.initial_state()
    mean, covariance = state.mean.numpy().copy(), state.covariance.numpy().copy()
    n, dt = len(mean), made.dt
    G = np.eye(n)
    G[0, 1] = dt
    Q = np.zeros((n, n))
    factor = made.model.process_noise.phase.cholesky(torch.tensor(dt).double()).detach().numpy()
    Q[:2, :2] = factor @ factor.T
    R = np.diag(made.model.measurement_noise().detach().numpy()[:3] ** 2)
    harmonics = primitive.basis.bases[0].harmonics  # type: ignore[attr-defined]

    def h(x: np.ndarray) -> np.ndarray:
        angle = 2 * np.pi * x[0] * np.arange(1, harmonics + 1)
        return x[2:].reshape(5, -1)[:3] @ np.concatenate([[1], np.cos(angle), np.sin(angle)])

    for t in range(70):
        if t:
            mean, covariance = G @ mean, G @ covariance @ G.T + Q
        mean, covariance = updated(mean, covariance, y[t, :3], R, h)
    trace = made(torch.tensor(y), HUMAN.expand(70, 5))
    assert mean[0] > 1.2
    assert trace.phase.max() < 1
    found = trace.state.mean.detach().numpy()
    assert found[0] == pytest.approx(mean[0] % 1, abs=1e-5)
    np.testing.assert_allclose(found[1:], mean[1:], atol=1e-5)
    np.testing.assert_allclose(trace.state.covariance.detach().numpy(), covariance, atol=1e-5)


@pytest.mark.parametrize("make", [ebip, particle_filter, bip, partial(ebip_minus, n_members=30)])
def test_where_phases_are_counted_from_makes_no_difference(make) -> None:
    """The same people, of whom somebody says that they are two cycles further on."""
    primitive = small_circle(torch.float64)
    parts = {name: buffer for name, buffer in primitive.named_buffers() if "." not in name}
    later = InteractionPrimitive(
        primitive.layout, primitive.basis, 30.0, **{**parts, "first_phase": primitive.first_phase + 2}
    )
    y = torch.where(HUMAN, waving(2, seed=9, dtype=torch.float64).recordings[1], torch.nan)
    ahead = torch.tensor([0.0, 0.2, 0.7, math.inf]).double()
    said = []
    for each in (primitive, later):
        options = {"pace": PhaseBank.of(each)} if make in (ebip, particle_filter) else {}
        made = make(each, residual_variance=100 * each.residual_variance, **options)
        with torch.no_grad():
            trace = made(y, generator=torch.Generator().manual_seed(0))
            said.append(made.forecast(trace.state, ahead=ahead))
    torch.testing.assert_close(said[1].mean, said[0].mean, atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(said[1].variance, said[0].variance, atol=1e-5, rtol=1e-3)


def test_it_goes_on_and_on_and_forecasts_do_not_feel_the_seam() -> None:
    primitive = small_circle(torch.float64)
    bank = PhaseBank.of(primitive)
    variance = 10 * primitive.residual_variance
    made = ebip(primitive, residual_variance=variance, square_root=True, weigh=True, pace=bank)
    recording, true = waving(4, seed=5, dtype=torch.float64).recordings[0], waving(4, seed=5).phases[0]
    many = torch.cat([recording[: int((true < 2).sum())]] * 5)  # ten cycles, where nobody showed more than six
    with torch.no_grad():
        draws = torch.Generator().manual_seed(0)
        trace = made(torch.where(HUMAN, many, torch.nan), generator=draws, keep=torch.arange(len(many)))
        said = made.forecast(trace.kept, ahead=torch.tensor([0.0, 1 / 30, 0.2]).double())
    assert (trace.phase.diff() < -0.5).sum() in (9, 10)
    assert trace.phase.min() > -0.2
    assert trace.phase.max() < 1.2
    errors = (said.mean[20:-6, 2, 3:] - many[26:, 3:]).abs()
    assert errors.median() < 0.4 * float(recording[:, 3:].std(0).mean())
    # A fifth of a second ahead differs from one sample to the next as the movement does, at the seam, too.
    jumps = said.mean[21:-6, 2, 3:].diff(dim=0).abs().amax(-1)
    seam = (trace.phase[21:-6].diff() < -0.5).nonzero().flatten()
    assert jumps[seam].max() <= jumps.max()
    assert jumps[seam].median() < 4 * jumps.median()


def test_the_end_may_be_anywhere_on_the_circle() -> None:
    primitive = small_circle(torch.float64)
    made = ebip(primitive, square_root=True)
    state = made.initial_state()
    with torch.no_grad():
        said = made.forecast(state, ahead=torch.tensor([math.inf]).double())
    phase = torch.linspace(0, 1, 241, dtype=torch.float64)[:-1]
    paths = primitive.basis.project_paths(phase, primitive.weights)
    torch.testing.assert_close(said.mean[0], paths.mean((0, 1)), atol=0.05, rtol=0)
    torch.testing.assert_close(said.variance[0].sqrt(), paths.flatten(0, 1).std(0), rtol=0.35, atol=0)


def test_both_engines_and_the_live_path_give_the_same() -> None:
    primitive = small_circle(torch.float64, True)
    made = ebip(
        primitive, residual_variance=10 * primitive.residual_variance, square_root=True, weigh=True,
        pace=PhaseBank.of(primitive),
    )  # fmt: skip
    y = torch.where(HUMAN, waving(2, seed=9, anywhere=True, dtype=torch.float64).recordings[1][:80], torch.nan)
    dense = made(y, engine="dense", generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        span = made(y, engine="span", generator=torch.Generator().manual_seed(0), project=False)
    assert (dense.phase.diff() < -0.5).any()
    torch.testing.assert_close(span.phase, dense.phase)
    torch.testing.assert_close(span.state.members, dense.state.members)
    live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    for t in range(80):
        if t:
            live.predict()
        live.update(y[t])
    torch.testing.assert_close(live.state.members, dense.state.members)
    ahead = torch.tensor([0.1, 0.5, math.inf]).double()
    torch.testing.assert_close(live.forecast(ahead=ahead).mean, made.forecast(dense.state, ahead=ahead).mean)


@pytest.mark.parametrize("seed", [3, 5])
def test_people_who_begin_anywhere_are_found_within_a_third_of_a_cycle(seed: int) -> None:
    primitive = small_circle(torch.float64, True)
    bank = PhaseBank.of(primitive)
    torch.testing.assert_close(bank.begin.sum(), torch.tensor(1.0).double())
    assert int((bank.begin > 0).sum()) > 15
    assert int((PhaseBank.of(small_circle(torch.float64)).begin > 0).sum()) < 7
    others = waving(12, seed=seed, anywhere=True, dtype=torch.float64)
    off = []
    for pace in (bank, None):
        made, errors = ebip(primitive, square_root=True, pace=pace), []
        for values, true in zip(others.recordings, others.phases, strict=True):
            gone = (true - true[0])[:-8]
            at = ((gone > 0.3) & (gone < 1)).nonzero().flatten()
            y = torch.where(HUMAN, values, torch.nan)
            with torch.no_grad():
                trace = made(y, keep=at, generator=torch.Generator().manual_seed(0))
                said = made.forecast(trace.kept, ahead=torch.tensor([0.25]).double()).mean[:, 0, 3:]
            errors.append((said - 0.5 * (values[at + 7] + values[at + 8])[:, 3:]).square().mean())
        off.append(float(torch.stack(errors).mean().sqrt()))
    assert off[0] < 0.7 * off[1]
    assert off[0] < 0.05


def test_a_model_file_keeps_the_circle(tmp_path) -> None:
    primitive = small_circle()
    made = ebip(primitive, square_root=True, weigh=True, pace=PhaseBank.of(primitive))
    model = InteractionModel(made, primitive)
    model.save(tmp_path / "waves.safetensors")
    again = load_model(tmp_path / "waves.safetensors")
    assert again.primitive.periodic
    assert isinstance(again.filter.phase_model, CyclicPhase)
    assert torch.equal(again.primitive.first_phase, primitive.first_phase)
    values = waving(2, seed=9).recordings[0]
    ours, theirs = (each.forecast(values, [0.1, math.inf]) for each in (model, again))
    assert torch.equal(ours.mean, theirs.mean)
    assert torch.equal(ours.variance, theirs.variance)


def test_a_session_on_a_circle_has_no_end() -> None:
    primitive = small_circle()
    made = ebip(primitive, residual_variance=10 * primitive.residual_variance, square_root=True)
    session = InteractionSession(made, primitive)
    values = waving(2, seed=9).recordings[0]
    for t, row in enumerate(values[:90].tolist()):
        session.push("hand", row[:2], t / 30)
        session.push("gaze", row[2:3], t / 30)
    expected = session.forecast()
    assert expected.time_to_end == math.inf
    ahead = [session.forecast(now=89 / 30 + wait).phase for wait in (0.0, 0.2, 0.4, 0.6)]
    assert all(0 <= phase < 1 for phase in ahead)
    steps = apart(torch.tensor(ahead).diff(), True)
    torch.testing.assert_close(steps, steps[:1].expand(3), atol=0.02, rtol=0)
    soon = session.forecast([0.0, 0.1, 5.0])
    assert soon.deviation.shape == (3, 2)
    assert np.isfinite(soon.mean).all()
    way = session.forecast(rate=30.0)
    assert np.abs(np.diff(way.mean, axis=0)).max() < 0.5 * np.ptp(way.mean, axis=0).max()
    assert not np.allclose(expected.mean, soon.mean[0], atol=1e-3)


def test_kinds_that_do_not_go_together_are_named() -> None:
    with pytest.raises(ValueError, match="phase on a circle and a periodic basis"):
        ebip(small_circle(), phase=ConstantVelocityPhase())
    with pytest.raises(ValueError, match="phase on a circle and a periodic basis"):
        ebip(small_circle(), phase=AcceleratingPhase())
    with pytest.raises(ValueError, match="phase on a circle and a periodic basis"):
        ebip(small_primitive(), phase=CyclicPhase())


def test_tables_and_analogues_go_round() -> None:
    primitive = small_circle(torch.float64)
    table = DemonstrationTable.of(primitive)
    which = torch.arange(24)
    places = torch.tensor([0.1, 0.93]).double().expand(24, 2)
    torch.testing.assert_close(table.at(which, places + 3), table.at(which, places))
    exact = torch.stack([primitive.basis.project(places[:, p], primitive.weights) for p in range(2)], 1)
    torch.testing.assert_close(table.at(which, places), exact, atol=1e-3, rtol=0)
    assert Analogues.of(primitive).table.periodic


def circular(shares: torch.Tensor, phases: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    angle = 2 * math.pi * phases
    return circular_of((shares * angle.cos()).sum(-1), (shares * angle.sin()).sum(-1))


def test_means_and_differences_on_a_circle() -> None:
    phases = torch.arange(10).double() / 10
    mean, deviation = circular(torch.eye(10).double(), phases)
    torch.testing.assert_close(apart(mean - phases, True), torch.zeros(10).double(), atol=1e-9, rtol=0)
    assert deviation.max() < 1e-4
    around = torch.tensor([0.25, 0, 0, 0, 0, 0, 0, 0, 0.25, 0.5]).double()
    assert float(circular(around, phases)[0]) == pytest.approx(0.9)
    assert float(circular(torch.full((10,), 0.1).double(), phases)[1]) > 0.5
    narrow = torch.exp(-0.5 * (apart(torch.arange(1000).double() / 1000 - 0.02, True) / 0.05).square())
    mean, deviation = circular(narrow / narrow.sum(), torch.arange(1000).double() / 1000)
    assert float(mean) == pytest.approx(0.02, abs=1e-6)
    assert float(deviation) == pytest.approx(0.05, rel=1e-3)
    assert within(torch.tensor([-0.25, 1.25]), True).tolist() == [0.75, 0.25]
    assert within(torch.tensor([-0.25, 1.25]), False).tolist() == [0.0, 1.0]
    assert apart(torch.tensor([0.75, -0.25]), False).tolist() == [0.75, -0.25]


def test_members_that_are_all_round_the_circle_are_brought_together() -> None:
    """With an R that says next to nothing and an inflation they spread ever more: the bank knows where people are."""
    primitive = small_circle(torch.float64)
    variance = 1e4 * primitive.residual_variance
    wide = []
    others = waving(6, seed=3, dtype=torch.float64)
    for pace in (PhaseBank.of(primitive), None):
        made = ebip(primitive, residual_variance=variance, square_root=True, inflation=1.02, pace=pace)
        off = []
        for values, true in zip(others.recordings, others.phases, strict=True):
            with torch.no_grad():
                y = torch.where(HUMAN, values, torch.nan)
                trace = made(y, generator=torch.Generator().manual_seed(0))
            off.append(apart(trace.phase - true, True)[10:].square().mean())
        wide.append(float(torch.stack(off).mean().sqrt()))
    assert wide[0] < 0.08
    assert wide[1] > 3 * wide[0]


def test_who_moves_as_nobody_did_does_not_send_members_round_and_round() -> None:
    """Half a minute of nonsense, ten times as large as anything shown: phases stay where tables know them."""
    primitive = small_circle()
    noise = torch.Generator().manual_seed(0)
    y = 10 * torch.randn(3, 900, 5, generator=noise).cumsum(1) / 10
    for options in ({}, {"pace": PhaseBank.of(primitive)}, {"weigh": True, "inflation": 1.01}):
        made = ebip(primitive, square_root=True, **options)
        with torch.no_grad():
            trace = made(torch.where(HUMAN, y, torch.nan), generator=noise, keep=torch.tensor([[300, 899]] * 3))
            said = made.forecast(trace.kept, ahead=torch.tensor([0.5, math.inf]))
        assert trace.state.mean.isfinite().all()
        assert said.mean.isfinite().all()
        moved = made.predict(trace.state, 1 / 30, noise).members[..., 0]
        assert (moved - moved.mean(-1, keepdim=True)).abs().max() < 1
    phases = torch.tensor([[0.2, 0.4, 7.3, -4.9], [0.9, 1.1, 1.3, 1.5]])
    held = CyclicPhase().hold(phases)
    torch.testing.assert_close(apart(held - phases, True), torch.zeros(2, 4), atol=1e-5, rtol=0)
    assert (held - held.mean(-1, keepdim=True)).abs().max() < 0.75
    torch.testing.assert_close(held[1].diff(), torch.full((3,), 0.2))


def test_the_extended_filter_knows_no_end_either() -> None:
    primitive = small_circle(torch.float64)
    made = bip(primitive)
    with torch.no_grad():
        said = made.forecast(made.initial_state(), ahead=torch.tensor([0.0, math.inf]).double())
    paths = primitive.basis.project_paths(torch.arange(240).double() / 240, primitive.weights)
    torch.testing.assert_close(said.mean[1], paths.mean((0, 1)), atol=1e-6, rtol=0)
    torch.testing.assert_close(said.variance[1].sqrt(), paths.flatten(0, 1).std(0), rtol=0.05, atol=0)
    at_once = made.forecast(made.initial_state(), torch.zeros(1).double())
    torch.testing.assert_close(said.mean[0], at_once.mean[0], atol=0.05, rtol=0)
