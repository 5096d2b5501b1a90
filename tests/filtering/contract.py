"""What every filter promises. A subclass gives `make`; pytest collects it under the subclass's name.

`deterministic` filters draw nothing, so that batches can be compared with loops entry by entry.
"""

from __future__ import annotations

import math

import pytest
import torch

from tests.conftest import interactions
from torch_ebip import Filter
from torch_ebip.filtering.states import map_state


class FilterContract:
    """The suite."""

    def make(self, dtype: torch.dtype = torch.float32) -> Filter:
        """A filter of the interactions in conftest, all options of its kind switched on."""
        raise AssertionError("a subclass says what is tested")

    def make_without_draws(self) -> Filter:
        """The same in float64, without any randomness after the initial state."""
        raise AssertionError("a subclass says what is tested")

    def sequences(self, dtype: torch.dtype = torch.float32) -> tuple[torch.Tensor, torch.Tensor]:
        """Three interactions [3, 20, 5] with gaps, only the human observed, and where."""
        values, observed = interactions(3, seed=7, dtype=dtype).pad()
        values, observed = values[:, :20], observed[:, :20] & torch.tensor([True, True, True, False, False])
        observed[1, 4:8] = False
        return values, observed

    def test_shapes(self) -> None:
        made = self.make()
        y, observed = self.sequences()
        trace = made(y, observed, generator=torch.Generator().manual_seed(0), keep=torch.tensor([[3, 9]] * 3))
        assert trace.phase.shape == (3, 20)
        assert trace.log_likelihood.shape == (3, 20)
        assert trace.projection.shape == (3, 20, 5)
        assert trace.state.mean.shape == (3, trace.state.mean.shape[-1])
        n = trace.state.mean.shape[-1]
        assert trace.state.covariance.shape == (3, n, n)
        forecast = made.forecast(trace.state)
        assert forecast.mean.shape == forecast.variance.shape == (3, 50, 5)
        torch.testing.assert_close(forecast.phase[:, 0], trace.phase[:, -1])
        once_round = made.phase_model.periodic
        assert (forecast.phase[:, -1] == (trace.phase[:, -1] + 1 if once_round else 1)).all()
        assert (forecast.variance > 0).all()
        assert made.forecast(trace.kept, torch.tensor([0.5, 1.0])).mean.shape == (3, 2, 2, 5)

    def test_unbatched_and_deeply_batched(self) -> None:
        made = self.make()
        y, observed = self.sequences()
        assert made(y[0], observed[0]).projection.shape == (20, 5)
        deep = made(y[:2].reshape(2, 1, 20, 5), observed[:2].reshape(2, 1, 20, 5))
        assert deep.projection.shape == (2, 1, 20, 5)

    def test_a_batch_is_a_loop(self) -> None:
        made = self.make_without_draws()
        y, observed = self.sequences(torch.float64)
        state = made.initial_state((3,), generator=torch.Generator().manual_seed(1))
        together = made(y, observed, state=state)
        for i in range(3):
            alone = made(y[i], observed[i], state=map_state(lambda part, i=i: part[i], state))
            torch.testing.assert_close(together.projection[i], alone.projection)
            torch.testing.assert_close(together.log_likelihood[i], alone.log_likelihood)
            torch.testing.assert_close(together.state.mean[i], alone.state.mean)

    def test_a_sequence_is_a_loop_of_predict_and_update(self) -> None:
        made = self.make()
        y, observed = self.sequences()
        trace = made(y, observed, generator=torch.Generator().manual_seed(2))
        generator = torch.Generator().manual_seed(2)
        state = made.initial_state((3,), generator=generator)
        for t in range(20):
            if t:
                state = made.predict(state, made.dt, generator)
            state, likelihood = made.update(state, y[:, t], observed[:, t], generator)
            assert torch.equal(likelihood, trace.log_likelihood[:, t])
        assert torch.equal(state.mean, trace.state.mean)

    def test_a_seed_reproduces_and_the_global_generator_is_left_alone(self) -> None:
        made = self.make()
        y, observed = self.sequences()
        before = torch.get_rng_state()
        a, b = (made(y, observed, generator=torch.Generator().manual_seed(3)) for _ in range(2))
        assert torch.equal(a.projection, b.projection)
        assert torch.equal(before, torch.get_rng_state())

    @pytest.mark.parametrize("gradients", [True, False])
    @pytest.mark.parametrize("segment", [None, 7])
    def test_draws_belong_to_the_interaction(self, gradients: bool, segment: int | None) -> None:
        """With a generator each, an interaction's result does not depend on its company, whatever that measures."""
        made = self.make(torch.float64)
        y, observed = self.sequences(torch.float64)
        observed[0, 9:, 0] = False
        observed[2, 12:] = False

        def generators(entries: list[int]) -> list[torch.Generator]:
            """The same ones again."""
            return [torch.Generator().manual_seed(i) for i in entries]

        with torch.set_grad_enabled(gradients):
            together = made(y, observed, generator=generators([0, 1, 2]), segment=segment)
            for entries in ([1], [0, 2]):
                apart = made(y[entries], observed[entries], generator=generators(entries))
                torch.testing.assert_close(apart.projection, together.projection[entries])
                torch.testing.assert_close(apart.log_likelihood, together.log_likelihood[entries])
        if gradients and together.log_likelihood.requires_grad:
            together.log_likelihood.sum().backward()  # a checkpointed segment is repeated with the same draws
        with pytest.raises(ValueError, match="2 generators"):
            made(y, observed, generator=generators([0, 1]))

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
    def test_dtype_follows(self, dtype: torch.dtype) -> None:
        made = self.make(dtype)
        y, observed = self.sequences(dtype)
        trace = made(y, observed)
        assert trace.projection.dtype == trace.log_likelihood.dtype == trace.phase.dtype == dtype
        assert trace.projection.isfinite().all()
        moved = self.make(torch.float32).double()
        y64, _ = self.sequences(torch.float64)
        assert moved(y64, observed).projection.dtype == torch.float64

    @pytest.mark.skipif(not torch.cuda.is_available(), reason="no GPU")
    def test_device_follows(self) -> None:
        y, observed = self.sequences()
        assert self.make().cuda()(y.cuda(), observed.cuda()).projection.is_cuda

    def test_missing_data_is_a_no_op_with_finite_gradients(self) -> None:
        made = self.make()
        state = made.initial_state((2,), generator=torch.Generator().manual_seed(0))
        nothing = torch.full((2, 5), math.nan)
        after, likelihood = made.update(state, nothing)
        assert torch.equal(after.mean, state.mean)
        assert torch.equal(after.covariance, state.covariance)
        assert likelihood.tolist() == [0.0, 0.0]
        y, observed = self.sequences()
        y = torch.where(observed, y, math.nan)
        trace = made(y, generator=torch.Generator().manual_seed(0))
        (trace.projection.sum() + trace.log_likelihood.sum()).backward()
        gradients = {name: p.grad for name, p in made.named_parameters() if p.grad is not None}
        assert gradients
        assert all(gradient.isfinite().all() for gradient in gradients.values())

    def test_what_is_not_observed_does_not_matter(self) -> None:
        made = self.make()
        y, observed = self.sequences()
        other = torch.where(observed, y, 1e6)
        a = made(y, observed, generator=torch.Generator().manual_seed(0))
        b = made(other, observed, generator=torch.Generator().manual_seed(0))
        assert torch.equal(a.projection, b.projection)

    def test_checkpointed_gradients_are_exact(self) -> None:
        made = self.make(torch.float64)
        y, observed = self.sequences(torch.float64)
        gradients = []
        for segment in (None, 6):
            made.zero_grad()
            generator = torch.Generator().manual_seed(4)
            trace = made(y, observed, generator=generator, keep=torch.tensor([[5, 17]] * 3), segment=segment)
            (made.forecast(trace.kept, torch.ones(1)).mean.square().sum() + trace.log_likelihood.sum()).backward()
            gradients.append([p.grad.clone() for p in made.parameters() if p.grad is not None])
            gradients[-1].append(torch.rand(3, generator=generator))  # the generator ends in the same state
        for a, b in zip(*gradients, strict=True):
            torch.testing.assert_close(a, b, atol=0, rtol=1e-10)

    def test_kept_states_are_those_of_shorter_sequences(self) -> None:
        made = self.make_without_draws()
        y, observed = self.sequences(torch.float64)
        state = made.initial_state((3,), generator=torch.Generator().manual_seed(1))
        keep = torch.tensor([[0, 19], [7, 3], [11, 11]])
        kept = made(y, observed, state=state, keep=keep).kept
        for i in range(3):
            for k in range(2):
                stop = int(keep[i, k]) + 1
                alone = made(y[:, :stop], observed[:, :stop], state=state).state
                torch.testing.assert_close(kept.mean[i, k], alone.mean[i])

    def test_every_parameter_is_gradchecked(self) -> None:
        """With all options and all noise; every evaluation repeats the same draws."""
        made = self.make(torch.float64)
        y, observed = self.sequences(torch.float64)
        y, observed = y[:2, :4], observed[:2, :4]
        state = made.initial_state((2,), generator=torch.Generator().manual_seed(1))
        names = [name for name, parameter in made.named_parameters() if parameter.requires_grad]
        values = [parameter.detach().clone().requires_grad_() for parameter in made.parameters()]

        def run(*parameters: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
            trace = torch.func.functional_call(
                made,
                dict(zip(names, parameters, strict=True)),
                (y, observed),
                {"state": state, "generator": torch.Generator().manual_seed(2)},
            )
            return trace.projection, trace.log_likelihood

        assert names
        assert torch.autograd.gradcheck(run, values, atol=1e-6)

    @pytest.mark.parametrize(
        ("y", "observed", "message"),
        [
            (torch.zeros(3, 4), None, "y must end in 5"),
            (torch.zeros(3, 5), torch.ones(3, 5), "observed must be bool"),
            (torch.zeros(3, 5), torch.ones(3, 4, dtype=torch.bool), "observed must be bool and end in 5"),
            (
                torch.full((3, 5), math.nan),
                torch.ones(3, 5, dtype=torch.bool),
                "NaN or infinite where it is observed",
            ),
            (torch.full((3, 5), math.inf), None, r"NaN or infinite where it is observed, in DoFs \[0, 1, 2, 3, 4\]"),
        ],
    )
    def test_bad_measurements_are_named(self, y: torch.Tensor, observed: torch.Tensor | None, message: str) -> None:
        made = self.make()
        with pytest.raises(ValueError, match=message):
            made(y, observed)
        with pytest.raises(ValueError, match=message):
            made.update(made.initial_state((3,)), y, observed)

    def test_bad_sequences_are_named(self) -> None:
        made = self.make()
        with pytest.raises(ValueError, match="at least one sample"):
            made(torch.zeros(0, 5))
        with pytest.raises(ValueError, match="keep must be"):
            made(torch.zeros(4, 5), keep=torch.tensor([4]))
        with pytest.raises(ValueError, match="batch does not begin with"):
            made(torch.zeros(2, 4, 5), state=made.initial_state((3,)))
