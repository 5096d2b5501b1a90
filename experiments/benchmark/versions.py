"""The same predict and update, written in several ways: ours, a loop over members, numpy, and public peers.

Each version is made from a problem and a source of standard-normal draws, and has `step(y)`, y [D_o] the measured
values. They give the same members for the same draws, which `check` compares before anything is timed.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.benchmark.problem import FUNCTIONS, Problem
from torch_ebip import LiveFilter

Draw = Callable[..., Tensor]
"""Standard-normal draws of a shape."""


class Version(Protocol):
    """One way to filter."""

    def step(self, y: Tensor) -> object:
        """Predict, then update with y [D_o]."""

    def members(self) -> Tensor:
        """[E, n], to be compared."""


class Constants:
    """What all plain versions compute from: the model in numbers.

    Attributes:
        start: [E, n], members at the beginning.
        factor: [2, 2], lower factor of Q of phase and velocity.
        deviation: [D_o], square root of R.
    """

    def __init__(self, problem: Problem) -> None:
        filter = problem.filter
        self.dt = filter.dt
        with torch.no_grad():
            self.start = filter.prior.states.clone()
            self.factor = filter.model.process_noise.factor(self.start.new_tensor(self.dt))
            self.deviation = filter.model.measurement_noise()[problem.sensors]
        self.sensors = len(self.deviation)
        model = filter.model
        self.overrun, self.margin = model.dynamics.overrun, model.measurement.basis.bases[0].margin


class Live:
    """`LiveFilter`."""

    def __init__(self, problem: Problem, generator: torch.Generator, batch: int = 0, weigh: bool = False) -> None:
        filter = problem.weighted if weigh else problem.filter
        self.live = LiveFilter(filter, problem.sensors, (batch,) if batch else (), generator=generator)
        self.observed = problem.sensors.expand(*self.live.batch_shape, -1)
        self.y = self.observed.new_zeros(self.observed.shape, dtype=problem.y.dtype)
        self.first = int(problem.sensors.sum())

    def step(self, y: Tensor) -> Tensor:
        """See `Version`."""
        self.y[..., : self.first] = y
        self.live.predict()
        return self.live.update(self.y, self.observed)

    def members(self) -> Tensor:
        """See `Version`."""
        return self.live.state.members


class Module:
    """`EnsembleFilter.predict` and `update`, the differentiable path, without gradients."""

    def __init__(self, problem: Problem, generator: torch.Generator) -> None:
        self.filter, self.generator, self.observed = problem.filter, generator, problem.sensors
        self.state = self.filter.initial_state(generator=generator)
        self.y = problem.y.new_zeros(problem.y.shape[-1])
        self.first = int(problem.sensors.sum())

    @torch.no_grad()
    def step(self, y: Tensor) -> Tensor:
        """See `Version`."""
        self.y[: self.first] = y
        self.state = self.filter.predict(self.state, self.filter.dt, self.generator)
        self.state, likelihood = self.filter.update(self.state, self.y, self.observed, self.generator)
        return likelihood

    def members(self) -> Tensor:
        """See `Version`."""
        return self.state.members


class Loop:
    """Torch, member by member."""

    def __init__(self, problem: Problem, draw: Draw) -> None:
        self.model, self.draw = Constants(problem), draw
        self.x = list(self.model.start.unbind(0))
        self.centres = torch.linspace(0, 1, FUNCTIONS, dtype=self.model.start.dtype)

    @torch.no_grad()
    def step(self, y: Tensor) -> None:
        """See `Version`."""
        model, E = self.model, len(self.x)
        draws = self.draw(E, 2)
        for j in range(E):
            x = self.x[j].clone()
            phase = x[0] + x[1] * model.dt
            excess = phase - phase.clamp(0, 1)
            x[0] = phase - excess * excess.abs() / (model.overrun + excess.abs())
            x[:2] += model.factor @ draws[j]
            self.x[j] = x
        HX = torch.stack([self.project(x) for x in self.x])
        X = torch.stack(self.x)
        HA, A = HX - HX.mean(0), X - X.mean(0)
        S = HA.T @ HA / (E - 1) + torch.diag(model.deviation.square())
        K = torch.cholesky_solve(HA.T @ A / (E - 1), torch.linalg.cholesky(S)).T
        draws = self.draw(E, model.sensors)
        for j in range(E):
            self.x[j] = self.x[j] + K @ (y + model.deviation * draws[j] - HX[j])

    def project(self, x: Tensor) -> Tensor:
        """h(x), [D_o]."""
        inside = x[0].clamp(0, 1)
        excess = x[0] - inside
        distance = (inside - self.centres) * (FUNCTIONS - 1)
        values = torch.exp(-0.5 * distance.square())
        slopes = -distance * values * (FUNCTIONS - 1)
        features = values + slopes * excess / (1 + excess.abs() / self.model.margin)
        return x[2 : 2 + self.model.sensors * FUNCTIONS].view(-1, FUNCTIONS) @ features

    def members(self) -> Tensor:
        """See `Version`."""
        return torch.stack(self.x)


class Numpy:
    """Vectorised numpy, as one would write it from the paper."""

    def __init__(self, problem: Problem, draw: Callable[..., NDArray[Any]]) -> None:
        model = Constants(problem)
        self.x = model.start.numpy().copy()
        self.factor, self.deviation = model.factor.numpy(), model.deviation.numpy()
        self.model, self.draw = model, draw
        self.centres = np.linspace(0, 1, FUNCTIONS, dtype=self.x.dtype)
        self.R = np.diag(self.deviation**2)

    def advance(self, x: NDArray[Any]) -> NDArray[Any]:
        """g(x) of members [E, n] or one [n], in place."""
        phase = x[..., 0] + x[..., 1] * self.x.dtype.type(self.model.dt)
        excess = phase - phase.clip(0, 1)
        x[..., 0] = phase - excess * np.abs(excess) / (self.model.overrun + np.abs(excess))
        return x

    def project(self, x: NDArray[Any]) -> NDArray[Any]:
        """h(x), [..., D_o]."""
        phase = x[..., 0, None]
        inside = phase.clip(0, 1)
        excess = phase - inside
        distance = (inside - self.centres) * (FUNCTIONS - 1)
        values = np.exp(-0.5 * distance**2)
        slopes = -distance * values * (FUNCTIONS - 1)
        features = values + slopes * excess / (1 + np.abs(excess) / self.model.margin)
        weights = x[..., 2 : 2 + self.model.sensors * FUNCTIONS].reshape(*x.shape[:-1], -1, FUNCTIONS)
        projected: NDArray[Any] = (weights @ features[..., None])[..., 0]
        return projected

    def step(self, y: Tensor) -> None:
        """See `Version`."""
        E = len(self.x)
        x = self.advance(self.x)
        x[:, :2] += self.draw((E, 2)) @ self.factor.T
        HX = self.project(x)
        HA = HX - HX.mean(0)
        S = HA.T @ HA / (E - 1) + self.R
        departures = y.numpy() + self.deviation * self.draw((E, self.model.sensors)) - HX
        x += np.linalg.solve(S, departures.T).T @ (HA.T @ x / (E - 1))

    def members(self) -> Tensor:
        """See `Version`."""
        return torch.from_numpy(self.x)


class FilterPy(Numpy):
    """filterpy's EnsembleKalmanFilter with the same g, h, Q and R."""

    def __init__(self, problem: Problem, draw: Callable[..., NDArray[Any]]) -> None:
        from filterpy.kalman import EnsembleKalmanFilter

        super().__init__(problem, draw)
        x = self.x.astype(np.float64)
        n = x.shape[1]
        peer = EnsembleKalmanFilter(
            x.mean(0),
            np.eye(n),
            self.model.sensors,
            self.model.dt,
            len(x),
            self.project,
            lambda x, dt: self.advance(x),
        )
        peer.sigmas, peer.x, peer.P = x, x.mean(0), np.cov(x.T)
        peer.Q = np.zeros((n, n))
        peer.Q[:2, :2] = self.factor.astype(np.float64) @ self.factor.T
        peer.R = self.R.astype(np.float64)
        self.peer = peer

    def step(self, y: Tensor) -> None:
        """See `Version`."""
        self.peer.predict()
        self.peer.update(y.numpy())

    def members(self) -> Tensor:
        """See `Version`."""
        return torch.from_numpy(self.peer.sigmas)

    @contextmanager
    def given_draws(self) -> Iterator[None]:
        """With our draws in place of its own, to compare results."""
        import filterpy.kalman.ensemble_kalman_filter as module

        original = module.multivariate_normal

        def drawn(mean: NDArray[Any], covariance: NDArray[Any], size: int) -> NDArray[Any]:
            """Our draws through the covariance's factor."""
            noise = np.zeros((size, len(mean)))
            if len(mean) == self.x.shape[1]:
                noise[:, :2] = self.draw((size, 2)) @ self.factor.T
            else:
                noise[:] = self.draw((size, len(mean))) * self.deviation
            return noise

        module.multivariate_normal = drawn
        try:
            yield
        finally:
            module.multivariate_normal = original
