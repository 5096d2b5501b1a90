"""Properties of the update kernels over sizes, units from 1e-12 to 1e12, duplicates, gaps and an R near nothing.

Whatever is asked, the answer is finite with finite gradients, or a `FactorisationError`; and there may be none where
float64 arithmetic says that S is far enough from singular.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from torch import Tensor

from torch_ebip.filtering.functional import (
    FactorisationError,
    Taper,
    ensemble_update,
    ensemble_variance,
    square_root_update,
)


@dataclass(frozen=True)
class Case:
    """What is asked.

    Attributes:
        ratio: standard deviation of the noise over that of the members.
        copies: how many different members there are; the others are copies of them.
        gaps: which rows are missing.
    """

    kind: str
    E: int
    n: int
    D: int
    batch: int
    dtype: torch.dtype
    ratio: float
    copies: int
    gaps: str
    weighted: bool
    inflated: bool
    tapered: bool
    seed: int

    def resolves(self, smallest: float) -> bool:
        """Whether the dtype can tell S from a singular one, and the noise from the rounding of the values."""
        eps = torch.finfo(self.dtype).eps
        return smallest > 1000 * self.D * eps and self.ratio > 1000 * eps


@st.composite
def cases(draw: st.DrawFn) -> Case:
    E = draw(st.one_of(st.integers(2, 50), st.sampled_from([2, 200, 1000])))
    return Case(
        kind=draw(st.sampled_from(["stochastic", "square root"])),
        E=E,
        n=draw(st.integers(1, 100)),
        D=draw(st.integers(1, 60)),
        batch=draw(st.integers(1, 3)),
        dtype=draw(st.sampled_from([torch.float32, torch.float64])),
        ratio=draw(st.sampled_from([1.0, 0.1, 1e-3, 1e-6])),
        copies=draw(st.sampled_from([E, max(1, E // 2), 1])),
        gaps=draw(st.sampled_from(["none", "all", "single", "random", "mixed"])),
        weighted=draw(st.booleans()),
        inflated=draw(st.booleans()),
        tapered=draw(st.booleans()),
        seed=draw(st.integers(0, 2**31)),
    )


class Problem:
    """The tensors of a case: members and projections of a few common causes, every entry in a unit of its own."""

    def __init__(self, case: Case) -> None:
        rng = np.random.default_rng(case.seed)
        B, E, D, n = case.batch, case.E, case.D, case.n
        self.unit = 10.0 ** rng.uniform(-12, 12, D)
        self.state_unit = self.tensor(10.0 ** rng.uniform(-12, 12, n), case)
        causes = rng.normal(size=(B, E, 8))[:, rng.integers(0, case.copies, E) if case.copies < E else slice(None)]
        self.members = self.tensor(causes @ rng.normal(size=(8, n)), case) * self.state_unit
        self.projections = self.tensor((causes @ rng.normal(size=(8, D)) / 8**0.5 + 1) * self.unit, case)
        noise = np.tril(0.3 * rng.normal(size=(D, D)) / D, -1) + np.eye(D)
        self.noise = self.tensor(case.ratio * self.unit[:, None] * noise, case)
        self.y = self.tensor((1 + rng.normal(size=(B, D))) * self.unit, case)
        self.draws = self.tensor(rng.normal(size=(B, E, D)), case)
        observed = {
            "none": np.ones((B, D)),
            "all": np.zeros((B, D)),
            "single": np.arange(D) == rng.integers(D),
            "random": rng.uniform(size=(B, D)) < 0.5,
            "mixed": (rng.uniform(size=(B, D)) < 0.5) & (np.arange(B)[:, None] > 0),
        }[case.gaps]
        self.observed = torch.from_numpy(np.broadcast_to(observed, (B, D)).astype(bool).copy())
        self.y[~self.observed] = torch.nan
        self.weights = self.tensor(rng.dirichlet(np.ones(E), B), case) if case.weighted else None
        self.inflation = self.tensor(1 + rng.uniform(size=B), case) if case.inflated else None
        self.taper = None
        if case.tapered:
            rows = rng.uniform(size=(n + D, 3))
            rows /= np.linalg.norm(rows, axis=1, keepdims=True)
            self.taper = Taper(self.tensor(rows[:n] @ rows[n:].T, case), self.tensor(rows[n:] @ rows[n:].T, case))

    @staticmethod
    def tensor(values: np.ndarray, case: Case) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(values)).to(case.dtype)

    def update(self, kind: str) -> tuple[Tensor, Tensor]:
        options = (self.observed, self.taper, self.weights, self.inflation)
        if kind == "stochastic":
            return ensemble_update(self.members, self.projections, self.y, self.noise, self.draws, *options)
        return square_root_update(self.members, self.projections, self.y, self.noise, *options)

    def oracle(self) -> list[tuple[float, float, float]]:
        """Log-likelihood, squared distance and smallest eigenvalue of the whitened S of each entry, in float64."""
        results = []
        for i in range(len(self.y)):
            seen = self.observed[i].numpy()
            if not seen.any():
                results.append((0.0, 0.0, 1.0))
                continue
            HX, L = self.projections[i].double().numpy()[:, seen], self.noise.double().numpy()[seen]
            unit = self.unit[seen]
            HX, L, y = HX / unit, L / unit[:, None], self.y[i].double().numpy()[seen] / unit
            w = np.full(len(HX), 1 / len(HX)) if self.weights is None else self.weights[i].double().numpy()
            mean = w @ HX
            P = (w[:, None] * (HX - mean)).T @ (HX - mean) / (1 - (w**2).sum())
            if self.taper is not None:
                P = P * self.taper.observation.double().numpy()[np.ix_(seen, seen)]
            S = P + L @ L.T
            deviation = np.sqrt(np.diag(S))
            distance = (y - mean) @ np.linalg.solve(S, y - mean)
            _, log_det = np.linalg.slogdet(S)
            density = -0.5 * (distance + log_det + len(y) * np.log(2 * np.pi)) - np.log(unit).sum()
            smallest = np.linalg.eigvalsh(S / np.outer(deviation, deviation))[0]
            results.append((float(density), float(distance), float(smallest)))
        return results


PICOMETRES = Case("stochastic", 2, 1, 3, 2, torch.float32, 1e-6, 1, "none", False, False, False, 0)
"""Equal members and tiny noise in tiny units: gradients of 1e22, and of more within a wrong formula."""


@given(cases())
@example(PICOMETRES)
def test_finite_or_a_named_error(case: Case) -> None:
    """Values and gradients; the likelihood is that of float64 arithmetic, to what S's condition allows."""
    problem = Problem(case)
    oracle = problem.oracle()
    rounding = case.D * torch.finfo(case.dtype).eps
    inputs = (problem.members, problem.projections, problem.y, problem.noise)
    for tensor in inputs:
        tensor.requires_grad_()
    failure = None
    try:
        updated, likelihood = problem.update(case.kind)
    except FactorisationError as error:
        failure = error
    if failure is not None:
        assert failure.dofs
        assert all(problem.observed[:, dof].any() for dof in failure.dofs)
        assert min(smallest for _, _, smallest in oracle) < 50 * rounding
        return
    assert updated.isfinite().all()
    assert likelihood.isfinite().all()
    for value, (density, distance, smallest) in zip(likelihood.tolist(), oracle, strict=True):
        if case.resolves(smallest):
            allowed = (20 * rounding / smallest + 1e-6) * (distance + case.D) + 1e-5 * abs(density)
            assert abs(value - density) < allowed
    if case.gaps == "all":
        assert torch.equal(updated, problem.members)
        assert likelihood.tolist() == [0.0] * case.batch
    ((updated / problem.state_unit).sum() + likelihood.sum()).backward()
    for tensor in inputs:
        assert tensor.grad is None or tensor.grad.isfinite().all()


@given(cases())
def test_the_square_root_update_never_widens(case: Case) -> None:
    """Beyond what inflation says; without a taper, which makes covariances that are nobody's."""
    problem = Problem(case)
    problem.taper = None
    try:
        updated, _ = problem.update("square root")
    except FactorisationError:
        return
    before = ensemble_variance(problem.members, problem.weights) / problem.state_unit.square()
    after = ensemble_variance(updated, problem.weights) / problem.state_unit.square()
    if problem.inflation is not None:
        growth = torch.where(problem.observed.any(-1), problem.inflation, 1)
        before = before * growth.square().unsqueeze(-1)
    if case.resolves(min(smallest for _, _, smallest in problem.oracle())):
        assert (after <= before * (1 + 1e-3) + 1e3 * torch.finfo(case.dtype).eps).all()


@given(cases())
def test_copies_stay_copies(case: Case) -> None:
    """The square-root update gives equal members equal moves."""
    problem = Problem(case)
    problem.members[:, -1], problem.projections[:, -1] = problem.members[:, 0], problem.projections[:, 0]
    try:
        updated, _ = problem.update("square root")
    except FactorisationError:
        return
    first, last = updated[:, 0] / problem.state_unit, updated[:, -1] / problem.state_unit
    size = (updated / problem.state_unit).abs().amax((-1, -2), keepdim=True).squeeze(-1)
    assert ((first - last).abs() <= 100 * torch.finfo(case.dtype).eps * (1 + size)).all()


@pytest.mark.parametrize("kind", ["stochastic", "square root"])
def test_gradients_where_nothing_but_a_tiny_noise_is_left(kind: str) -> None:
    """All members equal, picometres, and R at its floor: a standard deviation of 1e-20 has gradients of 1e20."""
    members = torch.zeros(4, 3)
    projections = torch.full((4, 2), 1e-12)
    noise = torch.diag(torch.tensor([1e-20, 1e-19])).requires_grad_()
    y = projections[0] + torch.tensor([1e-20, -3e-19])
    if kind == "stochastic":
        updated, likelihood = ensemble_update(members, projections, y, noise, torch.zeros(4, 2))
    else:
        updated, likelihood = square_root_update(members, projections, y, noise)
    (updated.sum() + likelihood).backward()
    deviation = noise.diagonal().double().detach()
    expected = ((y - projections[0]).double() ** 2 / deviation**3 - 1 / deviation).float()
    assert noise.grad is not None
    torch.testing.assert_close(noise.grad.diagonal(), expected, rtol=1e-3, atol=0)


@pytest.mark.parametrize("kind", ["stochastic", "square root"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_units_that_are_powers_of_two_change_nothing_to_the_bit(kind: str, dtype: torch.dtype) -> None:
    case = Case(kind, 12, 7, 5, 2, dtype, 0.1, 12, "random", True, True, True, 3)
    factors = torch.tensor([2.0**20, 2.0**-20, 1.0, 2.0**30, 2.0**-30], dtype=dtype)
    one, other = Problem(case), Problem(case)
    other.projections, other.y = other.projections * factors, other.y * factors
    other.noise = other.noise * factors.unsqueeze(-1)
    (a, likelihood), (b, rescaled) = one.update(kind), other.update(kind)
    assert torch.equal(a, b)
    jacobian = (one.observed * factors.log()).sum(-1)
    torch.testing.assert_close(rescaled, likelihood - jacobian, rtol=1e-5, atol=1e-4)
