"""Draws without a generator, from one, and from one for each entry; what they made can be made again."""

import pytest
import torch

from tests.conftest import interactions, small_primitive
from torch_ebip import ebip
from torch_ebip.common.draws import replayed, seeded, set_states, standard_normal, states_of, uniform

LIKE = torch.zeros(())


@pytest.mark.parametrize("several", [False, True])
def test_states_bring_the_draws_back(several: bool) -> None:
    generator = [seeded(1), seeded(2)] if several else seeded(1)
    standard_normal((2, 3), LIKE, generator)
    before = states_of(generator)
    first = standard_normal((2, 3), LIKE, generator)
    assert torch.equal(standard_normal((2, 3), LIKE, replayed(generator, before)), first)
    now = replayed(generator)
    assert torch.equal(uniform((2, 3), LIKE, now), uniform((2, 3), LIKE, generator))
    set_states(generator, before)
    assert torch.equal(standard_normal((2, 3), LIKE, generator), first)


def test_the_global_generator_has_no_state_of_ours() -> None:
    assert states_of(None) == []
    assert replayed(None) is None
    state = torch.get_rng_state()
    set_states(None, [])
    assert torch.equal(torch.get_rng_state(), state)


def test_an_entry_needs_a_generator_each() -> None:
    for shape in ((3, 4), ()):
        with pytest.raises(ValueError, match="2 generators for draws"):
            standard_normal(shape, LIKE, [seeded(1), seeded(2)])


def test_gradients_of_segments_repeat_the_draws_of_the_global_generator() -> None:
    made = ebip(small_primitive(torch.float64))
    y = interactions(1, seed=5, dtype=torch.float64)[0]

    def gradients(segment: int | None) -> list[torch.Tensor]:
        torch.manual_seed(3)
        made.zero_grad()
        made(y, segment=segment).log_likelihood.sum().backward()
        return [parameter.grad.clone() for parameter in made.parameters() if parameter.grad is not None]

    whole, parts = gradients(None), gradients(8)
    assert len(whole) > 1
    for a, b in zip(whole, parts, strict=True):
        torch.testing.assert_close(a, b)
