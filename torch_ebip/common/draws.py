"""Random draws, on the device of their generator: from one generator, or from one for each entry of a batch.

With a generator of its own an interaction gets the same draws in whatever company it is filtered, alone or in a
batch, on one process or spread over many.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import torch
from torch import Tensor

Generators: TypeAlias = torch.Generator | Sequence[torch.Generator] | None
"""One generator; or one for each entry of the first batch dimension; or torch's global one."""
GOLDEN = 0.6180339887498949
"""Multiples of it, less their whole part, are evenly spread, in an order that nothing else has."""


def standard_normal(shape: Sequence[int], like: Tensor, generator: Generators) -> Tensor:
    """Draws [*shape] in the dtype and on the device of ``like``; from torch's global stream without a generator.

    They are made where the generator lives and moved, so that a generator of the CPU serves every device.

    Raises:
        ValueError: a sequence of generators that is not as long as the first dimension.
    """

    def draw(shape: Sequence[int], generator: torch.Generator | None, device: torch.device) -> Tensor:
        """From one generator."""
        return torch.randn(tuple(shape), generator=generator, dtype=like.dtype, device=device)

    return _drawn(draw, shape, like.device, generator)


def uniform(shape: Sequence[int], like: Tensor, generator: Generators) -> Tensor:
    """Draws [*shape] from [0, 1); otherwise as `standard_normal`."""

    def draw(shape: Sequence[int], generator: torch.Generator | None, device: torch.device) -> Tensor:
        """From one generator."""
        return torch.rand(tuple(shape), generator=generator, dtype=like.dtype, device=device)

    return _drawn(draw, shape, like.device, generator)


def integers(high: int, shape: Sequence[int], device: torch.device, generator: Generators) -> Tensor:
    """Draws int64 [*shape] from 0 to high - 1; otherwise as `standard_normal`."""

    def draw(shape: Sequence[int], generator: torch.Generator | None, device: torch.device) -> Tensor:
        """From one generator."""
        return torch.randint(high, tuple(shape), generator=generator, device=device)

    return _drawn(draw, shape, device, generator)


def is_several(generator: Generators) -> bool:
    """Whether each entry of the batch has a generator of its own."""
    return generator is not None and not isinstance(generator, torch.Generator)


def seeded(*numbers: int) -> torch.Generator:
    """A generator of the CPU for some integers: neighbouring ones do not share streams."""
    seed = 17
    for number in (*numbers, 0):  # once more, so that the last number is mixed like the others
        # The multiplier of Knuth's 64-bit linear congruential generator.
        seed = (seed * 6_364_136_223_846_793_005 + 1_442_695_040_888_963_407 + number) % 2**64
    return torch.Generator("cpu").manual_seed(seed >> 32)  # the better half; torch's generator takes no more


def fill_standard_normal(buffer: Tensor, generator: Generators) -> Tensor:
    """The buffer [...], filled with standard-normal draws: those that `standard_normal` would make."""
    if generator is None or (isinstance(generator, torch.Generator) and generator.device == buffer.device):
        return buffer.normal_(generator=generator)
    return buffer.copy_(standard_normal(buffer.shape, buffer, generator))


def replayed(generator: Generators, states: Sequence[Tensor] | None = None) -> Generators:
    """New generators that will make the draws that ``generator`` would make now, or made from some states on.

    Args:
        generator: one, several or none; not changed.
        states: [bytes] each, as `states_of` gives them; default: the present ones.
    """
    if generator is None:
        return None
    if isinstance(generator, torch.Generator):
        return _copy(generator, generator.get_state() if states is None else states[0])
    now = states_of(generator) if states is None else states
    return [_copy(one, state) for one, state in zip(generator, now, strict=True)]


def states_of(generator: Generators) -> list[Tensor]:
    """The state of each generator, uint8 [bytes]; none for torch's global one."""
    if generator is None:
        return []
    return [one.get_state() for one in ([generator] if isinstance(generator, torch.Generator) else generator)]


def set_states(generator: Generators, states: Sequence[Tensor]) -> None:
    """Bring every generator to its own of some states, uint8 [bytes], as `states_of` gave them."""
    if generator is not None:
        several = [generator] if isinstance(generator, torch.Generator) else generator
        for one, state in zip(several, states, strict=True):
            one.set_state(state)


def _copy(generator: torch.Generator, state: Tensor) -> torch.Generator:
    again = torch.Generator(generator.device)
    again.set_state(state)
    return again


def _drawn(
    draw: Callable[[Sequence[int], torch.Generator | None, torch.device], Tensor],
    shape: Sequence[int],
    device: torch.device,
    generator: Generators,
) -> Tensor:
    if generator is None:
        return draw(shape, None, device)
    if isinstance(generator, torch.Generator):
        return draw(shape, generator, generator.device).to(device)
    if not shape or shape[0] != len(generator):
        raise ValueError(f"{len(generator)} generators for draws {list(shape)}: needs one for each of the first")
    return torch.stack([draw(shape[1:], one, one.device) for one in generator]).to(device)
