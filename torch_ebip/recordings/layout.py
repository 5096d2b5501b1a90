"""Which degree of freedom (DoF) is which: its modality, its unit, and who controls it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

import torch
from torch import Tensor

from torch_ebip.recordings.angles import centre_of, continuous
from torch_ebip.recordings.units import in_si

KINDS = ("plain", "angle")
"""What the numbers of a modality are."""


@dataclass(frozen=True, init=False)
class Modality:
    """A group of DoFs that one sensor measures, or one agent moves, in one unit.

    Args:
        name: unique within a layout, for example ``"ball"``.
        dofs: names of its DoFs, unique within a layout, for example ``["ball.x", "ball.y", "ball.z"]``.
        unit: SI unit of every DoF of the group (``"m"``, ``"rad"``, ``"m/s^2"``); ``"1"`` if it has none.
        controlled: whether the robot moves these DoFs (the paper's D_c) or they are only observed (D_o).
        kind: ``"plain"`` numbers, or each an ``"angle"``, which is where it was after a whole turn: demonstrations
            make it continuous, sessions take it wrapped and say it wrapped.
        centre: of angles, rad, one a DoF: within half a turn of it interactions begin; default: found by the
            demonstrations.

    Raises:
        ValueError: an empty name or unit, no DoFs, or a DoF named twice; names that are no text or hold control
            characters; a ``controlled`` that is no boolean; another kind; an angle in no unit of angles.
    """

    name: str
    dofs: tuple[str, ...]
    unit: str
    controlled: bool
    kind: str = "plain"
    centre: tuple[float, ...] | None = field(default=None, compare=False)

    def __init__(
        self,
        name: str,
        dofs: Sequence[str],
        unit: str,
        controlled: bool = False,
        kind: str = "plain",
        centre: Sequence[float] | None = None,
    ) -> None:
        if isinstance(dofs, str):
            raise ValueError(f"modality {name!r}: dofs must be a sequence of names, got the string {dofs!r}")
        if not name or not unit:
            raise ValueError(f"a modality needs a name and a unit, got name={name!r}, unit={unit!r}")
        names = tuple(dofs)
        for text in (name, unit, *names):
            if not isinstance(text, str):
                raise ValueError(f"modality {name!r}: names and units must be text, got {text!r}")
            if not text.isprintable():  # escapes would reach terminals and pictures, NUL ends names in files
                raise ValueError(f"modality {name!r}: names and units must be printable, got {text[:80]!r}")
        if controlled not in (True, False):
            raise ValueError(f"modality {name!r}: controlled must be True or False, got {controlled!r}")
        if not names or not all(names):
            raise ValueError(f"modality {name!r} needs at least one DoF, each with a name, got {names!r}")
        _reject_repeats(f"modality {name!r}: DoF", names)
        object.__setattr__(self, "name", name)
        object.__setattr__(self, "dofs", names)
        object.__setattr__(self, "unit", unit)
        object.__setattr__(self, "controlled", bool(controlled))
        if kind not in KINDS:
            raise ValueError(f"modality {name!r}: kind must be one of {', '.join(KINDS)}, got {str(kind)[:40]!r}")
        if kind == "angle" and in_si(unit)[0] not in ("rad", "1"):
            raise ValueError(f"modality {name!r}: angles are in rad, or deg, got the unit {unit!r}")
        if centre is not None and (kind != "angle" or len(centre) != len(names)):
            raise ValueError(
                f"modality {name!r}: a centre is one angle for each of {len(names)} angles, got {centre!r}"
            )
        object.__setattr__(self, "kind", str(kind))
        object.__setattr__(self, "centre", None if centre is None else tuple(float(angle) for angle in centre))


@dataclass(frozen=True, init=False)
class Layout:
    """The columns of a recording: modalities side by side, in order.

    Args:
        modalities: at least one; names and DoFs are unique.

    Raises:
        ValueError: no modality, or a modality or DoF named twice.
    """

    modalities: tuple[Modality, ...]
    _names: tuple[str, ...] = field(init=False, repr=False, compare=False)
    _dofs: tuple[str, ...] = field(init=False, repr=False, compare=False)
    _slices: dict[str, slice] = field(init=False, repr=False, compare=False)

    def __init__(self, modalities: Sequence[Modality]) -> None:
        object.__setattr__(self, "modalities", tuple(modalities))
        if not self.modalities:
            raise ValueError("a layout needs at least one modality")
        for modality in self.modalities:
            if not isinstance(modality, Modality):
                raise ValueError(f"a layout consists of modalities, got {modality!r}")
        # Asked for again and again, once a demonstration or a modality: found once.
        object.__setattr__(self, "_names", tuple(modality.name for modality in self.modalities))
        object.__setattr__(self, "_dofs", tuple(dof for modality in self.modalities for dof in modality.dofs))
        _reject_repeats("modality", self.names)
        _reject_repeats("DoF", self.dofs)
        ends = accumulate(len(modality.dofs) for modality in self.modalities)
        slices = {m.name: slice(end - len(m.dofs), end) for m, end in zip(self.modalities, ends, strict=True)}
        object.__setattr__(self, "_slices", slices)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the modalities, in order."""
        return self._names

    @property
    def dofs(self) -> tuple[str, ...]:
        """Names of all DoFs, in column order; D of them."""
        return self._dofs

    @property
    def n_dofs(self) -> int:
        """D, the number of columns."""
        return len(self.dofs)

    @property
    def units(self) -> tuple[str, ...]:
        """The unit of each DoF, D of them."""
        return tuple(modality.unit for modality in self.modalities for _ in modality.dofs)

    @property
    def controlled(self) -> Tensor:
        """bool [D]: whether the robot moves this DoF."""
        return torch.tensor(
            [modality.controlled for modality in self.modalities for _ in modality.dofs], device="cpu"
        )

    @property
    def modality_of_dof(self) -> Tensor:
        """int64 [D]: index into `modalities` of each DoF."""
        return torch.tensor([i for i, modality in enumerate(self.modalities) for _ in modality.dofs], device="cpu")

    @property
    def angles(self) -> Tensor:
        """bool [D]: whether this DoF is an angle."""
        kinds = [modality.kind for modality in self.modalities for _ in modality.dofs]
        return torch.tensor([kind == "angle" for kind in kinds], device="cpu")

    def centred(self, trajectories: Sequence[Tensor]) -> Layout:
        """The same, each angle with a centre: where it has none, that of trajectories [T_i, D]."""
        if all(modality.kind != "angle" or modality.centre is not None for modality in self.modalities):
            return self
        parts = [
            replace(m, centre=tuple(centre_of(trajectories, k) for k in range(self.n_dofs)[self.slice(m.name)]))
            if m.kind == "angle" and m.centre is None else m
            for m in self.modalities
        ]  # fmt: skip
        return Layout(parts)

    def continuous(self, values: Tensor) -> Tensor:
        """Values [T, D] of one interaction whose angles do not jump, see `angles.continuous`."""
        angles = self.angles
        if not bool(angles.any()):
            return values
        centre = [angle for m in self.modalities if m.kind == "angle" for angle in m.centre or [0.0] * len(m.dofs)]
        found = values.clone()
        found[:, angles] = continuous(values[:, angles], values.new_tensor(centre))
        return found

    def in_si(self) -> tuple[Layout, Tensor | None]:
        """The same in SI units, and by what the values of each DoF are multiplied for that, [D]; None if by nothing.

        Raises:
            ValueError: a unit that is not SI and that no factor converts.
        """
        found = [in_si(modality.unit) for modality in self.modalities]
        if all(factor == 1 for _, factor in found):
            return self, None
        pairs = list(zip(self.modalities, found, strict=True))
        factors = [factor for modality, (_, factor) in pairs for _ in modality.dofs]
        parts = [replace(m, unit=unit) for m, (unit, _) in pairs]
        return Layout(parts), torch.tensor(factors, dtype=torch.float64, device="cpu")

    def __getitem__(self, name: str) -> Modality:
        """The modality of that name; ValueError if there is none."""
        for modality in self.modalities:
            if modality.name == name:
                return modality
        raise ValueError(f"no modality {name!r}; this layout has {', '.join(self.names)}")

    def slice(self, name: str) -> slice:
        """The columns of a modality; ValueError if there is none of that name."""
        if name not in self._slices:
            raise ValueError(f"no modality {name!r}; this layout has {', '.join(self.names)}")
        return self._slices[name]

    def mask(self, names: Iterable[str]) -> Tensor:
        """bool [D]: True in the columns of the named modalities or single DoFs.

        Raises:
            ValueError: a name that is neither a modality nor a DoF.
        """
        names = [names] if isinstance(names, str) else list(names)
        selected = torch.zeros(self.n_dofs, dtype=torch.bool, device="cpu")
        for name in names:
            if name in self._slices:
                selected[self.slice(name)] = True
            elif name in self.dofs:
                selected[self.dofs.index(name)] = True
            else:
                raise ValueError(
                    f"no modality or DoF {name!r}; the modalities are {', '.join(self.names)}, "
                    f"the DoFs {', '.join(self.dofs)}"
                )
        return selected


def _reject_repeats(what: str, names: Sequence[str]) -> None:
    repeated = sorted(name for name, count in Counter(names).items() if count > 1)
    if repeated:
        raise ValueError(f"{what} named more than once: {', '.join(repeated[:10])}")
