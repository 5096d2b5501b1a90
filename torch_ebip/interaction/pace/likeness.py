"""How like the present is to demonstrations at phases: distances of values and velocities, sensor by sensor.

What counts as near is told by the demonstrations: each differs from the nearest other one at the same phase by so
much, and a person who was never seen will too.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.interaction.pace.moves import RATES
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.table import DemonstrationTable

CAP = 16.0
"""Largest squared distance of a sensor, in units of what is usual: more is a sensor that lies, or a stranger."""
STILL = 1e-6
"""Of the size of a DoF's values: what spreads by less is what regressions round."""
FARTHEST = 1e3
"""Usual deviations beyond which all is equally absurd."""
SLOPE_WINDOW = 0.05
"""s, over which velocities are measured, about: noise of samples makes them uncertain."""


class Likeness(nn.Module):
    """Squared distances from values and velocities to those of N demonstrations at P phases, and what they are worth.

    Args:
        values: [N, P, k], of the DoFs that are compared, units of the DoFs.
        velocities: [N, P, k], units of the DoFs a second, at the demonstrations' own pace.
        error: [2, k], mean squares that are usual of values and velocities.
        dofs: int64 [k], which of the layout's DoFs these are.
        sensor_of_dof: int64 [k], numbered from 0.
        periodic: whether phases are those of a circle.

    Attributes:
        order: int64 [S, w], the DoFs of each sensor; where it has fewer than w any, of no precision.
        middle: [S, w], units of the DoFs, that all distances are taken from.

    Raises:
        ValueError: shapes that do not fit.
    """

    blocks: Tensor
    precision: Tensor
    middle: Tensor
    farthest: Tensor
    order: Tensor
    phases: Tensor

    def __init__(
        self,
        values: Tensor,
        velocities: Tensor,
        error: Tensor,
        dofs: Tensor,
        sensor_of_dof: Tensor,
        periodic: bool = False,
    ) -> None:
        super().__init__()
        self.periodic = periodic
        N, P, k = values.shape
        if velocities.shape != values.shape or error.shape != (2, k) or len(dofs) != k or len(sensor_of_dof) != k:
            raise ValueError(
                "values, velocities, error, dofs and sensor_of_dof must be [N, P, k] twice, [2, k] and [k] twice, "
                f"got {list(values.shape)}, {list(velocities.shape)}, {list(error.shape)}, {len(dofs)}, "
                f"{len(sensor_of_dof)}"
            )
        sensors = nn.functional.one_hot(sensor_of_dof)  # [k, S]
        S, w = sensors.shape[1], int(sensors.sum(0).max())
        place = sensor_of_dof * w + (sensors.cumsum(0) * sensors).sum(-1) - 1
        # Products are formed of deviations, never of values whose mean cancels only in exact arithmetic.
        middle = values.mean((0, 1))
        apart = values - middle
        parts = torch.stack([apart.square(), apart, velocities.square(), velocities])  # [4, N, P, k]
        blocks = values.new_zeros(4, N, P, S * w)
        blocks[..., place] = parts
        blocks = blocks.view(4, N * P, S, w).permute(2, 0, 3, 1).reshape(S, 4 * w, N * P)
        placed = values.new_zeros(3, S * w)
        placed[:, place] = torch.stack([middle, *(1 / error)])
        order = dofs.new_zeros(S * w)
        order[place] = dofs
        for name, tensor in (
            ("blocks", blocks),
            ("middle", placed[0].view(S, w)),
            ("precision", placed[1:].view(2, S, w)),
            ("farthest", FARTHEST / placed[1:].view(2, S, w).clamp(min=torch.finfo(values.dtype).tiny).sqrt()),
            ("order", order.view(S, w)),
            ("phases", torch.arange(P, dtype=values.dtype, device=values.device) / (P if periodic else P - 1)),
        ):
            self.register_buffer(name, owned(tensor), persistent=False)
        self.n_demonstrations, self.n_phases = N, P

    def forward(self, apart: Tensor, velocity: Tensor, known: Tensor, strength: Tensor) -> tuple[Tensor, Tensor]:
        """Logarithms [R, N, 2 P] of what going and standing make of R samples, up to a constant, see `PhaseBank`; and
        squared distances of values alone, [R, N, P], mean over sensors, 1 for what is usual.

        Args:
            apart: [R, S, w], values less `middle`, units of the DoFs; 0 where there are none.
            velocity: [R, S, w], units of the DoFs a second; 0 where there is none.
            known: [2, R, S, w], 1 where there is a value, and a velocity; otherwise 0.
            strength: [2], what distances of values and velocities count.
        """
        R, S, _ = apart.shape
        known = known * (self.precision > 0).unsqueeze(1)
        # Squares of what is absurd would be infinite, and their differences nothing.
        apart, velocity = (part.clamp(-far, far) for part, far in zip((apart, velocity), self.farthest, strict=True))
        shares = known / known.sum(-1, keepdim=True).clamp(min=1)
        w, v = (self.precision.unsqueeze(1) * (strength[:, None, None, None] * shares)).unbind()
        wx, vu, none = w * apart, v * velocity, torch.zeros_like(w)
        rows = torch.stack([w, -2 * wx, none, none, none, none, v, none, none, none, none, vu], -2)
        rows = rows.view(R, S, 3, -1).transpose(0, 1).reshape(S, 3 * R, -1)
        near, square, along = torch.bmm(rows, self.blocks).view(S, R, 3, -1).unbind(2)  # [S, R, N P]
        own = torch.stack([wx * apart, vu * velocity]).sum(-1).transpose(1, 2).unsqueeze(-1)  # [2, S, R, 1]
        caps = CAP * strength
        least = torch.finfo(apart.dtype).tiny
        rate = (along.sum(0) / square.sum(0).clamp(min=least)).clamp(RATES[0], RATES[-1])
        moved = own[1] + rate * torch.addcmul(-2 * along, rate, square)
        where = torch.minimum(own[0] + near, caps[0]).sum(0)
        going = where + torch.minimum(moved, caps[1]).sum(0)
        standing = where + torch.minimum(own[1], caps[1]).sum(0)
        shape = R, self.n_demonstrations, self.n_phases
        log = -0.5 * torch.cat([going.view(shape), standing.view(shape)], -1)
        sensors = shares[0].any(-1).sum(-1).clamp(min=1)  # [R], that say something
        return log, (where / strength[0]).view(shape) / sensors[:, None, None]

    def extra_repr(self) -> str:
        """Sizes."""
        count = int((self.precision[0] > 0).sum())
        return f"{self.n_demonstrations} demonstrations, {self.n_phases} phases, {count} DoFs"


def likeness_of(primitive: InteractionPrimitive, phases: int, most: int) -> tuple[Likeness, Tensor]:
    """Of the demonstrations of a primitive that differ most, and which these are, int64 [N].

    Args:
        primitive: of the demonstrations.
        phases: P, evenly from 0 to 1, which on a circle is 0 again.
        most: N at most.

    Raises:
        ValueError: no sensor moves.
    """
    periodic = primitive.periodic
    table = DemonstrationTable.of(primitive, phases + periodic)
    layout = primitive.layout
    dofs = (~layout.controlled).nonzero().squeeze(-1).to(primitive.weights.device)
    values = table.values[:, :phases, dofs]
    velocities = table.slopes[:, :phases, dofs] * primitive.phase_velocity[:, None, None]
    spread = values.flatten(0, 1).std(0)
    moves = spread > STILL * values.abs().amax((0, 1))
    if not bool(moves.any()):
        raise ValueError("a phase bank compares sensors that move: in these demonstrations none does")
    dofs, values, velocities, spread = dofs[moves], values[..., moves], velocities[..., moves], spread[moves]
    sensors = layout.modality_of_dof.to(dofs.device)[dofs]
    _, sensors = torch.unique(sensors, return_inverse=True)
    error = _usual(values / spread, velocities / spread) * spread.square()
    noise = primitive.residual_variance.to(dofs.device)[dofs]
    samples = max(SLOPE_WINDOW * primitive.rate, 1.0)
    error = error + torch.stack([noise / samples, 2 * noise / samples / SLOPE_WINDOW**2])
    which = _spread_out(values / spread, most)
    return Likeness(values[which], velocities[which], error, dofs, sensors, periodic), which


def _usual(values: Tensor, velocities: Tensor) -> Tensor:
    """[2, k], mean squared differences from the nearest other demonstration at the same phase, [N, P, k] each."""
    N, P, k = values.shape
    if N < 2:
        return values.new_full((2, k), 0.1)
    by_phase, changes = values.transpose(0, 1), velocities.transpose(0, 1)
    distance = torch.cdist(by_phase, by_phase)  # [P, N, N]
    distance.diagonal(dim1=1, dim2=2).fill_(torch.inf)
    nearest = distance.argmin(-1)[..., None].expand(P, N, k)
    pairs = ((part - part.gather(1, nearest)).square().mean((0, 1)) for part in (by_phase, changes))
    return torch.stack(list(pairs)).clamp(min=1e-6)


def _spread_out(values: Tensor, most: int) -> Tensor:
    """int64 [N'], of demonstrations [N, P, k] those that lie apart, each the farthest from all before it."""
    flat = values.flatten(1)
    if len(flat) <= most:
        return torch.arange(len(flat), device=flat.device)
    chosen = [int((flat - flat.mean(0)).square().sum(-1).argmin())]
    far = (flat - flat[chosen[0]]).square().sum(-1)
    while len(chosen) < most:
        chosen.append(int(far.argmax()))
        far = torch.minimum(far, (flat - flat[chosen[-1]]).square().sum(-1))
    return torch.tensor(sorted(chosen), device=flat.device)
