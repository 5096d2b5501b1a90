"""A read-out that bends: what came of analogues, corrected by the filter's forecast; as wide as both turn out to err.

Two voices that err differently say more together than the better one (Wolpert 1992; Breiman's stacking, 1996). What
one says of a DoF tells of others, too: where the filter sees the elbow elsewhere than analogues do, the wrist will be
elsewhere. So the correction is a matrix over the DoFs of a modality (Breiman & Friedman 1997), for each horizon, and
the same whatever sensors there are: what those tell is in the weights of analogues and in the filter's gain already.
Where a DoF is seen the filter knows of the next moment what no demonstration does, and where it is not, little: so it
is followed by how sure it is, as a share of how far demonstrations lie apart.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.expert import Expert
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.horizons import SECONDS, horizon_hats, level_hats
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import Lead, increasing, moved, root, surer, widths_of

VOICES = ("filter", "analogues", "mean")


class AnalogueReadout(nn.Module):
    """Mean g = h + sum_j B_j l_j (f - h) + C (h - m), deviation (a sigma_f + b sigma_h + c sigma_m) sum_j t_j l_j.

    All by horizon. With an expert, which says e, g becomes g + sum_j v_j l_j (e - g), as far as the expert believes
    what it reads. And where the filter is surer than it ever was when all of this was learned, of thinned recordings,
    it is followed the more: the mean is g + s (f - g), s = 1 - (sigma_f / (r sigma_m))^2, 0 from r on.

    l_j are the weights of J levels of sigma_f / sigma_m, DoF by DoF, that sum to 1, see `level_hats`. h is the
    forecast of analogues, a weighted mean of demonstrations, f the filter's, m the mean of all demonstrations; sigma
    are their deviations. The filter's members keep their order and their weights: they are moved with the mean and
    stretched with the deviation.

    Args:
        analogues: over the same layout.
        follow: [K, D, J D], B_1 to B_J side by side, at the seconds. A DoF that nobody fitted has a row of the
            identity in each: the filter alone.
        correct: [K, D, D], C; units of the row's DoF per unit of the column's, as B.
        width: [K, D, 3], a, b and c, not negative and above 0 together.
        seconds: [K] increasing; between them all are linear, before the first and behind the last as there.
            Infinity, the last, is the end.
        levels: [J] increasing, of sigma_f / sigma_m; as the seconds. Default: one, B alike for all.
        expert: see `Expert`; default: none.
        heed: [K, D, J], v, between 0 and 1, if there is an expert; 0 for DoFs of which it says nothing.
        surest: [K, D], r, not negative, the least sigma_f / sigma_m that was learned from; default: 0, that is s = 0.
        stretch: [K, D, J], t, positive: one that knows little errs more than its voices say. Default: 1.

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite, negative widths, shares outside [0, 1],
            seconds or levels that do not increase; an expert without a share, or a share without an expert.

    Example:
        >>> import torch
        >>> from torch_ebip import InteractionPrimitive
        >>> from torch_ebip.interaction.analogue_readout import AnalogueReadout
        >>> from torch_ebip.interaction.analogues import Analogues
        >>> from torch_ebip.recordings import example
        >>> primitive = InteractionPrimitive.fit(example())
        >>> half = 0.5 * torch.eye(primitive.layout.n_dofs).expand(5, -1, -1)
        >>> AnalogueReadout(Analogues.of(primitive), half, 0 * half, torch.ones(5, primitive.layout.n_dofs, 3) / 2)
        AnalogueReadout(
          11 DoFs, 5 horizons, 1 levels, follows the filter by 0.5
          (analogues): Analogues(
            30 demonstrations, 41 phases, compares 5 DoFs
            (table): DemonstrationTable(30 demonstrations, 41 phases, 11 DoFs)
            (relevance): Positive([2, 5], floor=1e-06)
            (tilt): Signed()
            (memory): Positive([], floor=1e-06)
            (looseness): Positive([], floor=1e-06)
          )
        )
    """

    reads_present = True
    follow: Tensor
    correct: Tensor
    width: Tensor
    surest: Tensor
    stretch: Tensor
    seconds: Tensor
    levels: Tensor
    heed: Tensor | None

    def __init__(
        self,
        analogues: Analogues,
        follow: Tensor,
        correct: Tensor,
        width: Tensor,
        seconds: Sequence[float] = SECONDS,
        levels: Sequence[float] = (1.0,),
        expert: Expert | None = None,
        heed: Tensor | None = None,
        surest: Tensor | None = None,
        stretch: Tensor | None = None,
    ) -> None:
        super().__init__()
        places, widths = increasing("seconds", seconds, follow), increasing("levels", levels, follow)
        K, J, D = len(places), len(widths), analogues.table.n_dofs
        for name, values, shape in (
            ("follow", follow, (K, D, J * D)),
            ("correct", correct, (K, D, D)),
            ("width", width, (K, D, len(VOICES))),
        ):
            if values.shape != shape or not bool(values.isfinite().all()):
                raise ValueError(f"{name} must be {list(shape)} and finite, got {list(values.shape)}")
        if not bool((width >= 0).all() & (width.sum(-1) > 0).all()):
            raise ValueError(f"width must not be negative, and above 0 together, got {float(width.min()):g}")
        stretch = width.new_ones(K, D, J) if stretch is None else stretch
        if stretch.shape != (K, D, J) or not bool((stretch > 0).all() & stretch.isfinite().all()):
            raise ValueError(f"stretch must be {[K, D, J]} and positive, got {list(stretch.shape)}")
        surest = width.new_zeros(K, D) if surest is None else surest
        if surest.shape != (K, D) or not bool((surest >= 0).all() & surest.isfinite().all()):
            raise ValueError(f"surest must be {[K, D]} and not negative, got {list(surest.shape)}")
        if (expert is None) != (heed is None):
            raise ValueError("an expert and its shares, heed, come together")
        if heed is not None and (heed.shape != (K, D, J) or not bool(((heed >= 0) & (heed <= 1)).all())):
            raise ValueError(f"heed must be {[K, D, J]} between 0 and 1, got {list(heed.shape)}")
        self.analogues, self.expert = analogues, expert
        self.register_buffer("heed", None if heed is None else owned(heed))
        self.register_buffer("follow", owned(follow))
        self.register_buffer("correct", owned(correct))
        self.register_buffer("width", owned(width))
        self.register_buffer("surest", owned(surest))
        self.register_buffer("stretch", owned(stretch))
        self.register_buffer("seconds", owned(places))
        self.register_buffer("levels", owned(widths))

    def forward(
        self, forecast: Forecast, lead: Lead, mean: Tensor, variance: Tensor, present: Present | None = None
    ) -> Forecast:
        """Put a forecast together with that of analogues.

        Args:
            forecast: of the filter, mean [..., P, D].
            lead: of it, how far ahead it is.
            mean: [..., P, D], of the demonstrations at the phases of the forecast, units of the DoFs.
            variance: [..., P, D], of the demonstrations there, squared units.
            present: of the state that the forecast is of.

        Raises:
            ValueError: nobody says what the present is.
        """
        if present is None:
            raise ValueError("a read-out with analogues compares the present: it needs to be told")
        theirs, spread = self.analogues.forecast(self.analogues(present), lead)
        at = horizon_hats(lead, self.seconds)  # [..., P, K]
        widths, apart = widths_of(forecast, variance), forecast.mean - theirs
        level = level_hats(widths, self.levels)  # [..., P, D, J]
        followed = (apart.unsqueeze(-2) * level.transpose(-1, -2)).flatten(-2)
        both = torch.cat([followed, theirs - mean], -1)
        D = self.width.shape[1]
        every = (both @ torch.cat([self.follow, self.correct], -1).flatten(0, 1).T).view(*at.shape, D)
        stacked = theirs + (at.unsqueeze(-2) @ every).squeeze(-2)
        # Of all that is linear between horizons, one product: a forecast is a matter of how many operations it takes.
        kept = [self.width, self.surest.unsqueeze(-1), self.stretch] + ([] if self.heed is None else [self.heed])
        n, J = sum(each.shape[-1] for each in kept), len(self.levels)
        here = (at @ torch.cat(kept, -1).flatten(1)).view(*at.shape[:-1], D, n)
        V = len(VOICES)
        width, surest, stretch = here[..., :V], here[..., V], (here[..., V + 1 : V + 1 + J] * level).sum(-1)
        if self.expert is not None:
            share = (here[..., V + 1 + J :] * level).sum(-1)
            share = share * self.expert.believed(self.expert.before(present))[..., None, None]
            stacked = torch.lerp(stacked, self.expert(present, lead), share)
        stacked = torch.lerp(stacked, forecast.mean, surer(widths, surest))
        of_each = torch.stack([widths.own, root(spread), widths.demonstrated], -1)
        deviation = (width * of_each).sum(-1) * stretch
        return moved(forecast, stacked, deviation, torch.ones_like(deviation), widths)

    def together(self, dofs: Tensor) -> Tensor:
        """Those that must be forecast for some DoFs, bool [D], to be: what they are corrected by is among them."""
        follow = (self._by_level != 0).any(-2)
        coupled = (follow | (self.correct != 0)).any(0).to(dofs.device)
        while bool((coupled[dofs].any(0) & ~dofs).any()):  # and what those are corrected by
            dofs = dofs | coupled[dofs].any(0)
        return dofs

    def select(self, view: View) -> AnalogueReadout:
        """The same for a view of the model: of its DoFs.

        Raises:
            ValueError: a view that cuts through DoFs that are forecast together.
        """
        dofs = view.dofs.to(self.follow.device)
        kept = torch.zeros(self.follow.shape[-2], dtype=torch.bool, device=dofs.device)
        kept[dofs] = True
        missing = self.together(kept) & ~kept
        if bool(missing.any()):
            raise ValueError(
                f"DoFs {missing.nonzero().squeeze(-1).tolist()} are forecast together with some of "
                f"{dofs.tolist()}: keep all of them, or none"
            )
        part = sharing(self)
        part.analogues = self.analogues.select(view)
        part.register_buffer("follow", self._by_level[:, dofs][..., dofs].flatten(-2))
        part.register_buffer("correct", self.correct[:, dofs][:, :, dofs])
        part.register_buffer("width", self.width[:, dofs])
        part.register_buffer("surest", self.surest[:, dofs])
        part.register_buffer("stretch", self.stretch[:, dofs])
        if self.expert is not None and self.heed is not None:
            part.expert = self.expert.select(view)
            part.register_buffer("heed", self.heed[:, dofs])
        return part

    def extra_repr(self) -> str:
        """Sizes, and the mean of B's diagonal."""
        K, D, _ = self.width.shape
        followed = float(self._by_level.diagonal(0, 1, 3).mean())
        heeded = "" if self.heed is None else f", an expert by {float(self.heed.mean()):.2g}"
        return f"{D} DoFs, {K} horizons, {len(self.levels)} levels, follows the filter by {followed:.2g}{heeded}"

    @property
    def _by_level(self) -> Tensor:
        """`follow` as [K, D, J, D]."""
        K, D, _ = self.width.shape
        return self.follow.view(K, D, len(self.levels), D)

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""
