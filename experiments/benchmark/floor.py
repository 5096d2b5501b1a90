"""The floor of a step: the products, the factorisation, the solve and the draws that its sizes cannot do without.

Nothing else: no means, no features, no checks. Operands are ready, outputs preallocated. What no sensor sees is
left to a transform of E x E where that is less, as the live path does; so this floor is lower than that of an
update of the whole state.
"""

from __future__ import annotations

from collections.abc import Callable

import torch

from experiments.benchmark.problem import FUNCTIONS, Problem


def floor(problem: Problem, whole: bool = False, weigh: bool = False) -> Callable[[], None]:
    """One bare step.

    Args:
        problem: for its sizes and dtype.
        whole: update all of the state, without the transform.
        weigh: with what evidence weights need: looking up where each member's demonstration is, at five phases near
            its own, between points of the table; distances, their likelihood, the weights, and weighted anomalies.
    """
    E, D = problem.filter.n_members, int(problem.sensors.sum())
    seen = D * FUNCTIONS
    rest = problem.n_weights - seen
    rows = 2 + seen + (rest if whole else min(rest, E))
    like = problem.y.new_empty(())
    generator = torch.Generator().manual_seed(0)

    def empty(*shape: int) -> torch.Tensor:
        return like.new_empty(shape)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(shape, generator=generator, dtype=like.dtype)

    members, anomalies, features = drawn(rows, E), drawn(D, E), drawn(1, FUNCTIONS, E)
    moving, factor, phase_draws, draws = members[:2], drawn(2, 2) * 1e-6, empty(E, 2), empty(E, D)
    weights, terms, projections = members[2 : 2 + seen].view(D, FUNCTIONS, E), empty(D, FUNCTIONS, E), empty(D, E)
    R, S = torch.eye(D, dtype=like.dtype), empty(D, D)
    cholesky, info = empty(D, D), torch.empty((), dtype=torch.int32)
    right, solved, cross = drawn(E, D).T, empty(E, D).T, empty(rows, D)

    cells, near = drawn(E * 40, 4 * D), torch.randint(E * 40, (5 * E,), generator=generator)
    t, scale, y = drawn(5 * E, 1), drawn(D).abs(), drawn(D)
    found, path, distance = empty(5 * E, 4 * D), empty(5 * E, D), empty(5 * E)
    likelihood, shares, weighted = empty(E), empty(E), empty(D, E)

    @torch.no_grad()
    def evidence() -> None:
        torch.index_select(cells, 0, near, out=found)
        a, b, c, d = found.view(5 * E, 4, D).unbind(1)
        torch.addcmul(c, t, d, out=path)
        torch.addcmul(b, t, path, out=path)
        torch.addcmul(a, t, path, out=path)
        path.sub_(y).square_()
        torch.mv(path, scale, out=distance)
        torch.logsumexp(distance.view(E, 5), -1, out=likelihood)
        torch.softmax(likelihood, -1, out=shares)
        torch.mul(anomalies, shares, out=weighted)

    @torch.no_grad()
    def step() -> None:
        if weigh:
            evidence()
        phase_draws.normal_(generator=generator)
        moving.addmm_(factor, phase_draws.T)
        torch.mul(weights, features, out=terms)
        torch.sum(terms, 1, out=projections)
        torch.addmm(R, anomalies, anomalies.T, out=S)
        torch.linalg.cholesky_ex(S, out=(cholesky, info))
        draws.normal_(generator=generator)
        torch.cholesky_solve(right, cholesky, out=solved)
        torch.mm(members, anomalies.T, out=cross)
        members.addmm_(cross, solved, alpha=1e-12)

    return step
