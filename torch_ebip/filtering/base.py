"""The contract of every filter: predict, update, a whole sequence."""

from __future__ import annotations

import warnings
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Literal, TypeAlias

from torch import Tensor, nn

from torch_ebip.common.ambient import eager
from torch_ebip.common.arguments import as_count, as_seconds, check_clocks
from torch_ebip.common.draws import Generators
from torch_ebip.common.meaning import Meaning
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.checks import as_sample, check_sequence, usable
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.protocols import Narrows, View
from torch_ebip.filtering.sequence import Filtered, filter_step_by_step
from torch_ebip.filtering.states import State
from torch_ebip.filtering.trace import Trace

if TYPE_CHECKING:
    from typing_extensions import Self

EngineName: TypeAlias = Literal["auto", "dense", "span"]
"""Who holds the members: rows that autograd follows, or columns in place; see `torch_ebip.filtering.carriers`."""


class Filter(Meaning, ABC):
    """A Bayesian filter, differentiable in its noise parameters.

    Args:
        model: g, h and their noise.
        prior: where states start.
    """

    _trace: ClassVar[Callable[..., Trace]] = Trace

    def __init__(self, model: StateSpace, prior: nn.Module) -> None:
        super().__init__()
        self.model = model
        self.prior = prior
        self._check()

    def _check(self) -> None:
        """Raise ValueError if model and prior are not what a subclass is for."""

    @property
    def n_dofs(self) -> int:
        """D."""
        return self.model.n_dofs

    @property
    def dof_names(self) -> tuple[str, ...] | None:
        """Of the D DoFs, where the model has them."""
        return self.model.dof_names

    @property
    def dt(self) -> float:
        """dt, seconds between samples where none is given."""
        return self.model.dt

    @property
    def stride(self) -> int:
        """How many samples each one given stands for; see `restrict`."""
        return self.model.stride

    @abstractmethod
    def _start(
        self, batch_shape: tuple[int, ...], chosen: Tensor | None, generator: Generators, known: Tensor | None
    ) -> State:
        """`initial_state` with arguments that were checked."""

    @abstractmethod
    def _predict(self, state: State, dt: Tensor, generator: Generators) -> State:
        """`predict` with dt as a tensor."""

    @abstractmethod
    def _update(self, state: State, y: Tensor, observed: Tensor, generator: Generators) -> tuple[State, Tensor]:
        """`update` with arguments that were checked."""

    @abstractmethod
    def project(self, state: State) -> Tensor:
        """[..., D], mean of h(x), units of the DoFs."""

    @abstractmethod
    def moving(self, state: State) -> Tensor:
        """[..., m], mean of the entries that move: of all, unless the model says that some stand still."""

    def initial_state(
        self,
        batch_shape: tuple[int, ...] = (),
        demonstrations: Tensor | None = None,
        generator: Generators = None,
        *,
        members: Tensor | None = None,
        known: Tensor | None = None,
    ) -> State:
        """The state before any observation.

        Args:
            batch_shape: leading dimensions.
            demonstrations: int64 [..., E], which of the prior's form the ensemble; default: see the prior.
            generator: of the draws.
            members: int64 [..., E], the old name of ``demonstrations``.
            known: bool [..., N], what of the prior a `Pace` may know; default: all, or the demonstrations if given.

        Raises:
            ValueError: a demonstration that there is not, or shapes that do not broadcast.
        """
        if members is not None:
            warnings.warn("initial_state(members=) is now called demonstrations=", DeprecationWarning, stacklevel=2)
            demonstrations = members
        return eager(self._start)(batch_shape, demonstrations, generator, known)

    def restrict(self, dofs: Tensor, stride: int = 1) -> Self:
        """The same filter for some of the DoFs, sharing its parameters: not a copy.

        DoFs that are neither measured nor asked for influence nothing, so leaving out what stands still for them
        alone is exact, and it saves their share of every update.

        Args:
            dofs: bool [D], those to keep.
            stride: use it for sequences of which only every k-th sample is left: each stands for k, so R is
                divided by k, process noise follows, and the time between samples grows with it.

        Raises:
            ValueError: a mask of another length or kind, or no DoF.
            TypeError: a part of the model that cannot be narrowed, or a prior.
        """
        view = self.model.view(dofs, stride)
        if not isinstance(self.prior, Narrows):
            raise TypeError(f"a {type(self.prior).__name__} cannot be restricted to some DoFs: it has no `select`")
        part = sharing(self)
        part.model, part.prior = self.model.select(view), self.prior.select(view)
        part._narrow(view)
        return part

    def _narrow(self, view: View) -> None:
        """Narrow what a subclass holds beside model and prior."""

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: of which DoFs they are, in this order, at which rate."""
        dofs = f"{self.n_dofs} of them" if self.dof_names is None else ", ".join(self.dof_names)
        return f"dofs={dofs}; dt={self.dt / self.stride:.9g}"

    def __repr__(self) -> str:
        names = self.dof_names
        dofs = f"{self.n_dofs} DoFs" if names is None else f"{self.n_dofs} DoFs: {', '.join(names[:4])}"
        more = ", ..." if names is not None and len(names) > 4 else ""
        parts = ", ".join([self.extra_repr(), *self._parts()])
        learned = sum(parameter.numel() for parameter in self.parameters())
        return (
            f"{type(self).__name__}({parts}, {dofs}{more}, {1 / self.dt:g} Hz, {learned} numbers to learn; "
            "`.model`, `.prior` and so on print the rest)"
        )

    def _parts(self) -> list[str]:
        """What the short description of a filter names beside its settings."""
        return []

    @eager
    def predict(self, state: State, dt: float | Tensor, generator: Generators = None) -> State:
        """Propagate.

        Args:
            state: of this filter.
            dt: seconds: a number, or a tensor [...] with one for each entry of the batch.
            generator: of the draws.

        Raises:
            ValueError: a dt that is negative, NaN or infinite, or not of the batch.
        """
        step = as_seconds(dt, state[0])
        if step.ndim:
            check_clocks(step, state.mean.shape[:-1])
        return self._predict(usable(state), step, generator)

    @eager
    def update(
        self, state: State, y: Tensor, observed: Tensor | None = None, generator: Generators = None
    ) -> tuple[State, Tensor]:
        """Take in one sample.

        Args:
            state: of this filter, predicted to the time of the sample.
            y: [..., D] in units of the DoFs.
            observed: bool [..., D]; default: where y is not NaN.
            generator: of the draws.

        Returns:
            The updated state and the log-likelihood [...] of the sample; nothing measured changes nothing and
            has log-likelihood 0.

        Raises:
            ValueError: wrong shapes or dtypes; NaN or infinity where observed; an innovation covariance that cannot
                be factored.
        """
        y, observed = as_sample(y, observed, self.n_dofs, self.dof_names, state[0])
        return self._update(usable(state), y, observed, generator)

    @eager
    def forward(
        self,
        y: Tensor,
        observed: Tensor | None = None,
        dt: float | Tensor | None = None,
        state: State | None = None,
        generator: Generators = None,
        *,
        keep: Tensor | None = None,
        segment: int | None = None,
        project: bool = True,
        engine: EngineName = "auto",
    ) -> Trace:
        """Filter a whole sequence.

        The first sample is taken at the time of the state, then a prediction by dt goes before each further one. To
        go on with a sequence, `predict` the last state first.

        Args:
            y: [..., T, D] in units of the DoFs; NaN = not measured.
            observed: bool [..., T, D]; default: where y is not NaN.
            dt: seconds between samples, a number or [...]; default: that of the model.
            state: default: `initial_state` of the batch.
            generator: of all draws; or one for each entry of the first batch dimension, so that its draws do not
                depend on its company.
            keep: int64 [..., K], after which samples (0 = the first) to keep the state of each entry.
            segment: samples a segment of gradient checkpointing; memory for gradients then grows with
                T / segment + segment instead of T, at the price of a second forward pass. Exact: every
                segment is recomputed with the draws it had.
            project: whether to compute `Trace.projection`.
            engine: who holds the members: "dense", which gradients pass through; "span", in place, where model and
                update allow it; "auto", the second where no gradients are recorded and it can serve.

        Raises:
            ValueError: wrong shapes or dtypes, NaN or infinity where observed, a step to keep that there is not, a dt
                that is negative, NaN or infinite; an engine that cannot serve: says why.
        """
        like = next(self.parameters(), None) if state is None else state[0]
        y, observed = as_sample(y, observed, self.n_dofs, self.dof_names, like)
        check_sequence(y, generator, keep)
        batch = y.shape[:-2]
        if segment is not None:
            segment = as_count("segment", segment)
        if state is None:
            state = self.initial_state(batch, generator=generator)
        elif state[0].shape[: len(batch)] != batch:
            raise ValueError(f"the state's batch does not begin with {list(batch)}: {list(state[0].shape)}")
        state = usable(state)
        step = as_seconds(self.dt if dt is None else dt, state[0])
        check_clocks(step, batch)
        if engine not in ("auto", "dense", "span"):
            raise ValueError(f'engine must be "auto", "dense" or "span", got {engine!r}')
        if engine != "dense":
            trace = self._through_span(y, observed, dt, state, generator, keep, project)
            if isinstance(trace, Trace):
                return trace
            if engine == "span":
                raise ValueError(f'engine="span" cannot serve this: {trace}')

        done = filter_step_by_step(self, y, observed, step, state, generator, keep, segment, project)
        return self._traced(done, "dense")

    def _traced(self, done: Filtered, engine: str) -> Trace:
        """The trace of a sequence that was filtered by an engine."""
        return self._trace(*done[:5], engine)

    if TYPE_CHECKING:  # what `nn.Module.__call__` hides

        def __call__(
            self,
            y: Tensor,
            observed: Tensor | None = None,
            dt: float | Tensor | None = None,
            state: State | None = None,
            generator: Generators = None,
            *,
            keep: Tensor | None = None,
            segment: int | None = None,
            project: bool = True,
            engine: EngineName = "auto",
        ) -> Trace: ...

    def _through_span(
        self,
        y: Tensor,
        observed: Tensor,
        dt: float | Tensor | None,
        state: State,
        generator: Generators,
        keep: Tensor | None,
        project: bool,
    ) -> Trace | str:
        """`forward` by the span engine, of arguments that were checked; or why that cannot serve."""
        return f"a {type(self).__name__} has the dense engine only"
