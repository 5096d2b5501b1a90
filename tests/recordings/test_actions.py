"""Generated actions: they are reproducible, their ends look alike, and what was seen first decides."""

import pytest
import torch

from torch_ebip.recordings import actions


def test_a_seed_reproduces_and_another_does_not() -> None:
    before = torch.get_rng_state()
    one, same, other = actions(8, 1), actions(8, 1), actions(8, 2)
    assert all(torch.equal(a, b) for a, b in zip(one, same, strict=True))
    assert not torch.equal(one[0][:50], other[0][:50])
    assert torch.equal(before, torch.get_rng_state())
    assert all(torch.equal(a, b) for a, b in zip(one, actions(100, 1), strict=False))
    assert one.labels == ("lift", "swing", "circle", "nod") * 2
    with pytest.raises(ValueError, match="count must be"):
        actions(0)


def test_ends_look_alike_but_are_not() -> None:
    """At the end no sensor tells the actions apart; after a fifth they do, and the arm ends elsewhere."""
    made = actions(400, 0)
    which = torch.arange(400) % 4

    def spread(part: torch.Tensor) -> float:
        """Variance of the means of the actions, over that within them."""
        means = torch.stack([part[which == a].mean(0) for a in range(4)])
        within = torch.stack([part[which == a].var(0) for a in range(4)]).mean(0)
        return float((means.var(0) / within).max())

    late = torch.stack([path[-1, :3] for path in made])
    early = torch.stack([path[round(0.22 * len(path)), :3] for path in made])
    arm = torch.stack([path[-1, 3:] for path in made])
    assert spread(late) < 0.05
    assert spread(early) > 2
    assert spread(arm) > 1
