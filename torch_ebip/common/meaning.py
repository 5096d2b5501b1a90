"""What a module means beside its tensors: kept in its state dict, and compared when one is loaded.

Shapes agree between a filter over six splines and one over six polynomials, or between columns in two orders; what
was tuned for the one is nonsense in the other.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor, nn

KEY = "_extra_state"
"""Under which torch keeps it."""


class MeaningError(RuntimeError, ValueError):
    """A state dict of a module that means something else."""


class Meaning(nn.Module):
    """A module whose state dict holds `meaning`, and that refuses one of another, before anything of it is loaded.

    What is a choice of how to run (the number of members, the kind of update) is no part of it.
    """

    def meaning(self) -> dict[str, str]:
        """What is not in the tensors, by the name of the part: its class, and the settings that it prints.

        A part whose tensors mean less than it prints says so with a method ``meant``; None if it is no part of it.
        """
        lines = {}
        for name, module in self.named_modules():
            meant: Callable[[], str | None] = getattr(module, "meant", module.extra_repr)
            said = meant()
            if said is not None:
                lines[name or "itself"] = f"{type(module).__name__}({said})"
        return lines

    def get_extra_state(self) -> Tensor:
        """`meaning` as bytes, uint8 [length], so that a state dict holds nothing but tensors."""
        text = json.dumps(self.meaning()).encode()
        return torch.frombuffer(bytearray(text), dtype=torch.uint8).cpu()

    def set_extra_state(self, state: Tensor) -> None:
        """Compare what a state dict says, uint8 [length], with `meaning`.

        Raises:
            MeaningError: they differ; says in what.
        """
        ours = self.meaning()
        try:
            theirs = json.loads(bytes(state.tolist()))
            differing = [name for name in {**ours, **theirs} if theirs.get(name) != ours.get(name)]
        except (AttributeError, TypeError, ValueError, RecursionError) as error:
            raise MeaningError(f"a state dict that does not say what its {type(self).__name__} means") from error
        if differing:
            there, here = (str(side.get(differing[0], "nothing"))[:300] for side in (theirs, ours))
            raise MeaningError(
                f"a state dict of another {type(self).__name__}: {differing[0]} is {there} there and {here} here"
            )

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *arguments: Any) -> None:
        for name, module in self.named_modules():  # all of them first: nothing is to be loaded by halves
            key = f"{prefix}{name}{'.' if name else ''}{KEY}"
            if isinstance(module, Meaning) and key in state_dict:
                module.set_extra_state(state_dict[key])
        key = prefix + KEY
        if key not in state_dict and any(entry.startswith(prefix) for entry in state_dict):
            warnings.warn(
                f"a state dict that does not say what its {type(self).__name__} means, as those of version 0.1.0 did "
                "not: nothing but shapes is compared",
                stacklevel=5,
            )
        super()._load_from_state_dict(state_dict, prefix, *arguments)
        missing = arguments[2]
        if key in missing:
            missing.remove(key)
