"""Constant offsets are taken out of an ensemble once, so that float32 holds how members differ."""

from __future__ import annotations

import torch

from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import Moves
from torch_ebip.filtering.states import EnsembleState


def taken_out(model: StateSpace, state: EnsembleState) -> EnsembleState:
    """A state with the middle of its members taken out of what stands still, if the model says what that is.

    Only of entries of which all members lie within a factor of two of it: there a difference is exact (Sterbenz
    1974), so that nothing is rounded; elsewhere the mean is small beside the spread, and nothing is gained.

    Args:
        model: of the state.
        state: with members [..., E, n] and no centre.
    """
    moving, members = model.leading, state.deviations
    if moving is None or moving >= members.shape[-1] or not isinstance(model.process_noise, Moves):
        return state
    if members.ndim == 3 and len(members) > 1 and members.stride(0) == 0:  # the same ones for the whole batch
        alike = taken_out(model, EnsembleState(members[0]))
        assert alike.centre is not None
        deviations, centre = alike.deviations.expand(members.shape), alike.centre.expand(len(members), -1)
        return state._replace(deviations=deviations, centre=centre)
    low, high = torch.aminmax(members.detach(), dim=-2)
    middle = (0.5 * (low + high)).nan_to_num()
    near = torch.where(middle < 0, -high, low) >= 0.5 * middle.abs()
    near &= torch.where(middle < 0, -low, high) <= 2 * middle.abs()
    near[..., :moving] = False
    if not bool(near.any()):
        return state._replace(centre=torch.zeros_like(middle))
    centre = torch.where(near, middle, 0)
    return state._replace(deviations=members - centre.unsqueeze(-2), centre=centre)
