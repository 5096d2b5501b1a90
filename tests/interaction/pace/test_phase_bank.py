"""The bank of phase hypotheses against plain numpy, in the contract of every filter, and for what it is there."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.conftest import interactions, small_primitive
from tests.filtering.contract import FilterContract
from tests.interaction.test_ebip import silent
from torch_ebip import (
    BSplineBasis,
    Demonstrations,
    EnsembleState,
    InteractionFilter,
    InteractionPrimitive,
    InteractionSession,
    LiveFilter,
    PhaseBank,
    StackedBasis,
    ebip,
    particle_filter,
)
from torch_ebip.filtering.updates.weighting import Seen
from torch_ebip.interaction.pace.leading import placement_of
from torch_ebip.interaction.pace.likeness import CAP
from torch_ebip.interaction.pace.moves import CHANCES, RATES, transition_of
from torch_ebip.interaction.pace.phase_bank import IDLE
from torch_ebip.interaction.pace.whereabouts import Whereabouts
from torch_ebip.interaction.table import DemonstrationTable

HUMAN = torch.tensor([True, True, True, False, False])


def paced(dtype: torch.dtype = torch.float32, **settings: float) -> InteractionFilter:
    primitive = small_primitive(dtype)
    variance = 30 * primitive.residual_variance
    bank = PhaseBank.of(primitive, **settings)
    return ebip(primitive, residual_variance=variance, square_root=True, weigh=True, inflation=1.01, pace=bank)


class TestPaced(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        return paced(dtype)

    def make_without_draws(self) -> InteractionFilter:
        return silent(paced(torch.float64))  # type: ignore[return-value]


class TestPacedParticles(FilterContract):
    def make(self, dtype: torch.dtype = torch.float32) -> InteractionFilter:
        primitive = small_primitive(dtype)
        bank, variance = PhaseBank.of(primitive), 1e3 * primitive.residual_variance
        return particle_filter(primitive, residual_variance=variance, softness=0.2, pace=bank)

    def make_without_draws(self) -> InteractionFilter:
        made = silent(self.make(torch.float64))
        made.threshold = 0.0
        return made  # type: ignore[return-value]


def numpy_bank(values: np.ndarray, times: np.ndarray, bank: PhaseBank) -> list[np.ndarray]:
    """Shares [2, N, P] after each step, from the docstring: loops over everything.

    Args:
        values: [T, 3], of the hand's two DoFs and the gaze; NaN where not measured.
        times: [T], s.
    """
    primitive = small_primitive(torch.float64)
    table = DemonstrationTable.of(primitive, bank.likeness.n_phases)
    f = table.values[..., :3].numpy()
    df = table.slopes[..., :3].numpy() * primitive.phase_velocity.numpy()[:, None, None]
    precision, order = bank.likeness.precision.numpy(), bank.likeness.order
    assert order.tolist()[0] == [0, 1]
    assert order.tolist()[1][0] == 2
    q, q_velocity = (1 / np.append(each[0], each[1, 0]) for each in precision)
    stop, go, jump, by_value, by_velocity, late, _ = bank.settings.tolist()
    N, P, _ = f.shape
    pace = primitive.phase_velocity.numpy()
    sensors = [[0, 1], [2]]
    begin = np.zeros((2, N, P))
    begin[:, :, 0] = (1 - late) / N
    begin += late / N / P
    begin *= np.array([1 - IDLE, IDLE])[:, None, None]
    at_once, ever = np.zeros((2, N, P)), np.zeros((2, N, P))
    at_once[:, :, 0], ever[:] = 1 / N, 1 / N / P
    anywhere = 0.5 * (at_once + ever) * np.array([1 - IDLE, IDLE])[:, None, None]
    share, told, last_step = begin, [], None
    before: list[tuple[float, float] | None] = [None] * 3
    bins: list[list[tuple[float, float]]] = [[] for _ in range(3)]
    for row, now in zip(values, times, strict=True):
        for d in range(3):
            if not math.isnan(row[d]):
                bins[d].append((now, row[d]))
        if last_step is not None and now - last_step < bank.period * (1 - 1e-4):
            continue
        steps = 0 if last_step is None else math.floor((now - last_step) / bank.period + 1e-4)
        for _ in range(steps):
            ahead = np.zeros_like(share)
            for j in range(N):
                for p in range(P):
                    for rate, chance in zip(RATES, CHANCES, strict=True):
                        place = min(p + rate * pace[j] * bank.period * (P - 1), P - 1)
                        low = min(math.floor(place), P - 2)
                        ahead[0, j, low] += chance * (1 - (place - low)) * share[0, j, p]
                        ahead[0, j, low + 1] += chance * (place - low) * share[0, j, p]
            s, g, leap = (1 - math.exp(-r * bank.period) for r in (stop, go, jump))
            going = (1 - s) * ahead[0] + g * share[1]
            standing = (1 - g) * share[1] + s * ahead[0]
            share = (1 - leap) * np.stack([going, standing]) + leap * anywhere
        x, u = np.full(3, np.nan), np.full(3, np.nan)
        for d in range(3):
            if bins[d]:
                t, x[d] = np.mean(bins[d], 0)
                if before[d] is not None and t - before[d][0] > 1e-3:
                    u[d] = (x[d] - before[d][1]) / (t - before[d][0])
                before[d] = (t, x[d])
        for j in range(N):
            for p in range(P):
                near, along, square, still = [], [], [], []
                for dofs in sensors:
                    some = [d for d in dofs if not math.isnan(x[d])]
                    near.append(sum((x[d] - f[j, p, d]) ** 2 / q[d] for d in some) / max(len(some), 1))
                    some = [d for d in dofs if not math.isnan(u[d])]
                    n = max(len(some), 1)
                    along.append(sum(u[d] * df[j, p, d] / q_velocity[d] for d in some) / n)
                    square.append(sum(df[j, p, d] ** 2 / q_velocity[d] for d in some) / n)
                    still.append(sum(u[d] ** 2 / q_velocity[d] for d in some) / n)
                rate = np.clip(sum(along) / max(sum(square), 1e-300), RATES[0], RATES[-1])
                moved = [c - 2 * rate * a + rate**2 * b for a, b, c in zip(along, square, still, strict=True)]
                where = bank.period * by_value * sum(min(each, CAP) for each in near)
                for mode, misfits in enumerate((moved, still)):
                    total = where + bank.period * by_velocity * sum(min(each, CAP) for each in misfits)
                    share[mode, j, p] *= math.exp(-0.5 * total)
        share = share / share.sum()
        told.append(share.copy())
        last_step = now if last_step is None else last_step + steps * bank.period
        bins = [[] for _ in range(3)]
    return told


def by_mode(share: torch.Tensor) -> np.ndarray:
    """Shares [2, N, P] of [N, 2 P]."""
    return np.stack(np.split(share.numpy(), 2, axis=-1))


def test_it_is_the_point_mass_filter_of_its_docstring() -> None:
    """Shares of every triple, step by step, with gaps and samples that are not evenly spaced."""
    bank = PhaseBank.of(small_primitive(torch.float64), phases=7, most=24, period=0.06)
    made = ebip(small_primitive(torch.float64), pace=bank)
    values = interactions(2, seed=9, dtype=torch.float64)[1][:14, :3].clone()
    values[5:8, 2] = math.nan
    values[9, :2] = math.nan
    gaps = [0.0, 0.02, 0.05, 0.033, 0.033, 0.033, 0.033, 0.1, 0.03, 0.033, 0.2, 0.033, 0.033, 0.033]
    expected = numpy_bank(values.numpy(), np.cumsum(gaps), bank)
    found: list[np.ndarray] = []
    state = made.initial_state()
    with torch.no_grad():
        for row, gap in zip(values, gaps, strict=True):
            state = made.predict(state, gap) if gap else state
            before = state.memory.pace.share
            state, _ = made.update(state, torch.cat([row, torch.full((2,), torch.nan)]))
            if not torch.equal(state.memory.pace.share, before):
                found.append(by_mode(state.memory.pace.share))
    assert len(found) == len(expected) >= 6
    for ours, theirs in zip(found, expected, strict=True):
        np.testing.assert_allclose(ours, theirs, atol=1e-9)
    told = state.memory.pace
    assert float(told.share.sum()) == pytest.approx(1)
    mean, deviation = bank.belief(told)
    phases = np.linspace(0, 1, 7)
    marginal = expected[-1].sum((0, 1))
    assert float(mean) == pytest.approx(float(marginal @ phases), abs=1e-9)
    spread = math.sqrt(float(marginal @ (phases - marginal @ phases) ** 2))
    assert float(deviation) == pytest.approx(max(spread, 0.5 / 6), abs=1e-9)


def test_who_goes_comes_on_and_nobody_is_lost() -> None:
    moves = transition_of(torch.tensor([0.3, 2.0]).double(), 21, 0.05)
    torch.testing.assert_close(moves.sum(-1), torch.ones(2, 21).double())
    places = torch.arange(21).double()
    ahead = (moves @ places - places) / 20 / 0.05
    usual = sum(r * c for r, c in zip(RATES, CHANCES, strict=True))
    torch.testing.assert_close(ahead[:, :4], (torch.tensor([0.3, 2.0]).double() * usual)[:, None].expand(2, 4))
    assert bool((moves[:, -1, -1] == 1).all())


@pytest.mark.parametrize("held", [0.0, 0.3, 1.0])
def test_the_time_that_is_gone_is_that_of_a_person_who_waits(held: float) -> None:
    """Against draws of waiting times; the mean over members is the mean."""
    bank = PhaseBank.of(small_primitive(torch.float64), go=1.5)
    start = bank.start(torch.zeros(24, 3).double(), None)
    memory = start._replace(standing=torch.tensor(0.4 + 0.4 * held).double(), clock=torch.tensor(0.0).double())
    assert float(bank.held(memory)) == pytest.approx(held, abs=1e-6)
    assert bank.waits(memory).gone(torch.tensor([-0.5]).double()).tolist() == [-0.5]  # what is past is past
    seconds = torch.tensor([0.2, 1.0, 4.0, math.inf]).double()
    generator = np.random.default_rng(0)
    waits = np.where(generator.random(200_000) < held, generator.exponential(1 / 1.5, 200_000), 0)
    told = bank.waits(memory)
    gone, apart = told.gone(seconds), told.gone_apart(seconds, 500)
    assert float(told.rest) == pytest.approx(waits.mean(), abs=0.01)
    assert gone[3].isinf()
    assert apart[3].isinf().all()
    for i in range(3):
        drawn = np.clip(float(seconds[i]) - waits, 0, None).mean()
        assert float(gone[i]) == pytest.approx(drawn, abs=0.01)
        assert float(apart[i].mean()) == pytest.approx(float(gone[i]), abs=0.02)


def test_nothing_is_known_of_a_demonstration_that_is_not_a_member() -> None:
    made = paced(torch.float64)
    without = torch.arange(24)[torch.arange(24) != 5]
    state = made.initial_state(demonstrations=without)
    y = torch.where(HUMAN, small_primitive(torch.float64).basis.project(
        torch.tensor(0.3).double(), small_primitive(torch.float64).weights[5]), torch.nan)  # fmt: skip
    state, _ = made.update(state, y)
    share = state.memory.pace.share
    assert not share[5].any()
    assert float(share.sum()) == pytest.approx(1)


def test_a_small_ensemble_does_not_make_a_bank_forget_the_others() -> None:
    primitive = small_primitive()
    filter = ebip(primitive, n_members=4, square_root=True, pace=PhaseBank.of(primitive))
    everyone = torch.ones(24, dtype=torch.bool)

    def hypotheses(**options: torch.Tensor) -> torch.Tensor:
        return filter.initial_state(
            (2,), generator=torch.Generator().manual_seed(0), **options
        ).memory.pace.share.sum(-1)

    torch.testing.assert_close(hypotheses(), torch.full((2, 24), 1 / 24))
    chosen = torch.tensor([[1, 2, 3, 3], [4, 5, 6, 7]])
    assert [row.nonzero().flatten().tolist() for row in hypotheses(demonstrations=chosen)] == [
        [1, 2, 3],
        [4, 5, 6, 7],
    ]
    without = everyone.clone()
    without[9] = False
    found = hypotheses(demonstrations=chosen, known=without)
    torch.testing.assert_close(found, (without / 23).expand(2, -1))
    with pytest.raises(ValueError, match=r"known must be bool \[..., 24\], got \[23\]"):
        hypotheses(known=everyone[1:])
    with pytest.raises(ValueError, match="known must be bool"):
        hypotheses(known=chosen)


def disturbed(kind: str, values: torch.Tensor, rate: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A recording [T, 5] of which the person did something else, and its true phases [T]."""
    n, generator = len(values), torch.Generator().manual_seed(3)
    phase = torch.linspace(0, 1, n, dtype=torch.float64)
    pause = int(1.5 * rate)
    if kind.startswith("pause"):
        at = {"pause": n // 2, "pause at the start": 1}[kind]
        still = values[at].expand(pause, -1) + 0.01 * torch.randn(pause, 5, generator=generator, dtype=torch.float64)
        where = phase[at].expand(pause)
        return torch.cat([values[:at], still, values[at:]]), torch.cat([phase[:at], where, phase[at:]])
    if kind == "late":
        return values[n // 2 :], phase[n // 2 :]
    if kind == "again":
        return torch.cat([values[: n // 2], values]), torch.cat([phase[: n // 2], phase])
    return values, phase


@pytest.mark.parametrize("kind", ["nothing", "pause", "pause at the start", "late", "again"])
def test_it_finds_people_who_pause_start_late_or_start_over(kind: str) -> None:
    """Of interactions that are none of the demonstrations: error of the phase at the end, with and without."""
    primitive = small_primitive(torch.float64)
    with_it = paced(torch.float64)
    without = ebip(
        primitive, residual_variance=30 * primitive.residual_variance, square_root=True, weigh=True, inflation=1.01
    )
    errors: dict[str, list[float]] = {"with": [], "without": []}
    for values in list(interactions(12, seed=77, dtype=torch.float64)):
        values = values.nan_to_num(0.5)
        told, phase = disturbed(kind, values, 30.0)
        shown = torch.where(HUMAN, told, torch.nan)[phase < 0.9]
        for name, made in (("with", with_it), ("without", without)):
            with torch.no_grad():
                trace = made(shown, generator=torch.Generator().manual_seed(0))
            errors[name].append(float((trace.phase[-6:] - phase[phase < 0.9][-6:]).abs().mean()))
    found, before = (float(np.median(errors[name])) for name in ("with", "without"))
    assert found < 2 / 24  # two cells of the bank's grid
    assert found < (1.3 * before + 0.01 if kind == "nothing" else 0.6 * before)


@pytest.mark.parametrize("kind", ["pause", "late", "again"])
def test_particles_are_led_too(kind: str) -> None:
    """The median error of the phase at the end, with and without a bank."""
    primitive = small_primitive(torch.float64)
    variance = 1e3 * primitive.residual_variance
    errors: dict[bool, list[float]] = {True: [], False: []}
    for values in list(interactions(12, seed=77, dtype=torch.float64)):
        told, phase = disturbed(kind, values.nan_to_num(0.5), 30.0)
        shown = torch.where(HUMAN, told, torch.nan)[phase < 0.9]
        for with_it, found in errors.items():
            bank = PhaseBank.of(primitive) if with_it else None
            made = particle_filter(primitive, residual_variance=variance, pace=bank)
            with torch.no_grad():
                trace = made(shown, generator=torch.Generator().manual_seed(0))
            found.append(float((trace.phase[-6:] - phase[phase < 0.9][-6:]).abs().mean()))
    assert np.median(errors[True]) < 2.5 / 24
    assert np.median(errors[True]) < 0.7 * np.median(errors[False])


def test_it_says_that_somebody_stands_still_and_that_the_end_is_later() -> None:
    made = paced(torch.float64)
    values = interactions(3, seed=77, dtype=torch.float64)[1]
    told, phase = disturbed("pause", values, 30.0)
    at = len(values) // 2
    with InteractionSession(made, small_primitive(torch.float64)) as session:
        seen = []
        for t, row in enumerate(told[: at + 45].tolist()):
            session.push("hand", row[:2], t / 30)
            session.push("gaze", row[2:3], t / 30)
            expected = session.forecast([0.1, 0.5], t / 30)
            seen.append((expected.phase, expected.time_to_end, expected.mean))
    assert phase[at] == pytest.approx(seen[-1][0], abs=0.08)
    # A pause ends after 1 / go seconds on the average: the end is that much later.
    assert seen[-1][1] > seen[at - 1][1] + 0.5
    # Half a second ahead is little ahead of now, and less than before the pause.
    assert (seen[-1][2][1] - seen[-1][2][0]).norm() < 0.6 * (seen[at - 1][2][1] - seen[at - 1][2][0]).norm()


def test_a_pause_is_not_taken_for_many_witnesses() -> None:
    """Ten seconds of standing still make nobody sure: the spread of the weights is about that after one."""
    made = paced(torch.float64)
    values = interactions(3, seed=77, dtype=torch.float64)[1]
    row = torch.where(HUMAN, values[15], torch.nan)
    spreads = []
    for seconds in (1, 10):
        with torch.no_grad():
            shown = torch.cat([torch.where(HUMAN, values[:15], torch.nan), row.expand(30 * seconds, -1)])
            trace = made(shown, generator=torch.Generator().manual_seed(0))
        spreads.append(float(made.forecast(trace.state, 1.0).variance[0, 3:].sqrt().mean()))
    assert spreads[1] > 0.5 * spreads[0]


def test_both_engines_and_the_live_path_give_the_same() -> None:
    made = paced(torch.float64)
    values = interactions(3, seed=77, dtype=torch.float64)
    pairs = [torch.where(HUMAN, disturbed(kind, values[1], 30.0)[0], torch.nan)[:70] for kind in ("pause", "again")]
    y = torch.stack(pairs)
    y[1, 20:26, :2] = math.nan
    with torch.no_grad():
        dense = made(y, generator=torch.Generator().manual_seed(0), engine="dense")
        span = made(y, generator=torch.Generator().manual_seed(0), engine="span")
    torch.testing.assert_close(span.state.members, dense.state.members)
    torch.testing.assert_close(span.phase, dense.phase)
    for entry in range(2):
        live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
        for t in range(70):
            if t:
                live.predict()
            live.update(y[entry, t])
        alone = made(y[entry], generator=torch.Generator().manual_seed(0), engine="dense")
        torch.testing.assert_close(live.state.members, alone.state.members)
        # From the middle on: what is hidden is not behind a transform then.
        middle = made(y[entry, :40], generator=torch.Generator().manual_seed(0), engine="dense").state
        live = LiveFilter(made, HUMAN, state=middle, generator=torch.Generator().manual_seed(5))
        generator = torch.Generator().manual_seed(5)
        for t in range(40, 70):
            live.predict()
            live.update(y[entry, t])
            middle = made.predict(middle, made.dt, generator)
            middle, _ = made.update(middle, y[entry, t], generator=generator)
        torch.testing.assert_close(live.state.members, middle.members)


def test_units_and_translation_change_nothing() -> None:
    """Shares [N, 2 P] of the same recordings in millimetres and from another origin."""
    plain = interactions(24, dtype=torch.float64)
    told = []
    for scale, offset in ((1.0, 0.0), (1000.0, 0.0), (1.0, 50.0)):
        values = [trajectory * scale + offset for trajectory in plain]
        demonstrations = Demonstrations(plain.layout, values, 30.0)
        primitive = InteractionPrimitive.fit(demonstrations, StackedBasis([BSplineBasis(6)] * 5))
        bank = PhaseBank.of(primitive)
        memory = bank.start(torch.zeros(24, 3).double(), None)
        for row in values[1][:20]:
            memory, _ = bank.elapse(memory, torch.tensor(1 / 30).double())
            memory, _ = bank.notice(memory, seen_of(row))
        told.append(memory.share)
    torch.testing.assert_close(told[1], told[0], atol=1e-8, rtol=1e-5)
    torch.testing.assert_close(told[2], told[0], atol=1e-8, rtol=1e-5)


def seen_of(row: torch.Tensor) -> Seen:
    moving = torch.zeros(24, 2, dtype=row.dtype)
    return Seen(row.nan_to_num(0.0), HUMAN & ~row.isnan(), None, None, moving, moving.mean(0), None)


def test_a_sensor_that_lies_does_not_decide() -> None:
    """The gaze says something absurd from a third on: the hand alone tells where the person is."""
    made = paced(torch.float64)
    errors = []
    for values in list(interactions(8, seed=77, dtype=torch.float64)):
        shown = torch.where(HUMAN, values.nan_to_num(0.5), torch.nan)
        shown[len(shown) // 3 :, 2] += 5
        memory: Whereabouts | None = None
        bank = made.analysis.pace
        memory = bank.start(torch.zeros(24, 3).double(), None)
        for row in shown[: int(0.7 * len(shown))]:
            memory, _ = bank.elapse(memory, torch.tensor(1 / 30).double())
            memory, _ = bank.notice(memory, seen_of(row))
        errors.append(abs(float(bank.belief(memory)[0]) - 0.7))
    assert float(np.median(errors)) < 0.1


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"stop": 0.0}, "stop must be a positive number"),
        ({"go": math.nan}, "go must be"),
        ({"late": 1.0}, "late must lie between 0 and 1, got 1"),
        ({"period": -1.0}, "period must be a positive number of seconds"),
        ({"phases": 1}, "phases must be"),
    ],
)
def test_bad_settings_are_named(settings: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        PhaseBank.of(small_primitive(), **settings)  # type: ignore[arg-type]


def test_a_state_made_by_hand_is_led_alike_by_both_engines() -> None:
    """With the memory of another one and no centre; and without any memory."""
    made = paced(torch.float64)
    start = made.initial_state()
    values = interactions(3, seed=77, dtype=torch.float64)[1]
    y = torch.where(HUMAN, disturbed("late", values, 30.0)[0], torch.nan)
    for state in (EnsembleState(start.members, start.memory), EnsembleState(start.members)):
        if state.memory.weighting is None:
            made = ebip(small_primitive(torch.float64), square_root=True, pace=made.pace)
        with torch.no_grad():
            span, dense = (
                made(y, state=state, engine=engine, generator=torch.Generator().manual_seed(0))
                for engine in ("span", "dense")
            )
        torch.testing.assert_close(span.state.members, dense.state.members)


def test_gradients_are_finite_where_all_members_are_at_one_phase() -> None:
    made = paced(torch.float64)
    values = interactions(3, seed=77, dtype=torch.float64)[1]
    state = made.initial_state()
    deviations = state.deviations.clone().requires_grad_()
    state = state._replace(deviations=deviations)
    for row in values[15:21]:
        state, _ = made.update(made.predict(state, made.dt), torch.where(HUMAN, row, torch.nan))
    made.forecast(state, 1.0).mean.sum().backward()
    assert deviations.grad is not None
    assert deviations.grad.isfinite().all()


def test_a_sample_that_is_refused_leads_nobody() -> None:
    made = ebip(small_primitive(), pace=PhaseBank.of(small_primitive()))
    values = interactions(3, seed=77)[1]
    live = LiveFilter(made, HUMAN, generator=torch.Generator().manual_seed(0))
    for row in values[:12]:
        live.predict()
        live.update(torch.where(HUMAN, row, torch.nan))
    for _ in range(4):  # at one of these the bank takes a step
        live.predict()
        before = live.state
        with pytest.raises(ValueError, match=r"factored|finite|large|infinite|NaN"):
            live.update(torch.tensor([1e19, 0.0, 0.0, torch.nan, torch.nan]))
        assert torch.equal(live.state.members, before.members)
        assert torch.equal(live.state.memory.pace.sums, before.memory.pace.sums)
        assert torch.equal(live.state.memory.pace.share, before.memory.pace.share)


@pytest.mark.parametrize("absurd", [1e12, 3e38])
def test_what_is_absurd_leaves_the_bank_alive(absurd: float) -> None:
    bank = PhaseBank.of(small_primitive())
    memory = bank.start(torch.zeros(24, 3), None)
    values = interactions(3, seed=77)[1].nan_to_num(0.5).clone()
    values[10, 0] = absurd
    for row in values[:30]:
        memory, _ = bank.elapse(memory, torch.tensor(1 / 30))
        memory, _ = bank.notice(memory, seen_of(row))
    assert memory.share.isfinite().all()
    assert float(bank.belief(memory)[0]) == pytest.approx(30 / len(values), abs=0.12)


def test_a_silence_of_all_sensors_costs_nothing() -> None:
    """People walk on while nobody looks: the ensemble, which foresaw that, is not led astray afterwards."""
    primitive = small_primitive(torch.float64)
    errors: dict[bool, list[float]] = {True: [], False: []}
    for values in list(interactions(12, seed=77, dtype=torch.float64)):
        shown = torch.where(HUMAN, values.nan_to_num(0.5), torch.nan)
        shown[10:22] = torch.nan
        stop, phase = 26, torch.linspace(0, 1, len(values)).double()
        for with_it, found in errors.items():
            bank = PhaseBank.of(primitive, agree=2.0) if with_it else None
            made = ebip(primitive, residual_variance=30 * primitive.residual_variance, square_root=True, pace=bank)
            with torch.no_grad():
                trace = made(shown[:stop], generator=torch.Generator().manual_seed(0))
            found.append(float((trace.phase[-4:] - phase[stop - 4 : stop]).abs().mean()))
    assert np.mean(errors[True]) < np.mean(errors[False]) + 0.02


def test_who_moves_as_nobody_did_is_left_to_the_ensemble() -> None:
    """Six usual deviations from all demonstrations nobody is led, however far the phases are apart."""
    deviation, agree = torch.tensor(0.02).double(), torch.tensor(1.0).double()
    moving = torch.zeros(24, 2).double()
    seen = Seen(torch.zeros(3).double(), None, None, None, moving, moving.mean(0), None)
    belief, one = (torch.tensor(0.5).double(), deviation), torch.tensor(1.0).double()
    usual, strange = (placement_of(belief, torch.tensor(far).double(), one, seen, agree) for far in (1.0, 6.0))
    assert strange is None
    assert usual is not None
    assert float(usual.share) == 1.0
    assert float(usual.offset) == 0.5
    assert placement_of(belief, one, torch.tensor(0.0).double(), seen, agree) is None  # nor where there is no news


def test_particles_that_were_wrong_begin_anew_as_wide_as_the_bank_is() -> None:
    primitive = small_primitive(torch.float64)
    made = particle_filter(
        primitive, residual_variance=1e4 * primitive.residual_variance, pace=PhaseBank.of(primitive)
    )
    values = interactions(3, seed=77, dtype=torch.float64)[1]
    state, generator = made.initial_state(), torch.Generator().manual_seed(0)
    widest = 0.0
    for row in values[18:24]:
        state = made.predict(state, made.dt, generator)
        state, _ = made.update(state, torch.where(HUMAN, row, torch.nan), generator=generator)
        widest = max(widest, float(state.members[:, 0].std()))
    assert widest > 0.02


def test_a_bank_of_other_demonstrations_is_refused() -> None:
    with pytest.raises(ValueError, match="phase bank is of 24 demonstrations, the primitive has 12"):
        ebip(small_primitive(count=12), pace=PhaseBank.of(small_primitive()))
    values = [torch.where(HUMAN, 0.3, trajectory.nan_to_num()) for trajectory in interactions()]
    still = Demonstrations(interactions().layout, values, 30.0)
    with pytest.raises(ValueError, match="compares sensors that move"):
        PhaseBank.of(InteractionPrimitive.fit(still, StackedBasis([BSplineBasis(6)] * 5)))


def test_after_a_silence_nobody_is_led_before_velocities_are_known() -> None:
    """The ensemble of `seen_of` says phase 0: it is led at once, but not by the first sample after a second's gap."""
    bank = PhaseBank.of(small_primitive(torch.float64))
    memory = bank.start(torch.zeros(24, 3).double(), None)
    led = []
    for row, gap in zip(
        interactions(3, seed=77, dtype=torch.float64)[1][6:18], [0.06] * 6 + [1.0] + [0.06] * 5, strict=True
    ):
        memory, _ = bank.elapse(memory, torch.tensor(gap).double())
        memory, placement = bank.notice(memory, seen_of(row))
        led.append(placement is not None)
    assert led[5]
    assert not led[6]
    assert led[8]


def test_samples_of_who_stands_count_less_in_the_update() -> None:
    made = paced(torch.float64)
    row = torch.where(HUMAN, interactions(3, seed=77, dtype=torch.float64)[1][1], torch.nan)
    start = made.initial_state()
    spreads = []
    for standing in (0.1, 0.95):
        pace = start.memory.pace._replace(clock=torch.tensor(0.0).double(), standing=torch.tensor(standing).double())
        state, _ = made.update(start._replace(memory=start.memory._replace(pace=pace)), row)
        spreads.append(float(state.deviations[:, 2:].std(0).mean()))
    assert spreads[1] > 1.02 * spreads[0]
