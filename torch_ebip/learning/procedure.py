"""The stages of `learn`, one after the other, and what is kept of them."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from torch_ebip.common.files import write_json
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.basis.selection import selection_table
from torch_ebip.interaction.basis.stacked import StackedBasis
from torch_ebip.interaction.filter_kinds import InteractionEnsembleFilter
from torch_ebip.kinematics import RobotArm
from torch_ebip.learning.caution import familiar, learn_caution
from torch_ebip.learning.drawing import Drawn
from torch_ebip.learning.horizons import horizon_name
from torch_ebip.learning.interaction_model import NAME, InteractionModel
from torch_ebip.learning.losses import ForwardKinematicsLoss
from torch_ebip.learning.monitor import Monitor
from torch_ebip.learning.pacing import learn_pace
from torch_ebip.learning.partition import generator_of
from torch_ebip.learning.place import enter, fingerprint
from torch_ebip.learning.preparing import Asked, prepared
from torch_ebip.learning.progress import Reporter
from torch_ebip.learning.ranks import Ranks
from torch_ebip.learning.reading_out import learn_readout
from torch_ebip.learning.recognising import learn_recognition
from torch_ebip.learning.remaining import remaining_error
from torch_ebip.learning.report import STAGES, Report, described, verdict_of, versions
from torch_ebip.learning.settings import TuningSettings
from torch_ebip.learning.stages import Scores, reference_scores, score
from torch_ebip.learning.starts import FACTORS, TRIES, Start, best_factor, best_start, scaled, tunable
from torch_ebip.learning.tuner import Tuner
from torch_ebip.recordings.demonstrations import Demonstrations

PROCEDURE = 7  # what another edition of this file began in a folder is not gone on with
FEWEST = 10
"""Demonstrations below which there is no gradient: those kept for validation would say nothing."""
DECIDING, MOST = 200, 100
"""Interactions that decide about a read-out, and about recognition, at most."""
WEIGHING = ("start", "gradient")
"""Stages whose filters remember what they saw, which a model of labelled interactions must."""


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
    analogues: bool
    expert: bool
    pace: bool
    periodic: bool | Sequence[str] | None
    ahead: tuple[float, ...]
    memories: int
    chances: dict[str, float]
    ranks: Ranks

    @property
    def tunes(self) -> bool:
        """Whether there is a gradient."""
        return self.steps > 0 and len(self.known) >= FEWEST

    @property
    def work(self) -> int:
        """Units: every filter that is tried, and every step."""
        return len(FACTORS) + 2 + TRIES + (self.steps if self.tunes else 0) + 6

    def prepare(
        self, arm: RobotArm | ForwardKinematicsLoss | None, joints: str | None, basis: StackedBasis | None
    ) -> None:
        """Basis, phase, primitive, objective."""
        self.began = time.monotonic()
        given = self.known.labels
        asked = Asked(self.targets, self.subsets, self.ahead, arm, joints)
        made = prepared(self.known, asked, basis, self.periodic, self.settings, self.ranks)
        self.known, self.primitive, self.task, self.held_out = made.known, made.primitive, made.task, made.held_out
        self.ranking, self.remarks, self.course = made.ranking, list(made.remarks), made.course
        labels = self.known.labels
        self.groups = {} if labels is None or labels == given else {label: labels.count(label) for label in labels}
        self.deciding = self.held_out.partition.order[: max(DECIDING, len(self.scored))]

    def enter(self, place: Path) -> InteractionModel | None:
        """See `place.enter`."""
        basis = None if self.ranking is None else selection_table(self.ranking)
        return enter(place, self.identity(), basis, self.ranks)

    def identity(self) -> dict[str, Any]:
        """Everything on which the result depends, as JSON gives it back."""
        objective = self.task.objective
        return {
            "procedure": PROCEDURE,
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
            "analogues": self.analogues,
            "expert": self.expert,
            "pace": self.pace,
            "periodic": self.primitive.periodic,
            "ahead": [horizon_name(a) for a in self.ahead],
            "memories": self.memories,
            "chances": self.chances,
            "scan": self.scan,
            "steps": self.steps,
            "settings": {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(self.settings).items()},
        }

    def go(self, place: Path | None, monitor: Monitor | None, reporter: Reporter) -> InteractionModel:
        """All stages; the best of them."""
        self.place, self.monitor, self.reporter = place, monitor, reporter
        if monitor is not None:
            monitor.text("configuration", "\n".join(f"- `{key}`: {value}" for key, value in self.identity().items()))
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
        interrupted |= self.said.get("interrupted_at") is not None
        names = [name for name in self.filters if self.known.labels is None or name in WEIGHING] or list(self.filters)
        chosen = min(names, key=lambda name: self.scores[name]["remaining"])
        drawn, filter = None, self.filters[chosen]
        if not interrupted:
            try:
                drawn = self._draw(filter)
                self._recognise(filter)
                self._doubt(filter)
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
        start = best_start(held_out, factor, self.scan, self.members, record, tick, self.memories)
        self.said |= {"factor": factor, "start": start._asdict()}
        self._stage("start", tunable(primitive, start, self.members))

    def _stage(self, name: str, filter: InteractionEnsembleFilter) -> None:
        self.scores[name] = score(self.held_out, filter, self.scored)
        self.scores[name]["remaining"] = remaining_error(self.held_out, filter, self.scored)
        self.filters[name] = filter
        scores = self.scores
        self.reporter.tick(text=f"{name} {scores[name]['error']:.3f}, mean {scores['mean']['error']:.3f}")

    def _tune(self) -> None:
        """The gradient, from the best start."""
        self.reporter.stage("gradient")
        filter = tunable(self.primitive, Start(**self.said["start"]), self.members)
        if self.shrink:  # What is minimised is what will be said.
            filter.readout = learn_readout(self.held_out, filter, self.deciding, self.scored, None).drawn.readout
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
        filter.readout = None
        self._stage("gradient", filter)

    def _draw(self, filter: InteractionEnsembleFilter) -> Drawn:
        """See `learn_readout`."""
        self.reporter.stage("read-out")
        make = Analogues.of if self.shrink and self.analogues else None
        found = learn_readout(self.held_out, filter, self.deciding, self.scored, make, expert=self.expert)
        if self.shrink:
            self.said |= found.said
            self.scores |= found.scores
            self.remarks.extend(found.remarks)
        else:
            filter.readout = None
        self.reporter.tick()
        return found.drawn

    def _recognise(self, filter: InteractionEnsembleFilter) -> None:
        """How sure the filter may be of a label."""
        labels = self.known.labels
        if labels is not None and len(set(labels)) > 1:
            order = torch.randperm(len(labels), generator=generator_of(self.settings.seed, -2), device="cpu")[:MOST]
            filter.recognition, self.said["recognition"] = learn_recognition(self.held_out, filter, labels, order)

    def _doubt(self, filter: InteractionEnsembleFilter) -> None:
        """What would surprise the filter, and what it then says; whether people may pause."""
        self.reporter.stage("surprise")
        self.said["surprise"], remarks = learn_caution(self.held_out, self.known, filter, self.chances)
        self.remarks.extend(remarks)
        if not remarks and self.monitor is not None:
            self.monitor.values("surprise", familiar(self.held_out, filter, self.scored))
        if self.pace and len(self.known) >= FEWEST:
            self.said["pace"] = learn_pace(self.held_out, self.known, filter)
        self.reporter.tick()

    def _finish(self, chosen: str, drawn: Drawn | None, interrupted: bool) -> InteractionModel:
        """Report and keep."""
        filter = self.filters[chosen]
        reason = None
        if self.steps and not self.tunes:
            reason = f"no gradient: {len(self.known)} demonstrations are too few to tell when to stop"
        reason = "interrupted, this is the best so far" if interrupted else reason
        gain = None if drawn is None else drawn.gain if self.shrink else drawn.gain_alone
        stages = {name: self.scores[name] for name in STAGES if name in self.scores}
        report = Report(
            {
                "verdict": verdict_of(stages, chosen, len(self.scored), gain, reason),
                "chosen": chosen,
                "stages": stages,
                "interactions": len(self.scored),
                "demonstrations": len(self.known),
                "horizons": list(self.task.objective.horizons or ()),
                "remarks": self.remarks,
                "groups": self.groups,
                "interrupted": interrupted,
                "course": self.course,
                **self.said,
                **described(self.known.layout, self.primitive.basis),
                "settings": self.identity(),
                "versions": versions(),
                "seconds": round(time.monotonic() - self.began, 1),
            }
        )
        model = InteractionModel(filter, self.primitive, report, self.targets)
        if self.place is not None and self.ranks.first and not report["interrupted"]:
            write_json(self.place / "report.json", report.plain())
            model.save(self.place / NAME)
        return model
