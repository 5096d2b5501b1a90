"""Whole sequences: a test fold in one call or one at a time, and gradients through a batch with their memory."""

from __future__ import annotations

import multiprocessing
import time
from pathlib import Path
from typing import Any

import torch

from experiments.benchmark.problem import Problem, make_problem
from experiments.timing import collected, interleaved, threads

FOLD, MEMBERS, SAMPLES = 22, 198, 100


def fold(repeats: int, seed: int, samples: int = SAMPLES) -> list[dict[str, Any]]:
    """A test fold of 22 interactions x 198 members x the whole sequence: seconds in one call and one at a time.

    ``alone`` is the same call for one interaction after the other; ``alone_stepwise`` is `predict` and `update` of
    the differentiable path, one interaction after the other; both measured on four of them.
    """
    rows = []
    few = 4
    for sensors in (10, 43):
        for count in (1, 2):
            problem = make_problem(559, MEMBERS, sensors, torch.float32, samples=samples, seed=seed)
            y = _batch(problem, FOLD, seed)
            observed = problem.sensors.expand(y.shape)
            with threads(count), torch.no_grad():

                def together(problem: Problem = problem, y: Any = y, observed: Any = observed) -> None:
                    """All in one call."""
                    generator = torch.Generator().manual_seed(seed)
                    problem.filter(y, observed, generator=generator, project=False)

                def alone(problem: Problem = problem, y: Any = y, observed: Any = observed) -> None:
                    """One after the other."""
                    for i in range(few):
                        generator = torch.Generator().manual_seed(seed + i)
                        problem.filter(y[i], observed[i], generator=generator, project=False)

                def stepwise(problem: Problem = problem, y: Any = y, observed: Any = observed) -> None:
                    """One after the other, by predict and update."""
                    filter = problem.filter
                    for i in range(few):
                        generator = torch.Generator().manual_seed(seed + i)
                        state = filter.initial_state(generator=generator)
                        for t in range(y.shape[1]):
                            state = filter.predict(state, filter.dt, generator) if t else state
                            state, _ = filter.update(state, y[i, t], observed[i, t], generator)

                actions = {"together": together, "alone": alone, "stepwise": stepwise}
                timings = interleaved(actions, repeats)
            whole = timings["together"].median
            rows.append(
                {
                    "sensors": sensors,
                    "threads": count,
                    "seconds": whole,
                    "microseconds": 1e6 * whole / FOLD / samples,
                    "alone_over_together": timings["alone"].median * FOLD / few / whole,
                    "stepwise_over_together": timings["stepwise"].median * FOLD / few / whole,
                }
            )
    return rows


def tuning(seed: int, batch: int = 16, samples: int = SAMPLES) -> list[dict[str, Any]]:
    """Forward and backward pass of 16 x 198 members x 100 steps x 559 weights, each in a process of its own.

    Seconds per interaction, and how far the process's peak memory rose above what it held before.
    """
    context = multiprocessing.get_context("spawn")
    rows = []
    for sensors in (10, 43):
        for segment in (None, 10):
            with context.Pool(1) as pool:
                rows.append(pool.apply(_gradient, (sensors, segment, batch, samples, seed)))
    return rows


def _gradient(sensors: int, segment: int | None, batch: int, samples: int, seed: int) -> dict[str, Any]:
    torch.set_num_threads(2)
    problem = make_problem(559, MEMBERS, sensors, torch.float32, samples=samples, seed=seed)
    filter = problem.filter
    y = _batch(problem, batch, seed)
    observed = problem.sensors.expand(y.shape)

    def run(length: int) -> float:
        """Seconds of both passes over some samples."""
        began = time.perf_counter()
        trace = filter(
            y[:, :length], observed[:, :length], generator=torch.Generator().manual_seed(seed), segment=segment,
            project=False,
        )  # fmt: skip
        loss = trace.log_likelihood.mean() + filter.forecast(trace.state, y.new_ones(1)).mean.square().mean()
        loss.backward()
        return time.perf_counter() - began

    with collected():
        run(2)
        before = _forget_peak()
        seconds = run(samples)
    peak = _memory("VmHWM") - before
    return {
        "sensors": sensors,
        "segment": segment,
        "batch": batch,
        "samples": samples,
        "seconds_per_interaction": seconds / batch,
        "extra_gigabytes": peak / 1e9,
        "finite": all(bool(p.grad.isfinite().all()) for p in filter.parameters() if p.grad is not None),
    }


def _memory(name: str) -> int:
    """Bytes that Linux reports of this process: VmRSS now, VmHWM at most."""
    status = Path("/proc/self/status").read_text()
    return 1024 * int(next(line.split()[1] for line in status.splitlines() if line.startswith(f"{name}:")))


def _forget_peak() -> int:
    """Let the peak begin anew, from what is held now: those bytes. (A new process inherits its parent's peak.)"""
    Path("/proc/self/clear_refs").write_text("5")
    return _memory("VmRSS")


def _batch(problem: Problem, count: int, seed: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    noise = torch.randn(count, *problem.y.shape, generator=generator)
    return problem.y + 0.05 * noise
