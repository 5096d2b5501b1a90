"""The live path of an ensemble filter: in place and without gradients, for a robot's control loop.

It gives the same numbers as `Filter.predict` and `Filter.update` for the same draws, faster: see
`torch_ebip.filtering.carriers.span`.
"""

from __future__ import annotations

import math
from collections import OrderedDict
from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.common.arguments import as_mask, as_number, as_values
from torch_ebip.common.brief import brief
from torch_ebip.common.draws import Generators, set_states, states_of
from torch_ebip.filtering.carriers.checks import measured_dofs
from torch_ebip.filtering.carriers.plan import kept
from torch_ebip.filtering.carriers.span import SpanCarrier
from torch_ebip.filtering.states import EnsembleState, Memory
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.interaction.forecast import Forecast, Phases
from torch_ebip.interaction.pace.waiting import Waits


class LiveSnapshot(NamedTuple):
    """What `LiveFilter.save` keeps.

    Attributes:
        matrix: the members, [..., m, E], as `SpanCarrier` has them.
        memory: what the update's parts remember; never changed in place.
        generators: their states, uint8 [bytes] each.
    """

    matrix: Tensor
    memory: Memory
    generators: list[Tensor]

    def __repr__(self) -> str:
        return brief(self)


class LiveFilter:
    """An ensemble filter at work on one interaction, or on a batch of them in step.

    Its state is its own and changes with `predict` and `update`; `state` gives a copy that the filter understands.
    What depends on parameters is computed again when one of them has changed; of a change through ``.data`` torch
    keeps no record, and a part of the filter that is exchanged is not looked for: make a new one.

    Args:
        filter: made by `ebip` or `ebip_minus`.
        dofs: bool [D], those that may be measured; default: all. The fewer, the faster.
        batch_shape: leading dimensions, at most one.
        demonstrations: int64 [..., E], which form the ensemble; default: see the filter's prior.
        generator: of all draws.
        state: where to start, batch dimensions ``batch_shape``; default: the filter's initial state.
        members: int64 [..., E], the old name of ``demonstrations``.

    Raises:
        ValueError: a filter whose updates are no transform of its members (process noise on weights,
            localisation); no DoF that may be measured; more than one batch dimension.

    Example:
        >>> import torch
        >>> from torch_ebip import Demonstrations, InteractionPrimitive, Layout, LiveFilter, Modality, ebip
        >>> layout = Layout([Modality("hand", ["x"], "m"), Modality("robot", ["q"], "rad", controlled=True)])
        >>> shown = Demonstrations(layout, [torch.rand(50, 2).cumsum(0) for _ in range(5)], rate=50.0)
        >>> live = LiveFilter(ebip(InteractionPrimitive.fit(shown)))
        >>> likelihood = live.update([0.5, float("nan")])
        >>> live.predict(0.02)
        >>> live.forecast(1.0).mean.shape
        torch.Size([1, 2])
    """

    @in_own_modes
    @torch.no_grad()
    def __init__(
        self,
        filter: InteractionEnsembleFilter,
        dofs: Tensor | None = None,
        batch_shape: tuple[int, ...] = (),
        demonstrations: Tensor | None = None,
        generator: Generators = None,
        state: EnsembleState | None = None,
        *,
        members: Tensor | None = None,
    ) -> None:
        if len(batch_shape) > 1:
            raise ValueError(f"a live filter has at most one batch dimension, got {list(batch_shape)}")
        if isinstance(generator, Sequence) and (not batch_shape or len(generator) != batch_shape[0]):
            raise ValueError(f"{len(generator)} generators for a batch {list(batch_shape)}: needs one for each entry")
        dofs = as_mask("dofs", [True] * filter.n_dofs if dofs is None else dofs, filter.n_dofs)
        if not bool(dofs.any()):
            raise ValueError(f"dofs must be bool [{filter.n_dofs}], some of them True: none may be measured")
        if state is None:
            state = filter.initial_state(batch_shape, demonstrations, generator, members=members)
        self.filter, self.generator, self.batch_shape = filter, generator, batch_shape
        first = None if filter.analysis.pace is None else filter.first(state)
        self.carrier = SpanCarrier(filter.model, filter.analysis, dofs, state, generator, first)
        self._like, self._dt, self._n_dofs = self.carrier.matrix, filter.dt, filter.n_dofs
        self._forecasters: OrderedDict[tuple[bool, ...], tuple[InteractionEnsembleFilter, Tensor, Tensor | None]] = (
            OrderedDict()
        )

    @property
    @in_own_modes
    def state(self) -> EnsembleState:
        """A copy of everything, for `filter`."""
        return self.carrier.state()

    @in_own_modes
    def entry(self, index: int | None) -> EnsembleState:
        """The state of one entry of the batch, without that dimension; of all for None."""
        return self.carrier.state(entry=index)

    @property
    @in_own_modes
    def phase(self) -> Tensor:
        """Mean phase [...]."""
        return self.carrier.mean[..., 0]

    @property
    @in_own_modes
    def phase_velocity(self) -> Tensor:
        """Mean phase velocity [...], 1/s."""
        return self.filter.phase_model.velocity(self.carrier.mean)

    @property
    def finite(self) -> bool:
        """Whether members and weights are, and small enough for their variance to be."""
        return self.carrier.finite

    @in_own_modes
    @torch.no_grad()
    def save(self, into: LiveSnapshot | None = None) -> LiveSnapshot:
        """Everything that `predict` and `update` change, the generators' states included, for `load`.

        Args:
            into: an older snapshot of this filter, whose memory is used again.
        """
        matrix = self.carrier.matrix.clone() if into is None else into.matrix.copy_(self.carrier.matrix)
        return LiveSnapshot(matrix, self.carrier.memory, states_of(self.generator))

    @in_own_modes
    @torch.no_grad()
    def load(self, snapshot: LiveSnapshot) -> None:
        """Go back to a snapshot of this filter: what follows gives the same numbers again, to the bit.

        Draws too, if the filter has a generator; torch's global one is not turned back.
        """
        self.carrier.restore(snapshot.matrix, snapshot.memory)
        set_states(self.generator, snapshot.generators)

    @in_own_modes
    @torch.no_grad()
    def forecast(
        self, phase: Phases | None = None, dofs: Tensor | None = None, *, ahead: Phases | None = None
    ) -> Forecast:
        """See `InteractionFilter.forecast`; of some DoFs only, bool [D], if given, which costs less than all.

        Args:
            phase: [P] or one number; default: 50 phases evenly from the current one to 1.
            dofs: bool [D].
            ahead: seconds, [P] or one number, instead of phases.
        """
        D = self.filter.n_dofs
        chosen = (True,) * D if dofs is None else tuple(as_mask("dofs", dofs, D).tolist())
        part, columns, asked = kept(self._forecasters, chosen, self._make_forecaster)
        forecast = part.forecast(self.carrier.state(columns), phase, ahead=ahead)
        return forecast if asked is None else forecast.select(asked)

    @in_own_modes
    @torch.no_grad()
    def recognise(self) -> dict[str, Tensor]:
        """See `InteractionFilter.recognise`; nothing that sensors do not see is brought up to date for it."""
        return self.filter.recognised(self.carrier.memory, self.phase)

    @property
    @in_own_modes
    @torch.no_grad()
    def familiarity(self) -> Tensor:
        """[...], in [0, 1], how usual the largest surprise so far is; NaN where that was not calibrated."""
        surprise, felt = self.filter.surprise, self.carrier.memory.surprise
        if surprise is None or felt is None:
            return self.phase * torch.nan
        return surprise.familiarity(felt)

    @property
    @in_own_modes
    @torch.no_grad()
    def waits(self) -> Waits | None:
        """Whether the person stands still; None where nobody looks."""
        return self.filter.waits(self.carrier)

    @property
    def counts(self) -> Tensor | None:
        """[..., S], in [0, 1], what each sensor counts, 0 if it is rejected; None where nobody judges."""
        felt = self.carrier.memory.surprise
        return None if felt is None else felt.counts

    @in_own_modes
    @torch.no_grad()
    def project(self, dofs: tuple[bool, ...]) -> Tensor:
        """[..., D_chosen], mean of h(x) of some of the sensors' DoFs, a bool for each DoF of the filter."""
        return self.carrier.project(dofs)

    @in_own_modes
    @torch.no_grad()
    def predict(self, dt: float | None = None) -> None:
        """Propagate by dt seconds; default: the time between samples of the demonstrations.

        Raises:
            ValueError: a dt that is negative, NaN or infinite.
        """
        dt = self._dt if dt is None else dt
        if not (type(dt) is float and 0 <= dt < math.inf):  # most of all calls
            dt = as_number("dt", dt, 0, of="of seconds")
        self.carrier.predict(dt)

    @torch.no_grad()
    def update(self, y: Any, observed: Tensor | None = None) -> Tensor:
        """Take in one sample.

        Args:
            y: [..., D] in units of the DoFs: a tensor in the filter's dtype, an array or a list.
            observed: bool [..., D]; default: where y is not NaN.

        Returns:
            Log-likelihood [...] of the sample; 0 where nothing was measured, which changes nothing.

        Raises:
            ValueError: wrong shapes; infinity, or NaN where observed; a DoF that is none of the sensors'; an
                innovation covariance that cannot be factored. The state is then as before, but for the draws made.
        """
        if not isinstance(y, Tensor):
            y = as_values("y", y, self.filter.dof_names, self._like)
        if observed is not None and not isinstance(observed, Tensor):
            observed = torch.as_tensor(observed, device=y.device)
        return self.take(y, *measured_dofs(y, observed, self._like, self.batch_shape, self._n_dofs))

    @in_own_modes
    @torch.no_grad()
    def take(self, y: Tensor, measured: tuple[bool, ...], mask: Tensor | None) -> Tensor:
        """`update` with arguments that were checked.

        Args:
            y: [..., D], units of the DoFs.
            measured: D, which DoFs some entry of the batch measured.
            mask: bool [B, D], which of them each entry did; None if all did.
        """
        return self.carrier.take(y, measured, mask)

    def _make_forecaster(self, chosen: tuple[bool, ...]) -> tuple[InteractionEnsembleFilter, Tensor, Tensor | None]:
        """A filter of the DoFs that must be forecast, which weights it needs, and which DoFs were asked for of it."""
        asked = dofs = torch.tensor(chosen, device="cpu")
        readout = self.filter.readout
        if isinstance(readout, AnalogueReadout):
            dofs = readout.together(dofs)
        m = self.filter.phase_model.moving
        columns = self.filter.model.view(dofs).state[m:] - m
        part = self.filter if bool(dofs.all()) else self.filter.restrict(dofs)
        return part, columns, None if torch.equal(asked, dofs) else asked[dofs]

    def __repr__(self) -> str:
        return f"LiveFilter({type(self.filter).__name__}, E={self._like.shape[-1]}, batch {list(self.batch_shape)})"
