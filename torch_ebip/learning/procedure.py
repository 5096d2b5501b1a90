"""The stages of `learn`, one after the other, and what is kept of them."""

from __future__ import annotations

import hashlib
import platform
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torch_ebip.common.files import atomic_write, read_json, write_json
from torch_ebip.interaction.basis.selection import rank_candidates, select_basis, selection_table
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.filters import InteractionEnsembleFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.configuration import Task
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.interaction_model import NAME, InteractionModel
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.objective import ForecastObjective, Weights, joints_of
from torch_ebip.learning.progress import Reporter
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.report import STAGES, Report, verdict_of
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.learning.stages import Drawn, Scores, learn_shrinkage, reference_scores, score
from torch_ebip.learning.starts import FACTORS, SHARPNESSES, Start, best_factor, best_start, scaled, tunable
from torch_ebip.learning.tuner import Tuner
from torch_ebip.recordings.demonstrations import Demonstrations

FEWEST = 10
"""Demonstrations below which there is no gradient: those kept for validation would say nothing."""
MOST = 100
"""Interactions that decide about shrinkage, at most."""
RECORD = "learning.json"
"""Of what a folder's learning is one of."""
LEFT = ("checkpoint.pt", "report.json", "scan_scaled.json", "scan_tunable.json")
"""What else a learning leaves there."""


@dataclass
class Procedure:
    """One call of `learn`."""

    known: Demonstrations
    targets: tuple[str, ...]
    subsets: Mapping[str, tuple[str, ...]]
    settings: TuningSettings
    members: int | None
    scan: int
    steps: int
    shrink: bool
    ranks: Ranks

    @property
    def tunes(self) -> bool:
        """Whether there is a gradient."""
        return self.steps > 0 and len(self.known) >= FEWEST

    @property
    def work(self) -> int:
        """Units: every filter that is tried, and every step."""
        tried = len(FACTORS) + 2 + 3 * len(SHARPNESSES)
        return tried + (self.steps if self.tunes else 0) + 5

    def prepare(
        self, arm: RobotArm | ForwardKinematicsLoss | None, joints: str | None, basis: StackedBasis | None
    ) -> None:
        """Basis, primitive, objective."""
        self.began = time.monotonic()
        layout = self.known.layout
        targets = layout.mask(self.targets)
        self.ranking = None if basis is not None else rank_candidates(self.known)
        basis = select_basis(self.known, ranking=self.ranking) if basis is None else basis
        self.primitive = primitive = InteractionPrimitive.fit(self.known, basis).to(self.ranks.device)
        targets = targets.to(primitive.weights.device)
        if arm is None:
            objective = ForecastObjective(primitive, targets)
        else:
            loss = arm if isinstance(arm, ForwardKinematicsLoss) else ForwardKinematicsLoss(arm, rotation_weight=0.1)
            dofs = layout.mask(joints_of(loss.arm, layout, self.targets) if joints is None else [joints])
            objective = ForecastObjective(
                primitive, targets, weights=Weights(tool=1.0), arm=loss, arm_dofs=dofs.to(targets.device)
            )
        masks = {name: layout.mask(names).to(targets.device) for name, names in self.subsets.items()}
        self.task = Task(primitive, objective, targets, masks)
        self.held_out = HeldOut(self.known, self.task, self.settings, self.ranks)

    def enter(self, place: Path) -> InteractionModel | None:
        """The model of a folder where this learning was finished; otherwise the folder becomes one of it.

        Raises:
            ValueError: a folder of another learning.
        """
        record, ours = place / RECORD, self.identity()
        if record.exists():
            theirs = read_json(record)
            differing = [key for key in ours if not isinstance(theirs, dict) or theirs.get(key) != ours[key]]
            if differing:
                there = theirs.get(differing[0]) if isinstance(theirs, dict) else theirs
                raise ValueError(
                    f"{place}: another learning's folder: {differing[0]} is {str(there)[:200]} there and "
                    f"{str(ours[differing[0]])[:200]} here"
                )
        elif self.ranks.first:
            there = [name for name in (NAME, *LEFT) if (place / name).exists()]
            if there:
                raise ValueError(
                    f"{place}: holds {', '.join(there)}, but not {RECORD}: nothing says of which learning"
                )
            write_json(record, ours)
            if self.ranking is not None:
                with atomic_write(place / "basis.txt") as file:
                    file.write(f"{selection_table(self.ranking)}\n".encode())
        self.ranks.from_first(lambda: None)  # none goes on before the record is there
        finished = record.exists() and (place / NAME).exists()
        return InteractionModel.load(place / NAME) if finished else None

    def identity(self) -> dict[str, Any]:
        """Everything on which the result depends, as JSON gives it back."""
        objective = self.task.objective
        return {
            "columns": self.primitive.meant(),
            "demonstrations": len(self.known),
            "values": fingerprint(self.known),
            "labels": None if self.known.labels is None else list(self.known.labels),
            "basis": str(self.primitive.basis),
            "targets": list(self.targets),
            "subsets": {name: list(names) for name, names in self.subsets.items()},
            "members": self.members,
            "arm": None if objective.arm is None else f"{objective.arm}; {objective.arm.arm.meant()}",
            "joints": objective.joints,
            "shrink": self.shrink,
            "scan": self.scan,
            "steps": self.steps,
            "settings": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.settings).items()},
        }

    def go(self, place: Path | None, monitor: Monitor | None, reporter: Reporter) -> InteractionModel:
        """All stages; the best of them."""
        self.place, self.monitor, self.reporter = place, monitor, reporter
        if monitor is not None:
            lines = "\n".join(f"- `{key}`: {value}" for key, value in self.identity().items())
            monitor.text("configuration", lines)
            if self.ranking is not None:
                monitor.text("basis", f"```\n{selection_table(self.ranking)}\n```")
        self.filters: dict[str, InteractionEnsembleFilter] = {}
        self.scores: dict[str, Scores] = {}
        self.said: dict[str, Any] = {}
        interrupted = False
        try:
            self._search()
            if self.tunes:
                self._tune()
        except KeyboardInterrupt:
            if not self.filters:
                raise
            interrupted = True
        interrupted = interrupted or self.said.get("interrupted_at") is not None
        chosen = min(self.filters, key=lambda name: self.scores[name]["loss"])
        drawn = None
        if not interrupted:
            try:
                drawn = self._draw(self.filters[chosen])
            except KeyboardInterrupt:
                interrupted = True
        return self._finish(chosen, drawn, interrupted)

    @property
    def scored(self) -> Tensor:
        """int64 [B], the interactions that every stage is scored on."""
        return self.held_out.partition.validating if self.tunes else torch.arange(len(self.known), device="cpu")

    def _search(self) -> None:
        """References, closed form, factor, start."""
        primitive, held_out, tick = self.primitive, self.held_out, self.reporter.tick
        self.reporter.stage("closed form")
        closed = scaled(primitive, 1.0, self.members)
        mean, nearest = reference_scores(held_out, self.scored)
        self.scores |= {"mean": mean, "nearest": nearest}
        tick()
        self._stage("closed_form", closed)
        self.reporter.stage("factor")
        record = None if self.place is None else self.place / "scan_scaled.json"
        factor = best_factor(
            held_out, lambda known, factor: scaled(known, factor, self.members), self.scan, FACTORS, record, tick
        )
        self._stage("factor", scaled(primitive, factor, self.members))
        self.reporter.stage("start")
        record = None if self.place is None else self.place / "scan_tunable.json"
        start = best_start(held_out, factor, self.scan, self.members, record, tick)
        self.said |= {"factor": factor, "start": start._asdict()}
        self._stage("start", tunable(primitive, start, self.members))

    def _stage(self, name: str, filter: InteractionEnsembleFilter) -> None:
        self.scores[name] = score(self.held_out, filter, self.scored)
        self.filters[name] = filter
        scores = self.scores
        self.reporter.tick(text=f"{name} {scores[name]['error']:.3f}, mean {scores['mean']['error']:.3f}")

    def _tune(self) -> None:
        """The gradient, from the best start."""
        self.reporter.stage("gradient")
        filter = tunable(self.primitive, Start(**self.said["start"]), self.members)
        last = 0

        def show(step: int, loss: float, validation: float) -> None:
            """Pass on how it goes."""
            nonlocal last
            self.reporter.tick(step - last, f"train {loss:.3f}, validation {validation:.3f}")
            last = step

        checkpoint = None if self.place is None else self.place / "checkpoint.pt"
        tuner = Tuner(filter, self.known, *self.task, self.settings, self.monitor, checkpoint, show, self.ranks)
        result = tuner.run()
        self.said |= {
            "best_step": result.best_step,
            "stopped_early": result.stopped_early,
            "validation": {str(step): loss for step, loss in result.validation.items()},
            "interrupted_at": result.interrupted_at,
        }
        self.scores["gradient"] = score(self.held_out, filter, self.scored)
        self.filters["gradient"] = filter

    def _draw(self, filter: InteractionEnsembleFilter) -> Drawn:
        """How far the forecasts of a filter are drawn towards the mean."""
        self.reporter.stage("shrinkage")
        # Those that are scored first: they are the beginning of the order.
        partition = self.held_out.partition
        some = torch.cat([partition.validating, partition.training])[: max(MOST, len(self.scored))]
        drawn = learn_shrinkage(self.held_out, filter, some, self.scored)
        if self.shrink:
            filter.readout = drawn.readout
            self.said["shrinkage"] = drawn.shares
            self.scores["shrinkage"] = {"error": drawn.error}
        self.reporter.tick()
        return drawn

    def _finish(self, chosen: str, drawn: Drawn | None, interrupted: bool) -> InteractionModel:
        """Report and keep."""
        filter = self.filters[chosen]
        reason = None
        if interrupted:
            reason = "interrupted, this is the best so far"
        elif self.steps and not self.tunes:
            reason = f"no gradient: {len(self.known)} demonstrations are too few to tell when to stop"
        gain = None if drawn is None else drawn.gain if self.shrink else drawn.gain_alone
        names = [name for name in STAGES if name in self.scores]
        stages = {name: self.scores[name] for name in names}
        layout, basis = self.known.layout, self.primitive.basis
        report = Report(
            {
                "verdict": verdict_of(stages, chosen, len(self.scored), gain, reason),
                "chosen": chosen,
                "stages": stages,
                "interactions": len(self.scored),
                "demonstrations": len(self.known),
                "interrupted": interrupted,
                **self.said,
                "basis": {m.name: str(basis.bases[layout.slice(m.name).start]) for m in layout.modalities},
                "n_weights": basis.n_weights,
                "settings": self.identity(),
                "versions": {
                    "python": platform.python_version(),
                    "torch": str(torch.__version__),
                    "numpy": np.__version__,
                },
                "seconds": round(time.monotonic() - self.began, 1),
            }
        )
        model = InteractionModel(filter, self.primitive, report, self.targets, self.known.labels)
        if self.place is not None and self.ranks.first and not report["interrupted"]:
            write_json(self.place / "report.json", report.plain())
            model.save(self.place / NAME)
        return model


def fingerprint(demonstrations: Demonstrations) -> str:
    """Sixteen hexadecimal digits that change with any value, their order, their number or their kind."""
    digest = hashlib.sha256()
    for trajectory in demonstrations:
        values = trajectory.detach().cpu().contiguous()
        digest.update(f"{values.dtype} {list(values.shape)}".encode())
        digest.update(values.nan_to_num(nan=1e30).numpy().tobytes())
    return digest.hexdigest()[:16]
