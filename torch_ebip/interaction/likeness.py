"""How like the present is to demonstrations at phases: distances of values and velocities, sensor by sensor.

What counts as near is told by the demonstrations: each differs from the nearest other one at the same phase by so
much, and a person who was never seen will too.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.table import DemonstrationTable

CAP = 16.0
"""Largest squared distance of a sensor, in units of what is usual: more is a sensor that lies, or a stranger."""
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
    """

    values: Tensor
    blocks: Tensor
    precision: Tensor
    middle: Tensor
    dofs: Tensor
    place: Tensor
    counted: Tensor
    phases: Tensor

    def __init__(
        self, values: Tensor, velocities: Tensor, error: Tensor, dofs: Tensor, sensor_of_dof: Tensor
    ) -> None:
        super().__init__()
        N, P, k = values.shape
        if velocities.shape != values.shape or error.shape != (2, k) or len(dofs) != k or len(sensor_of_dof) != k:
            raise ValueError(
                "values, velocities, error, dofs and sensor_of_dof must be [N, P, k] twice, [2, k] and [k] twice, "
                f"got {list(values.shape)}, {list(velocities.shape)}, {list(error.shape)}, {len(dofs)}, "
                f"{len(sensor_of_dof)}"
            )
        sensors = torch.nn.functional.one_hot(sensor_of_dof).to(values)  # [k, S]
        widest = int(sensors.sum(0).max())
        # Of each DoF its place in its sensor, so that all sensors are one product.
        within = (sensors.cumsum(0) * sensors).sum(-1).long() - 1
        place = sensor_of_dof * widest + within
        # Products are formed of deviations, never of values whose mean cancels only in exact arithmetic.
        middle = values.mean((0, 1))
        apart = values - middle
        parts = torch.stack([apart.square(), apart, velocities.square(), velocities], -1)  # [N, P, k, 4]
        blocks = values.new_zeros(N, P, sensors.shape[1] * widest, 4)
        blocks[:, :, place] = parts
        blocks = blocks.view(N * P, sensors.shape[1], widest * 4).permute(1, 2, 0).contiguous()  # [S, 4 w, N P]
        for name, tensor in (
            ("blocks", blocks),
            ("precision", 1 / error),
            ("middle", middle),
            ("dofs", dofs),
            ("place", place),
            ("counted", sensors),
            ("phases", torch.linspace(0, 1, P, dtype=values.dtype, device=values.device)),
        ):
            self.register_buffer(name, owned(tensor), persistent=False)
        self.n_demonstrations, self.n_phases, self._widest = N, P, widest

    def forward(
        self,
        value: Tensor,
        velocity: Tensor,
        there: Tensor,
        moves: Tensor,
        by_value: Tensor,
        by_velocity: Tensor,
        rates: tuple[float, float],
    ) -> Tensor:
        """Logarithms [..., 2, N, P] of what going and standing make of a sample, up to a constant; see `PhaseBank`.

        Args:
            value: [..., D], units of the DoFs.
            velocity: [..., D], units of the DoFs a second.
            there, moves: bool [..., D], where there is a value, and a velocity.
            by_value, by_velocity: scalars, what each distance counts.
            rates: least and largest of a person who goes.
        """
        batch, dofs = value.shape[:-1], self.dofs
        parts = (part.reshape(-1, part.shape[-1])[:, dofs] for part in (value, velocity, there, moves))
        x, u, here, going = parts
        x = torch.where(here, x - self.middle, 0)
        shares = torch.stack([here, going]).to(x)  # [2, R, k]
        counted = shares @ self.counted @ self.counted.T  # how many of its sensor
        weight = self.precision.unsqueeze(1) * shares / counted.clamp(min=1)
        w, v = weight.unbind()
        none = torch.zeros_like(w)
        rows = torch.stack([w, -2 * w * x, none, none, none, none, v, none, none, none, none, v * u], -1)
        R = len(x)
        S, F, NP = self.blocks.shape
        placed = x.new_zeros(R, S * self._widest, 12)
        placed[:, self.place] = rows
        placed = placed.view(R, S, self._widest, 3, 4).permute(1, 0, 3, 2, 4).reshape(S, 3 * R, F)
        products = torch.bmm(placed, self.blocks).view(S, R, 3, NP)
        own = torch.stack([w * x * x, v * u * u]) @ self.counted  # [2, R, S]
        near, still = own.transpose(1, 2).unsqueeze(-1)  # [S, R, 1]
        near = near + products[:, :, 0]
        square, along = products[:, :, 1], products[:, :, 2]
        least = torch.finfo(x.dtype).tiny
        rate = (along.sum(0) / square.sum(0).clamp(min=least)).clamp(*rates)
        moved = still + rate * (rate * square - 2 * along)
        where = by_value * near.clamp(max=CAP).sum(0)
        both = [by_velocity * moved.clamp(max=CAP).sum(0), (by_velocity * still.clamp(max=CAP).sum(0)).expand(R, NP)]
        log = -0.5 * (where.unsqueeze(1) + torch.stack(both, 1))
        both_modes: Tensor = log.view(*batch, 2, self.n_demonstrations, self.n_phases)
        return both_modes

    def extra_repr(self) -> str:
        """Sizes."""
        return f"{self.n_demonstrations} demonstrations, {self.n_phases} phases, {len(self.dofs)} DoFs"


def likeness_of(primitive: InteractionPrimitive, phases: int, most: int) -> tuple[Likeness, Tensor]:
    """Of the demonstrations of a primitive that differ most, and which these are, int64 [N].

    Args:
        primitive: of the demonstrations.
        phases: P, evenly from 0 to 1.
        most: N at most.
    """
    table = DemonstrationTable.of(primitive, phases)
    layout = primitive.layout
    dofs = (~layout.controlled).nonzero().squeeze(-1).to(primitive.weights.device)
    values = table.values[..., dofs]
    velocities = table.slopes[..., dofs] * primitive.phase_velocity[:, None, None]
    spread = values.flatten(0, 1).std(0)
    moves = spread > 0
    dofs, values, velocities, spread = dofs[moves], values[..., moves], velocities[..., moves], spread[moves]
    sensors = layout.modality_of_dof.to(dofs.device)[dofs]
    _, sensors = torch.unique(sensors, return_inverse=True)
    error = _usual(values / spread, velocities / spread) * spread.square()
    noise = primitive.residual_variance.to(dofs.device)[dofs]
    samples = max(SLOPE_WINDOW * primitive.rate, 1.0)
    error = error + torch.stack([noise / samples, 2 * noise / samples / SLOPE_WINDOW**2])
    which = _spread_out(values / spread, most)
    return Likeness(values[which], velocities[which], error, dofs, sensors), which


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
