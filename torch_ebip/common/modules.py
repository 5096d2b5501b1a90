"""Modules that share parameters, and whether parameters have changed."""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, TypeVar

from torch import nn

Module = TypeVar("Module", bound=nn.Module)


def sharing(module: Module) -> Module:
    """A second module with the same parameters and parts, not copies of them, whose attributes can be set apart."""
    twin = copy.copy(module)
    for registry in ("_parameters", "_buffers", "_modules"):
        twin.__dict__[registry] = dict(module.__dict__[registry])
    return twin


class FastTwins:
    """A module whose plain methods have fast twins, which compute the same by another way.

    A subclass that overrides a plain one and not its twins has no twins: they would compute something else. A
    protocol that asks for them is then not met.
    """

    twins: ClassVar[Mapping[str, Sequence[str]]] = {}
    """Of each plain method, the names of its twins."""

    def __init_subclass__(cls, **options: Any) -> None:
        super().__init_subclass__(**options)

        def depth(name: str) -> int:
            """How far up the inheritance a name is defined, mixins included."""
            return next((i for i, each in enumerate(cls.__mro__) if name in vars(each)), len(cls.__mro__))

        for plain, twins in cls.twins.items():
            for twin in twins:
                if depth(plain) < depth(twin):
                    setattr(cls, twin, None)


class Versions:
    """Notices that parameters or buffers of a module are others, or have changed in place, as by an optimiser.

    Args:
        module: that is watched, with the parts that it has now.
    """

    def __init__(self, module: nn.Module) -> None:
        registries = [registry for part in module.modules() for registry in (part._parameters, part._buffers)]
        self._places = [(registry, name) for registry in registries for name, value in registry.items()]
        self._seen: list[tuple[int, int]] | None = None

    def changed(self) -> bool:
        """Whether something has, since the last call; always at first, and where torch keeps no versions."""
        tensors = [registry[name] for registry, name in self._places]
        try:
            now = [(id(tensor), -1 if tensor is None else tensor._version) for tensor in tensors]
        except RuntimeError:  # of inference mode: they have none
            return True
        if now == self._seen:
            return False
        self._seen = now
        return True
