"""The ball by physics: least squares of the flight so far, extrapolated to where balls are caught."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from experiments.baselines.common import ends, point_answer, until
from experiments.evaluate import END, Answer
from torch_ebip import Demonstrations

GRAVITY = 9.81
"""m/s^2, downwards along the ball's third axis."""
ROUNDS = 3
"""Of the fit with drag: each takes the velocities of the one before. Drag is a small share of gravity here."""
HORIZON = 1.5
"""s after the last sample within which a catch is looked for."""


class _Surface(NamedTuple):
    """Where balls are caught: direction . p = offset + slope . (side, height), a plane met almost head-on.

    `direction` and `side` are horizontal unit vectors [2], the mean throwing direction and its left; `offset` is in
    m, `slope` [2] in m/m.
    """

    direction: Tensor
    side: Tensor
    offset: Tensor
    slope: Tensor

    def ahead(self, p: Tensor) -> Tensor:
        """[...]: metres from p [..., 3] to the surface along the throw; negative behind it."""
        across = torch.stack([p[..., :2] @ self.side, p[..., 2]], -1)
        return self.offset + across @ self.slope - p[..., :2] @ self.direction


class BallisticMethod:
    """Extrapolates the visible flight under gravity and quadratic air drag; knows nothing of the other sensors.

    Position and velocity of each throw are fitted to what is seen of it by least squares. From the training part
    come one drag coefficient for all balls and, as nobody says when a ball will be caught, the surface where it will
    be: the plane that fits the training ends, or without `tilted` the vertical plane through their mean.

    Args:
        demonstrations: of the training part; positions in m, the third axis upwards.
        modality: of the ball's 3 DoFs.
        drag: whether to fit the drag coefficient; 0 otherwise.
        tilted: whether the surface may be inclined to the throwing direction.
        least: samples of a ball without which nothing is said of it; at least 2.

    Raises:
        ValueError: no such modality, not of 3 DoFs, or no two training flights to learn from.
    """

    def __init__(
        self,
        demonstrations: Demonstrations,
        modality: str = "ball",
        drag: bool = True,
        tilted: bool = True,
        least: int = 5,
    ) -> None:
        self.columns = demonstrations.layout.slice(modality)
        if self.columns.stop - self.columns.start != 3:
            raise ValueError(f"{modality} has {self.columns.stop - self.columns.start} DoFs, a position has 3")
        self.rate, self.least = demonstrations.rate, least
        paths = [trajectory[:, self.columns].double() for trajectory in demonstrations]
        landed = ends(demonstrations)[:, self.columns].double()
        seen = [~path.isnan().any(-1) for path in paths]
        usable = [i for i in range(len(paths)) if int(seen[i].sum()) >= least and not landed[i].isnan().any()]
        if len(usable) < 2:
            raise ValueError(f"{modality} is seen in {len(usable)} flights, at least 2 are needed")
        flights = [(self._times(seen[i]), paths[i][seen[i]]) for i in usable]
        self.drag = _fit_drag(flights) if drag else 0.0
        begun = torch.stack([p[0] for _, p in flights])
        self.surface = _fit_surface(begun, landed[usable], tilted)

    def __call__(
        self, y: Tensor, observed: Tensor, keep: Tensor, dofs: Tensor, ahead: Sequence[float] = END
    ) -> Answer:
        """See `Method`. NaN for all but the catch, the end, and for a ball with fewer than `least` samples seen."""
        mean = y.new_full((*keep.shape, y.shape[-1]), torch.nan)
        for k in range(keep.shape[1]):
            seen = until(observed, keep[:, k])[..., self.columns].all(-1)
            for b in range(len(y)):
                if int(seen[b].sum()) >= self.least:
                    positions = y[b, :, self.columns][seen[b]].double()
                    mean[b, k, self.columns] = self._catch(self._times(seen[b]), positions).to(y)
        ends = torch.tensor(ahead).isinf().unsqueeze(-1)
        return point_answer(torch.where(ends, mean[..., dofs].unsqueeze(2), torch.nan))

    def _times(self, seen: Tensor) -> Tensor:
        """float64 [M], s: when the samples bool [T] were taken, counted from the first that is seen."""
        steps = seen.nonzero().squeeze(-1)
        return (steps - steps[0]).double() / self.rate

    def _catch(self, times: Tensor, positions: Tensor) -> Tensor:
        """[3], m: where the flight seen at times [M] as positions [M, 3] meets the surface."""
        start = _fit_flight(times, positions, self.drag)
        grid = torch.arange(0.0, float(times[-1]) + HORIZON, 1 / 240, dtype=torch.float64)
        path = start[0] + grid.unsqueeze(-1) * start[1] + _double_integral(grid, start, self.drag)
        ahead = self.surface.ahead(path)
        # Only what lies after the last sample is a forecast; a ball that is past the surface is being caught now.
        future = (grid >= times[-1]).nonzero().squeeze(-1)
        crossed = (ahead[future] <= 0).nonzero().squeeze(-1)
        if len(crossed) == 0:
            # Misses the surface: the nearest it comes.
            return path[future[ahead[future].argmin()]]
        i = int(future[crossed[0]])
        if i == int(future[0]):
            return path[i]
        share = ahead[i - 1] / (ahead[i - 1] - ahead[i])
        return path[i - 1] + share * (path[i] - path[i - 1])


def _fit_flight(times: Tensor, positions: Tensor, drag: float) -> Tensor:
    """[2, 3]: position (m) and velocity (m/s) at time 0 that fit positions [M, 3], m, at times [M], s, best."""
    design = torch.stack([torch.ones_like(times), times], -1)
    fall = _double_integral(times, torch.zeros(2, 3).to(positions), 0.0)
    start: Tensor = torch.linalg.lstsq(design, positions - fall).solution
    for _ in range(ROUNDS if drag else 0):
        start = torch.linalg.lstsq(design, positions - _double_integral(times, start, drag)).solution
    return start


def _double_integral(times: Tensor, start: Tensor, drag: float) -> Tensor:
    """[M, 3], m: what acceleration has done to the position by times [M], beside start's position and velocity."""
    half = -0.5 * times.square().unsqueeze(-1) * start.new_tensor([0.0, 0.0, GRAVITY])
    return half - drag * _drag_effect(times, start)


def _drag_effect(times: Tensor, start: Tensor) -> Tensor:
    """[M, 3], m^2: double integral of |v| v along the drag-free flight from start [2, 3], at times [M], s.

    To first order in the drag, which is a small share of gravity for a tossed ball.
    """
    grid = torch.linspace(0.0, max(float(times[-1]), 1e-6), 65, dtype=torch.float64)
    velocity = start[1] - grid.unsqueeze(-1) * start.new_tensor([0.0, 0.0, GRAVITY])
    pull = velocity.norm(dim=-1, keepdim=True) * velocity
    step = grid[1]

    def integral(values: Tensor) -> Tensor:
        steps = 0.5 * step * (values[1:] + values[:-1])
        return torch.cat([steps.new_zeros(1, 3), steps.cumsum(0)])

    twice = integral(integral(pull))
    at = (times / step).clamp(max=64)
    low = at.floor().long().clamp(max=63)
    return torch.lerp(twice[low], twice[low + 1], (at - low).unsqueeze(-1))


def _fit_drag(flights: list[tuple[Tensor, Tensor]]) -> float:
    """The one drag coefficient, 1/m, that explains all flights (times [M], positions [M, 3]) best; never negative."""
    drag = 0.0
    for _ in range(ROUNDS):
        above, below = 0.0, 0.0
        for times, positions in flights:
            start = _fit_flight(times, positions, drag)
            fall = _double_integral(times, torch.zeros(2, 3).to(positions), 0.0)
            effect = -_drag_effect(times, start)
            # Position and velocity are each flight's own: only what they cannot explain counts.
            design = torch.stack([torch.ones_like(times), times], -1)
            project = design @ torch.linalg.pinv(design)
            rest, lever = (part - project @ part for part in (positions - fall, effect))
            above += float((rest * lever).sum())
            below += float(lever.square().sum())
        drag = max(0.0, above / below) if below > 0 else 0.0
    return drag


def _fit_surface(begun: Tensor, landed: Tensor, tilted: bool) -> _Surface:
    """The surface of the catches [N, 3], m, of balls first seen at [N, 3], m."""
    direction = (landed - begun)[:, :2].mean(0)
    direction = direction / direction.norm()
    side = torch.stack([-direction[1], direction[0]])
    along = landed[:, :2] @ direction
    across = torch.stack([landed[:, :2] @ side, landed[:, 2]], -1)
    if not tilted or len(landed) < 10:
        return _Surface(direction, side, along.mean(), torch.zeros(2).to(landed))
    design = torch.cat([torch.ones(len(landed), 1).to(landed), across], -1)
    solution = torch.linalg.lstsq(design, along.unsqueeze(-1)).solution.squeeze(-1)
    return _Surface(direction, side, solution[0], solution[1:])
