"""Kinds of interactions that nobody named: clusters of the demonstrations, their number by BIC."""

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.ranks import Ranks
from torch_ebip.recordings.demonstrations import Demonstrations

MOST = 6
"""Groups, at most."""
SMALLEST = 4
"""Demonstrations in a group, at least."""
PHASES = 9
"""At which demonstrations are compared."""
DIRECTIONS = 4
"""Principal directions in which they are compared, at most."""


@in_own_modes
def find_groups(primitive: InteractionPrimitive, seed: int = 0) -> tuple[str, ...] | None:
    """Names ``group 1`` and so on, one for each of the N demonstrations; None where there is one group only.

    Gaussian mixtures over the principal directions of the demonstrations' paths, every DoF in units of its deviation;
    as many components as BIC says. A group of fewer than `SMALLEST` demonstrations makes the number too large.

    Args:
        primitive: of the demonstrations.
        seed: of the initialisation.

    Raises:
        ImportError: scikit-learn is not installed.

    Example:
        >>> from torch_ebip import InteractionPrimitive
        >>> from torch_ebip.learning.groups import find_groups
        >>> from torch_ebip.recordings import example
        >>> find_groups(InteractionPrimitive.fit(example())) is None
        True
    """
    try:
        from sklearn.exceptions import ConvergenceWarning
        from sklearn.mixture import GaussianMixture
    except ImportError as error:
        raise ImportError("finding groups needs scikit-learn: pip install 'torch-ebip[methods]'") from error
    N = len(primitive)
    if N < 2 * SMALLEST:
        return None
    places = directions(primitive).cpu().double().numpy()
    best: tuple[float, list[int]] | None = None
    for count in range(1, min(MOST, N // SMALLEST) + 1):
        mixture = GaussianMixture(count, reg_covar=1e-3 * float(places.var()), n_init=4, random_state=seed)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ConvergenceWarning)
            chosen = mixture.fit_predict(places).tolist()
        sizes = [chosen.count(group) for group in set(chosen)]
        if count > 1 and (len(sizes) < count or min(sizes) < SMALLEST):
            continue
        score = float(mixture.bic(places))
        if best is None or score < best[0]:
            best = score, chosen
    assert best is not None
    order = list(dict.fromkeys(best[1]))
    return None if len(order) < 2 else tuple(f"group {order.index(group) + 1}" for group in best[1])


def labelled(
    known: Demonstrations, primitive: InteractionPrimitive, seed: int, ranks: Ranks
) -> tuple[Demonstrations, list[str]]:
    """Demonstrations with labels, their own or those of groups that were found, and what is to be remarked of them.

    Args:
        known: N of them, what the primitive was fitted to.
        primitive: of them.
        seed: see `find_groups`.
        ranks: the processes that share the work: the first one looks.
    """
    remarks: list[str] = []
    if known.labels is None:
        try:
            found = ranks.from_first(lambda: find_groups(primitive, seed))
            known = known if found is None else known.labelled(found)
        except ImportError:
            remarks.append("groups: not looked for, scikit-learn is not installed")
    labels = known.labels or ()
    remarks += [
        f"label {label!r} has one demonstration: without it there is none, so that nobody can tell how well it is "
        "recognised"
        for label in dict.fromkeys(labels)
        if labels.count(label) == 1
    ]
    return known, remarks


def directions(primitive: InteractionPrimitive) -> Tensor:
    """[N, at most `DIRECTIONS`]: demonstrations along the principal directions of their paths, without unit."""
    weights = primitive.weights.double()
    phase = torch.linspace(0, 1, PHASES, dtype=primitive.weights.dtype, device=weights.device)
    paths = primitive.basis.project_paths(phase, primitive.weights - primitive.weights.mean(0)).double()
    variance = primitive.value_variance.double()
    paths = paths / torch.where(variance > 0, variance, torch.inf).sqrt()
    left, size, _ = torch.linalg.svd(paths.flatten(1), full_matrices=False)
    along: Tensor = left[:, :DIRECTIONS] * size[:DIRECTIONS]
    return along


def groups_of(known: InteractionPrimitive, labels: tuple[str, ...], new: InteractionPrimitive) -> tuple[str, ...]:
    """The group whose middle each of some new demonstrations is nearest to; both primitives are on one basis."""
    spread = known.weights.std(0).clamp(min=torch.finfo(known.weights.dtype).tiny)
    names = tuple(dict.fromkeys(labels))
    middles = torch.stack([known.weights[[label == name for label in labels]].mean(0) for name in names])
    distances = ((new.weights.unsqueeze(1) - middles) / spread).square().mean(-1)
    return tuple(names[i] for i in distances.argmin(1).tolist())
