"""Tuning the noise of a filter by gradient, on top of the closed form.

Every training interaction is filtered by an ensemble that does not contain it, shown a random subset of its
sensors up to random horizons, and the forecasts made there are scored. Everything random in a step follows from
the seed and the number of the step, so a run that was interrupted continues to the same numbers.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from torch_ebip.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.demonstrations import Demonstrations
from torch_ebip.filters.base import Filter, Trace
from torch_ebip.monitor import Monitor
from torch_ebip.objective import ForecastObjective
from torch_ebip.primitive import InteractionPrimitive
from torch_ebip.tuning.settings import TuningResult, TuningSettings


class Tuner:
    """Tunes a filter on the demonstrations that it is made of.

    Args:
        filter: made by `ebip`, `bip` and the like, changed in place; its prior's states are those of ``primitive``.
        demonstrations: N of them, what ``primitive`` was fitted to.
        primitive: for the targets.
        objective: what is minimised.
        targets: bool [D], the DoFs to forecast, the same that the objective knows.
        subsets: the sensors that may be shown together, bool [D] each, by name; one is drawn for each step.
        settings: how.
        monitor: where to report; default: nowhere.
        checkpoint: path of a file to continue from if it exists, and to write after each validation.
        progress: called after each step with the step, the training loss and the last validation loss.

    Raises:
        ValueError: demonstrations that are not the prior's; fewer than two folds or too few demonstrations for
            them; no parameter matches ``only``; a checkpoint of another configuration.
    """

    def __init__(
        self,
        filter: Filter,
        demonstrations: Demonstrations,
        primitive: InteractionPrimitive,
        objective: ForecastObjective,
        targets: Tensor,
        subsets: Mapping[str, Tensor],
        settings: TuningSettings | None = None,
        monitor: Monitor | None = None,
        checkpoint: str | os.PathLike[str] | None = None,
        progress: Callable[[int, float, float], None] | None = None,
    ) -> None:
        if len(primitive) != len(demonstrations):
            raise ValueError(f"{len(demonstrations)} demonstrations, but the primitive has {len(primitive)}")
        states = getattr(filter.prior, "states", None)
        if states is None or not torch.equal(states[:, 2:], primitive.weights):
            raise ValueError("the filter's prior does not hold the demonstrations of this primitive")
        self.filter, self.primitive, self.objective = filter, primitive, objective
        self.settings = TuningSettings() if settings is None else settings
        device = primitive.weights.device
        self.targets = targets.to(device)
        self.subsets = {name: subset.to(device) for name, subset in subsets.items()}
        self.monitor, self.progress = monitor, progress
        self.checkpoint = None if checkpoint is None else Path(checkpoint)
        self.layout = demonstrations.layout
        self.values, self.observed = demonstrations.pad()
        self.lengths = demonstrations.lengths.to(device)
        self.parameters = {
            name: parameter
            for name, parameter in filter.named_parameters()
            if any(fnmatch(name, pattern) for pattern in self.settings.only)
        }
        if not self.parameters:
            names = ", ".join(name for name, _ in filter.named_parameters())
            raise ValueError(f"no parameter matches {self.settings.only}; there are {names}")
        self._split(len(demonstrations))

    def run(self) -> TuningResult:
        """Tune, and leave the parameters of the best validation in the filter."""
        settings, began = self.settings, time.monotonic()
        optimizer = torch.optim.Adam(self.parameters.values(), lr=settings.learning_rate)
        history: dict[int, float] = {}
        best, start = self._snapshot(), 0
        if self.checkpoint is not None and self.checkpoint.exists():
            start, best, history = self._resume(optimizer)
        if not history:
            history[0] = self._validate(0)
        waited = _waited(history)
        step = start
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
        self._restore(best)
        kept = min(history, key=lambda key: history[key])
        return TuningResult(kept, history, step < settings.steps, time.monotonic() - began)

    def _split(self, count: int) -> None:
        """Validation interactions, training interactions, and for each the members of its ensemble."""
        settings = self.settings
        held = max(1, round(settings.validation * count))
        if settings.folds < 2 or count - held < 1 or count < 2 * settings.folds:
            raise ValueError(f"{count} demonstrations are too few for {settings.folds} folds and validation")
        order = torch.randperm(count, generator=torch.Generator().manual_seed(settings.seed))
        self.validating, self.training = order[:held], order[held:]
        part = torch.empty(count, dtype=torch.long)
        part[order] = torch.arange(count) % settings.folds
        others = [(part != fold).nonzero().squeeze(-1) for fold in range(settings.folds)]
        size = min(len(group) for group in others)
        self._part, self._others = part, torch.stack([group[:size] for group in others])

    def _members(self, interactions: Tensor, generator: torch.Generator) -> Tensor:
        """Indices [B, E] of demonstrations outside each interaction's own fold."""
        others = self._others[self._part[interactions]]
        size = self.settings.n_members
        if size is None or size == others.shape[1]:
            return others
        if size > others.shape[1]:
            return others.gather(1, torch.randint(others.shape[1], (len(others), size), generator=generator))
        return others.gather(1, torch.rand(others.shape, generator=generator).argsort(-1)[:, :size])

    def _filter(
        self, interactions: Tensor, subset: Tensor, shares: Tensor, generator: torch.Generator
    ) -> tuple[Filter, Trace, tuple[Any, ...]]:
        """Filter some interactions [B], shown a subset [D] of sensors, up to shares [B, K] of their length."""
        kept_dofs = subset | self.targets
        stride, device = self.settings.thinning, self.lengths.device
        members = self._members(interactions, generator).to(device)
        interactions, shares = interactions.to(device), shares.to(device)
        part = self.filter.restrict(kept_dofs, stride)
        last = (self.lengths[interactions] - 1).unsqueeze(-1)
        steps = torch.minimum((shares * last / stride).round().long(), last // stride)
        length = int(steps.max()) + 1
        y = self.values[interactions, ::stride][:, :length][..., kept_dofs]
        observed = self.observed[interactions, ::stride][:, :length][..., kept_dofs] & subset[kept_dofs]
        within = torch.arange(length, device=steps.device).view(1, -1, 1) <= steps.amax(-1).view(-1, 1, 1)
        observed = observed & within
        state = part.initial_state((len(interactions),), members, generator)
        segment = self.settings.segment if torch.is_grad_enabled() else None
        trace = part(
            y, observed, state=state, generator=generator, keep=steps, segment=segment or None, project=False
        )
        now = (steps * stride / last).to(y)
        weights = self.primitive.weights[interactions, None, None, :]
        truth = self.primitive.basis.project(self.objective.phases_ahead(now), weights)[..., self.targets]
        return part, trace, (observed, truth, now, self.targets[kept_dofs])

    def _step(self, step: int, optimizer: torch.optim.Optimizer) -> float:
        settings, began = self.settings, time.monotonic()
        generator = torch.Generator().manual_seed(_mix(settings.seed, step))
        picked = torch.randperm(len(self.training), generator=generator)[: settings.batch_size]
        name = list(self.subsets)[int(torch.randint(len(self.subsets), (), generator=generator))]
        low, high = settings.horizons
        draws = torch.rand(len(picked), settings.horizons_each, generator=generator)
        part, trace, context = self._filter(
            self.training[picked], self.subsets[name], low + (high - low) * draws, generator
        )
        terms = self.objective(part, trace, *context)
        terms["pull"] = settings.pull * self._distance()
        loss = torch.stack(list(terms.values())).sum()
        optimizer.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        norm = float(nn.utils.clip_grad_norm_(self.parameters.values(), settings.clip, error_if_nonfinite=True))
        for group in optimizer.param_groups:
            group["lr"] = settings.learning_rate * 0.5 * (1 + math.cos(math.pi * step / (settings.steps + 1)))
        optimizer.step()
        if self.monitor is not None:
            samples = int(context[0].any(-1).sum())
            scalars = {f"train/{key}": float(value.detach()) for key, value in terms.items()}
            total = float(loss.detach())
            scalars |= {"train/loss": total, f"train_subset/{name}": total, "gradient/norm": norm}
            scalars["throughput/samples_per_second"] = samples / (time.monotonic() - began)
            for key, parameter in self.parameters.items():
                if parameter.grad is not None:
                    scalars[f"gradient/{key}"] = float(parameter.grad.norm())
            self.monitor.scalars(scalars, step)
        return float(loss.detach())

    @torch.no_grad()
    def evaluate(self, interactions: Tensor | None = None, shares: Tensor | None = None) -> dict[str, float]:
        """Scores of the filter as it is, always at the same horizons and draws; nothing is reported or changed.

        Args:
            interactions: int64 [B], which demonstrations; default: those kept for validation. Each is filtered
                by an ensemble that does not contain it.
            shares: [K], of an interaction that are shown; default: four evenly within the settings' horizons.

        Returns:
            ``loss``, its terms, ``subset/NAME`` the loss of each subset, and ``spread`` and ``error`` of the
            forecasts of the end in units of the targets' spread over the demonstrations.
        """
        interactions = self.validating if interactions is None else interactions
        low, high = self.settings.horizons
        shares = low + (high - low) * (torch.arange(4) + 0.5) / 4 if shares is None else shares
        totals: dict[str, list[float]] = {}
        spreads = []
        for name, subset in self.subsets.items():
            generator = torch.Generator().manual_seed(_mix(self.settings.seed, -1))
            part, trace, context = self._filter(interactions, subset, shares.expand(len(interactions), -1), generator)
            terms = self.objective(part, trace, *context)
            for key, value in terms.items():
                totals.setdefault(key, []).append(float(value))
            totals.setdefault(f"subset/{name}", []).append(sum(float(value) for value in terms.values()))
            spreads.append(self.objective.spread_and_error(part, trace, context[1], context[3]))
        means = {key: sum(values) / len(values) for key, values in totals.items()}
        means["loss"] = sum(value for key, value in means.items() if not key.startswith("subset/"))
        means["spread"], means["error"] = torch.stack(spreads).square().mean(0).sqrt().tolist()
        return means

    def _validate(self, step: int) -> float:
        scores = self.evaluate()
        if self.monitor is not None:
            spread, error = scores.pop("spread"), scores.pop("error")
            scalars = {f"validation/{key}": value for key, value in scores.items()}
            scalars |= {"calibration/spread": spread, "calibration/error": error}
            scalars["calibration/spread_over_error"] = spread / error
            self.monitor.scalars(scalars, step)
            self.monitor.filter(self.filter, self.layout, step)
        return scores["loss"]

    def _distance(self) -> Tensor:
        """Mean squared distance from the start within each parameter, summed over parameters."""
        return torch.stack([parameter.square().mean() for parameter in self.parameters.values()]).sum()

    def _configuration(self) -> dict[str, Any]:
        settings = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.settings).items()}
        shapes: Sequence[str] = [f"{name} {list(p.shape)}" for name, p in self.parameters.items()]
        interactions = int(self.lengths.sum())
        masks = {name: mask.tolist() for name, mask in {**self.subsets, "targets": self.targets}.items()}
        return {
            **settings,
            "parameters": list(shapes),
            "samples": interactions,
            "masks": masks,
            "filter": f"{type(self.filter).__name__}({self.filter.extra_repr()})",
            "objective_weights": list(self.objective.weights),
            "filter_buffers": _fingerprint(self.filter),
            "objective_buffers": _fingerprint(self.objective),
        }

    def _snapshot(self) -> dict[str, Tensor]:
        return {name: parameter.detach().clone() for name, parameter in self.parameters.items()}

    def _restore(self, values: Mapping[str, Tensor]) -> None:
        with torch.no_grad():
            for name, parameter in self.parameters.items():
                parameter.copy_(values[name])

    def _save(
        self, step: int, optimizer: torch.optim.Optimizer, best: Mapping[str, Tensor], history: Mapping[int, float]
    ) -> None:
        if self.checkpoint is not None:
            content = {
                "step": step,
                "parameters": self._snapshot(),
                "best": dict(best),
                "optimizer": optimizer.state_dict(),
                "validation": dict(history),
            }
            save_checkpoint(self.checkpoint, self._configuration(), content)

    def _resume(self, optimizer: torch.optim.Optimizer) -> tuple[int, dict[str, Tensor], dict[int, float]]:
        assert self.checkpoint is not None
        content = load_checkpoint(self.checkpoint, self._configuration())
        self._restore(content["parameters"])
        optimizer.load_state_dict(content["optimizer"])
        return content["step"], content["best"], content["validation"]


def _fingerprint(module: nn.Module) -> dict[str, str]:
    """The norm of every buffer to four digits: starting points, prior states, scales; blind to rounding."""
    return {name: f"{float(buffer.double().norm()):.4g}" for name, buffer in module.named_buffers()}


def _waited(history: Mapping[int, float]) -> int:
    """How many validations ago the best one was."""
    best = min(history, key=lambda key: history[key])
    return sum(1 for step in history if step > best)


def _mix(seed: int, step: int) -> int:
    """A seed of its own for each step; neighbouring steps and seeds do not share streams."""
    return (seed * 1_000_003 + step * 7_919 + 17) % (2**63)
