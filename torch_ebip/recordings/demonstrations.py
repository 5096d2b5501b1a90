"""Demonstrations: ragged recordings of one interaction, all on one layout."""

from __future__ import annotations

import math
import os
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from torch_ebip.common.arguments import as_count, as_indices, as_number
from torch_ebip.recordings.arrays import LIMIT, Array, Recordings, read_npz, write_npz
from torch_ebip.recordings.folders import CSV_LIMIT, read_folder
from torch_ebip.recordings.layout import Layout
from torch_ebip.recordings.look import RecordingsReport, look
from torch_ebip.recordings.resampling import How
from torch_ebip.recordings.streams import Interaction, gridded
from torch_ebip.recordings.trajectory import checked


class Demonstrations:
    """N recordings of an interaction from its beginning (phase 0) to its end (phase 1).

    Args:
        layout: what the D columns are.
        trajectories: N tensors [T_i, D] in the units of the layout, sampled evenly; NaN = not measured. Arrays, lists
            and data frames (whose columns are taken by the layout's names) are taken as well. They are data: a graph
            that they carry is left behind.
        rate: samples a second, Hz.
        columns: further facts, one row a demonstration (release times, names), kept under their names.
        labels: which interaction each demonstration shows, N names; kept as the column ``labels``.
        remarks: sentences about what was wrong with them, of who read them; `report` shows them, files do not keep
            them.

    Attributes:
        layout: in SI units: values in others that a factor converts (``"mm"``, ``"deg"``, ``"cm/s^2"``; ``"g"`` is
            the standard gravity) are converted. Angles have their centre, and are continuous.

    Raises:
        ValueError: no demonstration; a trajectory that is not [T >= 2, D], has no measured value or an
            infinite one; a rate that is not a positive number; a column without N rows; labels that are not N names;
            a unit that is not SI and that no factor converts, such as ``"degC"``.
    """

    def __init__(
        self,
        layout: Layout,
        trajectories: Sequence[Tensor | npt.ArrayLike],
        rate: float,
        columns: Mapping[str, Array] | None = None,
        labels: Sequence[str] | None = None,
        remarks: Sequence[str] = (),
    ) -> None:
        rate = as_number("rate", rate, 0, above=True, of="of samples a second")
        if len(trajectories) == 0:
            raise ValueError("at least one demonstration is needed, got none")
        in_si, factors = layout.in_si()
        self.rate = rate
        found = (checked(i, trajectory, layout) for i, trajectory in enumerate(trajectories))
        converted = [each if factors is None else each * factors.to(each) for each in found]
        self.layout = in_si.centred(converted)
        self.trajectories = tuple(self.layout.continuous(each) for each in converted)
        self.remarks = tuple(remarks)
        if len({(trajectory.dtype, trajectory.device) for trajectory in self.trajectories}) > 1:
            raise ValueError("all trajectories must have one dtype and live on one device")
        self.columns = {name: np.asarray(column) for name, column in (columns or {}).items()}
        if labels is not None:
            if "labels" in self.columns:
                raise ValueError("labels are given twice, the second time among the columns")
            if isinstance(labels, str) or not all(isinstance(label, str) and label for label in labels):
                raise ValueError(f"labels must be names, one for each demonstration, got {str(labels)[:80]}")
            self.columns["labels"] = np.array(list(labels), dtype=np.str_)
        for name, column in self.columns.items():
            if column.shape[:1] != (len(self),):
                raise ValueError(
                    f"column {name!r} has shape {column.shape}, expected {len(self)} rows, one a demonstration"
                )

    def __len__(self) -> int:
        return len(self.trajectories)

    def __getitem__(self, index: int) -> Tensor:
        """The trajectory [T_i, D] of one demonstration."""
        return self.trajectories[index]

    def __iter__(self) -> Iterator[Tensor]:
        return iter(self.trajectories)

    def __repr__(self) -> str:
        return (
            f"Demonstrations({len(self)} of {int(self.lengths.min())} to {int(self.lengths.max())} samples "
            f"at {self.rate:g} Hz, {self.layout.n_dofs} DoFs: {', '.join(self.layout.names)})"
        )

    @property
    def lengths(self) -> Tensor:
        """int64 [N]: T_i, the number of samples of each."""
        return torch.tensor([len(trajectory) for trajectory in self.trajectories], device="cpu")

    @property
    def durations(self) -> Tensor:
        """[N] seconds: T_i samples last (T_i - 1) / rate."""
        dtype = self.trajectories[0].dtype
        return (self.lengths.to(dtype) - 1) / self.rate

    @property
    def labels(self) -> tuple[str, ...] | None:
        """Which interaction each demonstration shows, N names; None where nothing says."""
        column = self.columns.get("labels")
        return None if column is None or column.ndim != 1 else tuple(str(label) for label in column.tolist())

    def report(self) -> RecordingsReport:
        """What is there, what is missing, and what looks wrong: to be printed, or shown in a notebook.

        Lengths, labels, ranges, gaps; and a sentence for each DoF that never moves, jump that looks like a turn that
        was cut, value that does not look like its unit, demonstration that is there twice, remark of who read them.

        Example:
            >>> from torch_ebip.recordings import example
            >>> print(str(example().report()).splitlines()[0])
            30 demonstrations at 30 Hz, 1.53 to 2.47 s, half of them 2.03 s or less
        """
        return look(self.layout, self.trajectories, self.rate, self.labels, self.remarks)

    def labelled(self, labels: Sequence[str]) -> Demonstrations:
        """The same recordings with labels, N names, whatever they had before.

        Raises:
            ValueError: labels that are not N names.
        """
        others = {name: column for name, column in self.columns.items() if name != "labels"}
        return Demonstrations(self.layout, self.trajectories, self.rate, others, labels, self.remarks)

    def assign(self, targets: Sequence[str] | None = None, sensors: Sequence[str] | None = None) -> Demonstrations:
        """The same recordings with other roles: what is forecast is controlled, what is shown is not.

        Modalities that are neither are left out; one that is both is shown, and stays observed. The order of the
        columns stays.

        Args:
            targets: names of the modalities that are forecast; default: those that are controlled.
            sensors: names of those that are shown; default: all others.

        Raises:
            ValueError: a name that there is not, or twice; no target; no sensor.
        """
        layout = self.layout
        if targets is None:
            targets = [modality.name for modality in layout.modalities if modality.controlled]
        if sensors is None:
            sensors = [name for name in layout.names if name not in targets]
        for role, names in (("targets", targets), ("sensors", sensors)):
            if isinstance(names, str) or len(set(names)) != len(names):
                raise ValueError(f"{role} must be different names of modalities, got {names!r}")
            for name in names:
                layout.slice(name)
            if not names:
                raise ValueError(f"no {role}: name some of the modalities {', '.join(layout.names)}")
        kept = [
            replace(m, controlled=m.name in targets and m.name not in sensors)
            for m in layout.modalities
            if m.name in (*targets, *sensors)
        ]
        assigned = Layout(kept)
        if assigned == layout:
            return self
        dofs = layout.mask(assigned.names)
        parts = [trajectory[:, dofs] for trajectory in self.trajectories]
        return Demonstrations(assigned, parts, self.rate, self.columns, remarks=self.remarks)

    def subset(self, indices: Sequence[int] | Sequence[bool] | Tensor) -> Demonstrations:
        """Some of the demonstrations, with their columns.

        Args:
            indices: [M], which ones, negative ones from the end; or a mask, bool [N].

        Raises:
            ValueError: an index out of range, a mask of another length, fractions; none chosen.
        """
        chosen = as_indices("demonstration", indices, len(self)).tolist()
        columns = {name: column[chosen] for name, column in self.columns.items()}
        trajectories = [self.trajectories[i] for i in chosen]
        return Demonstrations(self.layout, trajectories, self.rate, columns, remarks=self.remarks)

    def folds(self, k: int, generator: torch.Generator | None = None) -> list[tuple[Tensor, Tensor]]:
        """Shuffle once and cut into k parts: (training, test) indices int64 [M], sizes differing by at most one.

        Args:
            k: how many folds.
            generator: of the shuffle.

        Raises:
            ValueError: k is not between 2 and the number of demonstrations.
        """
        if not 2 <= as_count("folds", k) <= len(self):
            raise ValueError(f"folds must be between 2 and the {len(self)} demonstrations there are, got {k}")
        parts = torch.randperm(len(self), generator=generator, device="cpu").tensor_split(k)
        return [(torch.cat([*parts[:i], *parts[i + 1 :]]), parts[i]) for i in range(k)]

    def pad(self) -> tuple[Tensor, Tensor]:
        """One batch: values [N, T, D] (NaN where not measured or past the end) and observed, bool [N, T, D]."""
        values = torch.nn.utils.rnn.pad_sequence(list(self.trajectories), batch_first=True, padding_value=math.nan)
        return values, ~values.isnan()

    def to(self, *, dtype: torch.dtype | None = None, device: torch.device | str | None = None) -> Demonstrations:
        """The same demonstrations in another dtype or on another device."""
        moved = [trajectory.to(dtype=dtype, device=device) for trajectory in self.trajectories]
        return Demonstrations(self.layout, moved, self.rate, self.columns, remarks=self.remarks)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write one ``.npz`` (values in their own precision, never pickled), which `load` reads; atomic.

        Raises:
            ValueError: see `recordings.write_npz`.
        """
        arrays = [trajectory.detach().cpu().numpy() for trajectory in self.trajectories]
        write_npz(path, Recordings(self.layout, arrays, self.rate, self.columns))

    @classmethod
    def load(cls, path: str | os.PathLike[str], limit: int = LIMIT) -> Demonstrations:
        """Read a ``.npz`` of at most so many bytes; executes nothing of it.

        Errors: see `arrays.read_npz` and `Demonstrations`.
        """
        return cls._from_recordings(path, read_npz(path, limit))

    @classmethod
    def load_folder(cls, path: str | os.PathLike[str], limit: int = CSV_LIMIT) -> Demonstrations:
        """Read a folder of CSV files beside a ``layout.toml`` or ``layout.json``: see `folders.read_folder`."""
        return cls._from_recordings(path, read_folder(path, limit))

    @classmethod
    def from_streams(
        cls,
        layout: Layout,
        interactions: Sequence[Interaction],
        rate: float | None = None,
        max_gap: float | None = None,
        *,
        how: How | Mapping[str, How] = "linear",
        span: str | Sequence[tuple[float, float]] | None = None,
        columns: Mapping[str, Array] | None = None,
        labels: Sequence[str] | None = None,
    ) -> Demonstrations:
        """Sensors that have times of their own, put onto one even grid.

        Stamps that run backwards are sorted, of those that repeat the first is kept; `remarks` counts both, and a
        warning shows them.

        Args:
            layout: of all modalities; one that an interaction lacks was not measured there.
            interactions: N of {modality: (times [T] in s, values [T, d] in the layout's units)}; NaN: not measured.
                Values in single precision stay so, all others are kept in double precision.
            rate: samples a second of the grid, Hz; default: that of the fastest sensor, by its usual step.
            max_gap: s, up to which apart samples are joined; NaN between those that are further. Default: three of
                the sensor's own usual steps.
            how: for all, or by modality: ``"linear"`` between samples, the ``"nearest"`` one at most ``max_gap``
                away, or each ``"sample"`` where it is nearest to and NaN elsewhere.
            span: from where to where: the name of a modality, or N pairs (start, end) in s; default: the time that
                all sensors of an interaction cover.
            columns, labels: see `Demonstrations`.

        Raises:
            ValueError: times and values that do not go together, stamps that are not finite, more than a third of a
                stream's backwards or repeated; sensors without a common time; a modality that the layout lacks.

        Example:
            >>> import numpy as np
            >>> from torch_ebip import Layout, Modality
            >>> layout = Layout([Modality("hand", ["x"], "m"), Modality("arm", ["q"], "rad", controlled=True)])
            >>> hand, arm = np.arange(0, 1, 0.02), np.arange(0, 1, 0.1)
            >>> Demonstrations.from_streams(layout, [{"hand": (hand, hand), "arm": (arm, arm)}])
            Demonstrations(1 of 46 to 46 samples at 50 Hz, 2 DoFs: hand, arm)
        """
        made = gridded(layout, interactions, rate, max_gap, how, span)
        if made.remarks:
            warnings.warn("; ".join(made.remarks), stacklevel=2)
        return cls(layout, made.trajectories, made.rate, columns, labels, made.remarks)

    @classmethod
    def _from_recordings(cls, path: str | os.PathLike[str], recordings: Recordings) -> Demonstrations:
        tensors = [torch.from_numpy(np.ascontiguousarray(array)) for array in recordings.trajectories]
        try:
            return cls(recordings.layout, tensors, recordings.rate, recordings.columns, remarks=recordings.remarks)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
