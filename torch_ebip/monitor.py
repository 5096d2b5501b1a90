"""TensorBoard sink: the one place that knows SummaryWriter."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from torch_ebip.filters.evidence import EvidenceWeighting
from torch_ebip.filters.localisation import Localisation
from torch_ebip.layout import Layout
from torch_ebip.noise import AboveOne, MeasurementNoise, PhaseNoise, RobustWeights, WeightNoise

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Monitor:
    """Writes what happens during tuning where TensorBoard finds it.

    Args:
        folder: of the events; created on construction.

    Use it as a context manager, or call `close`.
    """

    def __init__(self, folder: str | os.PathLike[str]) -> None:
        # Imported here: TensorBoard takes half a second that nobody should wait for who does not watch.
        from torch.utils.tensorboard import SummaryWriter

        self.folder = str(folder)
        self._goes_on = any(Path(folder).glob("events.out.tfevents.*"))
        self._writer: Any = SummaryWriter(self.folder)

    def __enter__(self) -> Monitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def resume(self, step: int) -> None:
        """Take back what an interrupted run wrote here after this step, since it will be written again."""
        if not self._goes_on or self._writer is None:
            return
        from torch.utils.tensorboard import SummaryWriter

        self._send("close")
        try:
            self._writer = SummaryWriter(self.folder, purge_step=step + 1)
        except OSError as error:
            self._writer = None
            warnings.warn(f"{self.folder}: what TensorBoard shows ends here: {error}", stacklevel=2)

    def scalars(self, values: Mapping[str, float], step: int) -> None:
        """One point at this step for each of some values; a slash in a name groups them."""
        for name, value in values.items():
            self._send("add_scalar", name, value, step)

    def text(self, name: str, markdown: str) -> None:
        """A text tab of this name, written in markdown."""
        self._send("add_text", name, markdown)

    def figure(self, name: str, figure: Figure, step: int) -> None:
        """A matplotlib figure of this name and step, which is closed."""
        self._send("add_figure", name, figure, step, close=True)

    def hyperparameters(self, settings: Mapping[str, Any], metrics: Mapping[str, float]) -> None:
        """The HParams tab: settings and the final metrics they led to."""
        plain = {name: v if isinstance(v, bool | int | float | str) else str(v) for name, v in settings.items()}
        self._send("add_hparams", plain, dict(metrics), run_name=".")

    def filter(self, filter: nn.Module, layout: Layout, step: int) -> None:
        """The constrained noise of a filter on a layout, at this step: see `noise_scalars`."""
        self.scalars(noise_scalars(filter, layout), step)

    def close(self) -> None:
        """Write everything out."""
        self._send("close")

    def _send(self, action: str, *arguments: Any, **options: Any) -> None:
        """Have it written; a disk that fails ends the record, with a warning, and not what it is about."""
        if self._writer is None:
            return
        try:
            getattr(self._writer, action)(*arguments, **options)
        except OSError as error:
            self._writer = None
            warnings.warn(f"{self.folder}: what TensorBoard shows ends here: {error}", stacklevel=3)


def noise_scalars(filter: nn.Module, layout: Layout) -> dict[str, float]:
    """Constrained values of everything a filter on a layout can learn, by name.

    - ``R/MODALITY``: geometric mean over its DoFs of the standard deviation, in its unit, and ``R_factor/DOF``
      the variance relative to the start;
    - ``R_phase/MODALITY/PHASE``: factor on the variance at that phase, ``R_robust/KIND`` the scale of its tails;
    - ``Q/...``: acceleration of the phase (1/s^2) and rates of the weights (1/sqrt(s));
    - ``localisation/A~B``, ``inflation`` and ``weighting/...``, see `EvidenceWeighting`.
    """
    values: dict[str, float] = {}
    with torch.no_grad():
        for module in filter.modules():
            if isinstance(module, MeasurementNoise):
                values |= _measurement(module, layout)
            elif isinstance(module, PhaseNoise):
                values["Q/phase_acceleration"] = float(module.acceleration.value)
                values["Q/phase_coupling"] = float(module.coupling.value)
                values["Q/phase_independent"] = float(module.independent.value)
            elif isinstance(module, WeightNoise):
                rates = zip(layout.names, module.rates.value.tolist(), strict=True)
                values |= {f"Q/weights/{name}": rate for name, rate in rates}
            elif isinstance(module, Localisation):
                matrix = module.matrix
                for i, first in enumerate(module.names):
                    for j in range(i + 1, len(module.names)):
                        values[f"localisation/{first}~{module.names[j]}"] = float(matrix[i, j])
            elif isinstance(module, EvidenceWeighting):
                values["weighting/sharpness"] = float(module.sharpness.value)
                values["weighting/forgetting"] = float(module.forgetting.value)
                values["weighting/slope"] = float(module.slope.value)
                values["weighting/wander"] = float(module.wander.value)
                factors = zip(layout.names, module.factor.value.tolist(), strict=True)
                values |= {f"weighting/factor/{name}": factor for name, factor in factors}
            elif isinstance(module, AboveOne):
                values["inflation"] = float(module.value)
            elif isinstance(module, RobustWeights):
                values[f"R_robust/{type(module).__name__}"] = float(module.scale.value)
    return values


def _measurement(noise: MeasurementNoise, layout: Layout) -> dict[str, float]:
    variance = noise.variance.value
    factor = variance / noise.variance.start
    values = {f"R_factor/{dof}": value for dof, value in zip(layout.dofs, factor.tolist(), strict=True)}
    for modality in layout.modalities:
        part = layout.slice(modality.name)
        values[f"R/{modality.name}"] = float((0.5 * variance[part].log().mean()).exp())
    if noise.context is not None:
        phases = torch.linspace(0, 1, 5, dtype=variance.dtype, device=variance.device)
        gates = noise.log_gate(phases).exp()
        for i, modality in enumerate(layout.modalities):
            for phase, gate in zip(phases.tolist(), gates[:, i].tolist(), strict=True):
                values[f"R_phase/{modality.name}/{phase:.2f}"] = gate
    return values
