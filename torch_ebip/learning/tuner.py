"""Tuning the noise of a filter by gradient, on top of the closed form.

Every training interaction is filtered by an ensemble that does not contain it, shown a random subset of its
sensors up to random horizons, and the forecasts made there are scored. Everything random in a step follows from
the seed and the number of the step, so a run that was interrupted continues to the same numbers.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping
from fnmatch import fnmatch
from pathlib import Path

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import own_modes
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.configuration import complete, configuration
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.objective import ForecastObjective
from torch_ebip.learning.partition import generator_of
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.settings import TuningResult, TuningSettings
from torch_ebip.recordings.demonstrations import Demonstrations


class Tuner:
    """Tunes a filter on the demonstrations that it is made of.

    Args:
        filter: made by `ebip`, `bip` and the like, changed in place; its prior's states are those of ``primitive``.
        demonstrations: N of them, what ``primitive`` was fitted to.
        primitive: of those demonstrations; default: fitted to them, on the filter's basis.
        objective: what is minimised; default: a `ForecastObjective` of the targets.
        targets: bool [D], the DoFs to forecast; default: those that the objective knows, or that are controlled.
        subsets: the sensors that may be shown together, bool [D] each, by name; one is drawn for each step;
            default: all that are no targets.
        settings: how.
        monitor: where to report; default: nowhere.
        checkpoint: path of a file to continue from if it exists, and to write after each validation.
        progress: called after each step with the step, the training loss and the last validation loss.
        ranks: the processes that share the work, each with arguments alike: each filters its part of the
            interactions, and all take the same steps. The first one writes the checkpoint. Draws belong to
            interactions, so the result does not depend on their number, beyond rounding (and beyond unequal
            numbers of measurements, if the objective has an innovation term).

    Raises:
        ValueError: demonstrations that are not the prior's, or on another layout; targets other than the objective's;
            fewer than two folds or too few demonstrations for them; no parameter matches ``only``; a checkpoint of
            another configuration; more processes than interactions a step or kept for validation.
    """

    def __init__(
        self,
        filter: InteractionFilter,
        demonstrations: Demonstrations,
        primitive: InteractionPrimitive | None = None,
        objective: ForecastObjective | None = None,
        targets: Tensor | None = None,
        subsets: Mapping[str, Tensor] | None = None,
        settings: TuningSettings | None = None,
        monitor: Monitor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        progress: Callable[[int, float, float], None] | None = None,
        ranks: Ranks | None = None,
    ) -> None:
        self.filter = filter
        task = complete(filter, demonstrations, primitive, objective, targets, subsets)
        self.settings = TuningSettings() if settings is None else settings
        self.ranks = Ranks() if ranks is None else ranks
        self.held_out = HeldOut(demonstrations, task, self.settings, self.ranks)
        self.primitive, self.objective, self.targets, self.subsets = task
        self.partition = self.held_out.partition
        self.layout = demonstrations.layout
        self.monitor, self.progress = monitor, progress
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.parameters = {
            name: parameter
            for name, parameter in filter.named_parameters()
            if any(fnmatch(name, pattern) for pattern in self.settings.only)
        }
        if not self.parameters:
            names = ", ".join(name for name, _ in filter.named_parameters())
            raise ValueError(f"no parameter matches {self.settings.only}; there are {names}")
        fewest = min(self.settings.batch_size, len(self.partition.training), len(self.partition.validating))
        if self.ranks.size > fewest:
            raise ValueError(f"{self.ranks.size} processes, but only {fewest} interactions to share among them")

    def run(self) -> TuningResult:
        """Tune, and leave the parameters of the best validation in the filter.

        Ctrl-C ends it where it is: the best so far is kept, and the result says so.
        """
        with own_modes(), torch.inference_mode(False), torch.enable_grad():
            return self._run()

    def _run(self) -> TuningResult:
        settings, began = self.settings, time.monotonic()
        optimizer = torch.optim.Adam(self.parameters.values(), lr=settings.learning_rate)
        history: dict[int, float] = {}
        best, start = self._snapshot(), 0
        if self.checkpoint is not None and self.checkpoint.exists():
            start, best, history = self._resume(optimizer)
        if self.monitor is not None:
            self.monitor.resume(start if history else -1)
        if not history:
            history[0] = self._validate(0)
        waited = _waited(history)
        step, interrupted = start, None
        try:
            while step < settings.steps and waited < settings.patience:
                step += 1
                loss = self._step(step, optimizer)
                if step % settings.validate_every == 0 or step == settings.steps:
                    history[step] = self._validate(step)
                    if history[step] == min(history.values()):
                        best = self._snapshot()
                    waited = _waited(history)
                    self._save(step, optimizer, best, history)
                if self.progress is not None:
                    self.progress(step, loss, history[max(history)])
        except KeyboardInterrupt:
            if self.ranks.size > 1:  # the others wait for this one
                raise
            interrupted = step
        self._restore(best)
        kept = min(history, key=lambda key: history[key])
        stopped = interrupted is None and step < settings.steps
        return TuningResult(kept, history, stopped, time.monotonic() - began, interrupted)

    def _step(self, step: int, optimizer: torch.optim.Optimizer) -> float:
        settings, began = self.settings, time.monotonic()
        generator = generator_of(settings.seed, step)
        picked = torch.randperm(len(self.partition.training), generator=generator, device="cpu")[
            : settings.batch_size
        ]
        name = list(self.subsets)[int(torch.randint(len(self.subsets), (), generator=generator, device="cpu"))]
        low, high = settings.horizons
        draws = torch.rand(len(picked), settings.horizons_each, generator=generator, device="cpu")
        picked = self.partition.training[picked]
        members = self.partition.members(picked, generator)
        shares = low + (high - low) * draws
        trial = self.held_out.filter(
            self.filter, self.held_out.show(picked, self.subsets[name], shares, members), step
        )
        terms = trial.terms(self.objective)
        terms["pull"] = settings.pull * self._distance()
        optimizer.zero_grad(set_to_none=True)
        weight = len(trial.shown.observed) / len(picked)
        (weight * torch.stack(list(terms.values())).sum()).backward()  # type: ignore[no-untyped-call]
        # The pull sees every parameter, so that all have a gradient.
        self.ranks.add_up([parameter.grad for parameter in self.parameters.values() if parameter.grad is not None])
        values = {key: float(value.detach()) for key, value in terms.items()}
        values["samples"] = int(trial.shown.observed.any(-1).sum()) / weight
        values = self.ranks.mean(values, weight)
        samples = values.pop("samples")
        total = sum(values.values())
        norm = float(nn.utils.clip_grad_norm_(self.parameters.values(), settings.clip, error_if_nonfinite=True))
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * 0.5 * (1 + math.cos(math.pi * step / (settings.steps + 1)))
        optimizer.step()
        if self.monitor is not None:
            scalars = {f"train/{key}": value for key, value in values.items()}
            scalars |= {"train/loss": total, f"train_subset/{name}": total, "gradient/norm": norm}
            scalars["throughput/samples_per_second"] = samples / (time.monotonic() - began)
            for key, parameter in self.parameters.items():
                if parameter.grad is not None:
                    scalars[f"gradient/{key}"] = float(parameter.grad.norm())
            self.monitor.scalars(scalars, step)
        return total

    def evaluate(self, interactions: Tensor | None = None, shares: Tensor | None = None) -> dict[str, float]:
        """Scores of the filter as it is, at the same horizons and draws whenever it is asked: see `HeldOut.evaluate`.

        Args:
            interactions: int64 [B], which demonstrations; default: those kept for validation.
            shares: [K], of an interaction that are shown; default: four evenly within the settings' horizons.
        """
        return self.held_out.evaluate(self.filter, interactions, shares)

    def _validate(self, step: int) -> float:
        scores = self.evaluate()
        if self.monitor is not None:
            spread, error = scores.pop("spread"), scores.pop("error")
            self.monitor.scalars({f"validation/{key}": value for key, value in scores.items()}, step)
            calibration = {"spread": spread, "error": error, "spread_over_error": spread / error}
            self.monitor.scalars({f"calibration/{key}": value for key, value in calibration.items()}, step)
            self.monitor.filter(self.filter, self.layout, step)
        return scores["loss"]

    def _distance(self) -> Tensor:
        """Mean squared distance from the start within each parameter, summed over parameters."""
        return torch.stack([parameter.square().mean() for parameter in self.parameters.values()]).sum()

    def _snapshot(self) -> dict[str, Tensor]:
        return {name: parameter.detach().clone() for name, parameter in self.parameters.items()}

    def _restore(self, values: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(values[name])

    def _save(
        self, step: int, optimizer: torch.optim.Optimizer, best: Mapping[str, Tensor], history: Mapping[int, float]
    ) -> None:
        if self.checkpoint is not None and self.ranks.first:
            content = {
                "step": step,
                "parameters": self._snapshot(),
                "best": dict(best),
                "optimizer": optimizer.state_dict(),
                "validation": dict(history),
            }
            save_checkpoint(self.checkpoint, configuration(self), content)

    def _resume(self, optimizer: torch.optim.Optimizer) -> tuple[int, dict[str, Tensor], dict[int, float]]:
        assert self.checkpoint is not None
        content = load_checkpoint(self.checkpoint, configuration(self))
        try:
            self._restore(content["parameters"])
            optimizer.load_state_dict(content["optimizer"])
            return content["step"], content["best"], content["validation"]
        except (AttributeError, IndexError, KeyError, RuntimeError, TypeError) as error:
            raise ValueError(f"{self.checkpoint}: not the state of this tuning: {error}") from error


def _waited(history: Mapping[int, float]) -> int:
    """How many validations ago the best one was."""
    best = min(history, key=lambda key: history[key])
    return sum(1 for step in history if step > best)
