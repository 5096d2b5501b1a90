"""Which labelled interaction is going on: against numpy, in every path, and refused where nobody can know."""

import numpy as np
import pytest
import torch

from torch_ebip import (
    Demonstrations,
    InteractionPrimitive,
    InteractionSession,
    LiveFilter,
    bip,
    ebip,
    particle_filter,
)
from torch_ebip.common.draws import seeded
from torch_ebip.interaction.recognition import PHASES, Recognition
from torch_ebip.recordings import actions

KNOWN = actions(24, 3).to(dtype=torch.float64)
PRIMITIVE = InteractionPrimitive.fit(KNOWN)
SENSORS = ~KNOWN.layout.controlled


def seen(length: int = 30) -> torch.Tensor:
    y = actions(4, 4).to(dtype=torch.float64)[2][:length].clone()
    y[:, ~SENSORS] = torch.nan
    return y


def make(**options):
    return ebip(PRIMITIVE, square_root=True, weigh=True, sharpness=[3.0, 3.0], forgetting=[6.0, 0.01], **options)


def numbers() -> torch.Tensor:
    return 0.5 + torch.rand(2, len(PHASES), generator=torch.Generator().manual_seed(0), dtype=torch.float64)


def test_probabilities_are_the_importance_of_members_by_label() -> None:
    filter = make()
    state = filter(seen(), generator=seeded(0)).state
    said = filter.recognise(state)
    weights = state.weights.detach().numpy()
    assert set(said) == {"lift", "swing", "circle", "nod"}
    for label, probability in said.items():
        wanted = weights[[own == label for own in KNOWN.labels]].sum()
        np.testing.assert_allclose(float(probability.detach()), wanted, rtol=1e-9)
    assert sum(float(p.detach()) for p in said.values()) == pytest.approx(1)
    assert max(said, key=lambda label: float(said[label].detach())) == "circle"


def test_with_numbers_of_its_own_they_are_those_of_the_formula() -> None:
    filter = make()
    filter.recognition = Recognition(PRIMITIVE.labels, numbers(), torch.tensor(0.1, dtype=torch.float64))
    state = filter(seen(), generator=seeded(0)).state
    evidence, phase = state.memory.weighting, float(filter.phase(state))
    temper = np.exp([np.interp(phase, PHASES, np.log(row)) for row in numbers().numpy()])
    distance = evidence.misfit.detach().numpy() / np.maximum(evidence.seen.detach().numpy(), 1)[:, None]
    logits = -(temper[:, None] * distance).sum(0)
    weights = np.exp(logits - logits.max())
    weights /= weights.sum()
    for label, probability in filter.recognise(state).items():
        mine = [own == label for own in KNOWN.labels]
        np.testing.assert_allclose(
            float(probability.detach()), 0.9 * weights[mine].sum() + 0.1 * np.mean(mine), rtol=1e-9
        )


def test_batches_live_filters_restricted_ones_and_drawn_members_agree() -> None:
    filter = make()
    filter.recognition = Recognition(PRIMITIVE.labels, numbers())
    y = seen()
    alone = filter.recognise(filter(y, generator=seeded(0)).state)
    batch = filter.recognise(filter(torch.stack([y, y.flip(0)]), generator=[seeded(0), seeded(1)]).state)
    live = LiveFilter(filter, SENSORS, generator=seeded(0))
    for t, sample in enumerate(y):
        if t:
            live.predict()
        live.update(sample)
    part = filter.restrict(SENSORS)
    narrow = part.recognise(part(y[:, SENSORS], generator=seeded(0)).state)
    for label in alone:
        assert float(batch[label][0].detach()) == pytest.approx(float(alone[label].detach()))
        assert float(live.recognise()[label]) == pytest.approx(float(alone[label].detach()))
        assert float(narrow[label].detach()) == pytest.approx(float(alone[label].detach()))
    drawn = make(n_members=60)
    state = drawn.initial_state(generator=torch.Generator().manual_seed(0))
    counts = [sum(KNOWN.labels[i] == label for i in state.memory.origin.tolist()) / 60 for label in alone]
    assert [float(p) for p in drawn.recognise(state).values()] == pytest.approx(counts)


def test_a_session_says_which() -> None:
    session = InteractionSession(make(), PRIMITIVE)
    for t, sample in enumerate(seen()):
        session.push("hand", sample[:3].tolist(), t / 30)
    said = session.forecast().labels
    assert max(said, key=said.__getitem__) == "circle"
    assert sum(said.values()) == pytest.approx(1, abs=1e-6)
    plain = InteractionPrimitive.fit(Demonstrations(KNOWN.layout, list(KNOWN), KNOWN.rate))
    with InteractionSession(ebip(plain, weigh=True), plain) as unlabelled:
        unlabelled.push("hand", [0.0, 0.0, 0.0], 0.0)
        assert dict(unlabelled.forecast().labels) == {}


def test_where_nobody_can_know_it_is_refused_by_name() -> None:
    plain = InteractionPrimitive.fit(Demonstrations(KNOWN.layout, list(KNOWN), KNOWN.rate))
    filter = ebip(plain, weigh=True)
    with pytest.raises(ValueError, match="the demonstrations have no labels"):
        filter.recognise(filter.initial_state())
    equal = ebip(PRIMITIVE)
    with pytest.raises(ValueError, match="does not weigh its members"):
        equal.recognise(equal.initial_state())
    for other in (bip(PRIMITIVE), particle_filter(PRIMITIVE)):
        with pytest.raises(ValueError, match=r"no labels|does not weigh"):
            other.recognise(other.initial_state())
    with pytest.raises(ValueError, match="got none"):
        Recognition([])
    with pytest.raises(ValueError, match=r"sharpness must be \[M, 6\] and positive"):
        Recognition(["a"], torch.zeros(2, 6))
    with pytest.raises(ValueError, match="floor must be a share"):
        Recognition(["a"], torch.ones(2, 6), torch.tensor(2.0))


def test_labels_stay_with_the_demonstrations() -> None:
    assert PRIMITIVE.subset([2, 0]).labels == ("circle", "lift")
    assert PRIMITIVE.extend(KNOWN.subset([1])).labels == (*KNOWN.labels, "swing")
    with pytest.raises(ValueError, match="1 labels for 24 demonstrations"):
        InteractionPrimitive(
            KNOWN.layout,
            PRIMITIVE.basis,
            30.0,
            PRIMITIVE.weights,
            PRIMITIVE.phase_velocity,
            PRIMITIVE.residual_variance,
            PRIMITIVE.residual_correlation_time,
            PRIMITIVE.value_variance,
            labels=["a"],
        )
