"""The interaction primitive: what a set of demonstrations says in the space of basis weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.ambient import in_own_modes, owned
from torch_ebip.common.arguments import as_indices, as_values
from torch_ebip.common.draws import GOLDEN
from torch_ebip.common.meaning import Meaning
from torch_ebip.interaction.basis.regression import measured_variance, regress_all, samples_of
from torch_ebip.interaction.basis.selection import select_basis
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.course import turn_between
from torch_ebip.recordings.demonstrations import Demonstrations
from torch_ebip.recordings.jumps import warn_of_cut_turns
from torch_ebip.recordings.layout import Layout
from torch_ebip.recordings.repeats import longest_repeats

OF_EACH = ("weights", "phase_velocity", "first_phase", "cycles")
"""What a primitive knows of each demonstration."""


class InteractionPrimitive(Meaning):
    """Weights, phase velocities and closed-form noise of N demonstrations; made by `fit`.

    Attributes:
        layout: what the D DoFs are.
        basis: one basis a DoF.
        rate: samples a second of the demonstrations, Hz.
        weights: [N, n_weights], least-squares weights of each demonstration.
        phase_velocity: [N], 1 / duration, 1/s; of those that repeat, cycles a second.
        residual_variance: [D], the paper's closed-form R (Section IV): the mean over demonstrations of each
            one's mean squared residual, in squared units of the DoF.
        residual_correlation_time: [D], integrated autocorrelation time of those residuals, in samples.
        value_variance: [D], variance of each DoF over all measured samples, squared units; 0 for a constant.
        longest_repeat: [M] seconds for which each modality says the same to the last digit; see `longest_repeats`.
        end_variance: [D], variance over demonstrations of h(1, w), of the last value, squared units.
        labels: which interaction each demonstration shows, N names; None where nothing says.
        first_phase: [N], where each demonstration begins: 0; of those that repeat, where on the circle.
        cycles: [N], how often each goes through all phases: 1, unless they repeat.

    Raises:
        ValueError: labels that are not one for each demonstration.
    """

    weights: Tensor
    phase_velocity: Tensor
    residual_variance: Tensor
    residual_correlation_time: Tensor
    value_variance: Tensor
    longest_repeat: Tensor
    first_phase: Tensor
    cycles: Tensor

    def __init__(
        self,
        layout: Layout,
        basis: StackedBasis,
        rate: float,
        weights: Tensor,
        phase_velocity: Tensor,
        residual_variance: Tensor,
        residual_correlation_time: Tensor,
        value_variance: Tensor,
        longest_repeat: Tensor | None = None,
        labels: Sequence[str] | None = None,
        first_phase: Tensor | None = None,
        cycles: Tensor | None = None,
    ) -> None:
        super().__init__()
        if labels is not None and len(labels) != len(weights):
            raise ValueError(f"{len(labels)} labels for {len(weights)} demonstrations")
        self.labels = None if labels is None else tuple(labels)
        self.layout = layout
        self.basis = basis
        self.rate = rate
        self.register_buffer("weights", owned(weights))
        self.register_buffer("phase_velocity", owned(phase_velocity))
        self.register_buffer("residual_variance", owned(residual_variance))
        self.register_buffer("residual_correlation_time", owned(residual_correlation_time))
        self.register_buffer("value_variance", owned(value_variance))
        repeat = weights.new_zeros(len(layout.names)) if longest_repeat is None else longest_repeat
        self.register_buffer("longest_repeat", owned(repeat))
        first_phase = torch.zeros_like(phase_velocity) if first_phase is None else first_phase
        self.register_buffer("first_phase", owned(first_phase))
        self.register_buffer("cycles", owned(torch.ones_like(phase_velocity) if cycles is None else cycles))

    @classmethod
    @in_own_modes
    def fit(
        cls,
        demonstrations: Demonstrations,
        basis: StackedBasis | None = None,
        *,
        periodic: bool = False,
        turned: float = 0.0,
    ) -> InteractionPrimitive:
        """Batched least squares (float64) of all demonstrations and DoFs, tolerant of missing samples.

        Args:
            demonstrations: at least two.
            basis: default: `select_basis(demonstrations)`; a periodic one for interactions that repeat, whose cycles
                are then looked for.
            periodic: whether they repeat; default: as the basis says.
            turned: cycles by which phases on a circle are further on than they are found to be.

        Returns:
            A primitive in the dtype and on the device of the demonstrations.

        Raises:
            ValueError: one demonstration only; a basis for another number of DoFs; a demonstration shorter
                than its basis has functions; a DoF that was never measured; periodic ones that do not repeat.
        """
        if len(demonstrations) < 2:
            raise ValueError("a primitive needs at least 2 demonstrations to have a spread, got 1")
        basis = select_basis(demonstrations, periodic=periodic) if basis is None else basis
        if not isinstance(basis, StackedBasis):
            raise ValueError(f"basis must be a StackedBasis, one basis for each DoF, got {type(basis).__name__}")
        if periodic and not basis.periodic:
            raise ValueError("interactions that repeat need a periodic basis, such as PeriodicBSplineBasis")
        layout = demonstrations.layout
        warn_of_cut_turns(layout, demonstrations.trajectories)
        if basis.n_dofs != layout.n_dofs:
            raise ValueError(f"the basis is for {basis.n_dofs} DoFs, the demonstrations have {layout.n_dofs}")
        largest = max(part.n_features for part in basis.bases)
        for index, trajectory in enumerate(demonstrations):
            if len(trajectory) < largest:
                raise ValueError(
                    f"demonstration {index} has {len(trajectory)} samples, fewer than the {largest} functions "
                    "of the basis"
                )
        samples = samples_of(demonstrations, basis.periodic)
        if basis.periodic:
            first = samples.phase[:, :1] + turned
            samples = samples._replace(phase=samples.phase + turned - first.round())
        resolution = torch.finfo(demonstrations[0].dtype).eps
        weights, variance, correlation = regress_all(basis, samples)
        spread = measured_variance(samples, resolution)
        # A DoF that is fitted exactly would have R = 0, and with it a singular innovation covariance. What floor is
        # small depends on its unit, which its spread tells, its size if it never moves, and nothing if it is 0.
        size = torch.where(samples.observed, samples.values, 0).square().amax((0, 1))
        variance = torch.maximum(variance, torch.where(spread > 0, 1e-10 * spread, 1e-12 * size))
        variance = torch.where(variance > 0, variance, 1e-12)
        dtype = demonstrations[0].dtype
        first, cycles = samples.phase[:, 0], samples.phase[:, -1] - samples.phase[:, 0]
        velocity = cycles / demonstrations.durations.to(weights)
        repeats = longest_repeats(demonstrations).to(weights.device)
        tensors = {
            "weights": weights,
            "phase_velocity": velocity,
            "residual_variance": variance,
            "residual_correlation_time": correlation,
            "value_variance": spread,
            "longest_repeat": repeats,
            "first_phase": first,
            "cycles": cycles,
        }
        made = {name: tensor.to(dtype) for name, tensor in tensors.items()}
        return cls(layout, basis, demonstrations.rate, **made, labels=demonstrations.labels)

    def extra_repr(self) -> str:
        """Sizes, and what the columns are."""
        return f"demonstrations={len(self)}, {self.meant()}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        dofs = zip(self.layout.dofs, self.layout.units, self.layout.controlled.tolist(), strict=True)
        columns = (f"{dof} [{unit}]{' controlled' if controlled else ''}" for dof, unit, controlled in dofs)
        return f"rate={self.rate:.9g}, dofs={', '.join(columns)}"

    def __len__(self) -> int:
        return len(self.weights)

    @property
    def periodic(self) -> bool:
        """Whether the demonstrations repeat: phases are then those of a circle."""
        return self.basis.periodic

    @property
    def durations(self) -> Tensor:
        """[N], s."""
        return self.cycles / self.phase_velocity

    def phase_after(self, time: Tensor, which: Tensor | None = None) -> Tensor:
        """[...], where demonstrations are so long after they began; from their end on, where they end.

        Args:
            time: [...], s; infinity: the end.
            which: int64 [...], which demonstrations; default: all, in the last dimension.
        """
        first, velocity, duration = (
            each if which is None else each[which] for each in (self.first_phase, self.phase_velocity, self.durations)
        )
        return first + velocity * torch.minimum(time, duration)

    @property
    def correlated_residual_variance(self) -> Tensor:
        """[D]: a corrected closed form, `residual_variance` times `residual_correlation_time`.

        The paper takes the residual for white noise; it is misfit of the basis, correlated over many samples,
        so a filter that believes R draws the same information again and again. n samples with integrated
        autocorrelation time tau carry what n / tau independent ones would.
        """
        return self.residual_variance * self.residual_correlation_time

    @property
    def end_variance(self) -> Tensor:
        """[D]: variance over demonstrations of the value at the end."""
        end = self.first_phase + self.cycles
        if self.periodic:  # at different phases, so that the mean differs, too
            return self.basis.project(end, self.weights).var(0)
        return self.basis.project(end, self.weights - self.weights.mean(0)).var(0)

    def extend(self, demonstrations: Demonstrations) -> InteractionPrimitive:
        """The same basis and noise with more demonstrations: at least one, which need no more than a regression.

        Labels are kept where both have them.

        Args:
            demonstrations: in the dtype and on the device of this primitive.

        Raises:
            ValueError: see `fit`.
        """
        more = self.like(demonstrations)
        both = self.labels is not None and demonstrations.labels is not None
        return self._with(
            labels=(*(self.labels or ()), *(demonstrations.labels or ())) if both else None,
            longest_repeat=torch.maximum(self.longest_repeat, more.longest_repeat),
            **{
                name: torch.cat([getattr(self, name), getattr(more, name)[: len(demonstrations)]]) for name in OF_EACH
            },
        )

    def like(self, demonstrations: Demonstrations) -> InteractionPrimitive:
        """Of other demonstrations on the same basis, whose phases mean the same; see `extend` and `fit`."""
        # A primitive is of two at least: of one, the second is the same again.
        several = demonstrations if len(demonstrations) > 1 else demonstrations.subset([0, 0])
        more = InteractionPrimitive.fit(several, self.basis)
        if not self.periodic:
            return more
        # Where a cycle begins is found anew in every set.
        return InteractionPrimitive.fit(
            several, self.basis, turned=turn_between(self.basis, more.weights, self.weights)
        )

    def starting_at(self, phases: Sequence[float] | Tensor) -> InteractionPrimitive:
        """The same demonstrations, as of people who are first seen at one of some phases, each as likely.

        Filters and phase banks of it start there: the demonstrations have the phases in turn, evenly and in no order.

        Args:
            phases: [K], in [0, 1).

        Raises:
            ValueError: none at all, or phases outside [0, 1).

        Example:
            >>> from torch_ebip import InteractionPrimitive
            >>> from torch_ebip.recordings import example
            >>> loose = InteractionPrimitive.fit(example()).starting_at([0.0, 0.25, 0.5])
            >>> sorted(set(loose.first_phase.tolist()))
            [0.0, 0.25, 0.5]
        """
        start = as_values("phases", phases, None, self.weights).to(self.weights)
        if start.ndim != 1 or not len(start) or not bool(((start >= 0) & (start < 1)).all()):
            raise ValueError(f"interactions begin at phases in [0, 1), got {start.tolist()}")
        rank = (torch.arange(len(self), dtype=torch.float64, device=start.device) * GOLDEN % 1).argsort().argsort()
        first = start.sort().values[rank * len(start) // len(self)]
        return self._with(first_phase=first, cycles=self.cycles if self.periodic else 1 - first)

    def _with(self, **others: Any) -> InteractionPrimitive:
        """The same with some other arguments by name."""
        own = dict(self.named_buffers(recurse=False))
        arguments = {"layout": self.layout, "basis": self.basis, "rate": self.rate, "labels": self.labels, **own}
        return InteractionPrimitive(**{**arguments, **others})

    def subset(self, indices: Sequence[int] | Sequence[bool] | Tensor) -> InteractionPrimitive:
        """The same basis and noise with some of the demonstrations: they need no new regression.

        Args:
            indices: [M], which ones, negative ones from the end; or a mask, bool [N].

        Raises:
            ValueError: an index out of range, a mask of another length, fractions.
        """
        indices = as_indices("demonstration", indices, len(self)).to(self.weights.device)
        labels = None if self.labels is None else [self.labels[i] for i in indices.tolist()]
        return self._with(labels=labels, **{name: getattr(self, name)[indices] for name in OF_EACH})
