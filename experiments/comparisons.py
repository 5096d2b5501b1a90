"""Whether methods differ: a test for each cell of a table, corrected for there being many cells."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

LEVEL = 0.05
"""Adjusted p below which two methods are said to differ."""
LARGER_IS_BETTER = ("accuracy",)
"""All other metrics are errors, but for coverage."""
TABLE = ("metric", "modality", "ahead", "b")
"""What the cells of one line of a table have in common."""


def holm(p_values: Sequence[float]) -> list[float]:
    """Adjusted p of tests that are looked at together (Holm 1979).

    The smallest is multiplied by their number, the next by one less and so on, none falling below one before it:
    the chance of any false alarm among them is then at most the level. Five lines here, since scipy has
    Benjamini and Hochberg's correction only.

    Example:
        >>> holm([0.01, 0.04, 0.03])
        [0.03, 0.06, 0.06]
    """
    adjusted, least = [0.0] * len(p_values), 0.0
    for rank, i in enumerate(np.argsort(p_values, kind="stable")):
        least = max(least, min((len(p_values) - rank) * p_values[i], 1.0))
        adjusted[i] = least
    return adjusted


def compared(methods: Mapping[str, NDArray[np.float64]], against: str) -> list[dict[str, Any]]:
    """Every method of a cell with one of them.

    Args:
        methods: for each its values, one an interaction, in the same order; NaN where there is none.
        against: one of them.

    Returns:
        ``a``, ``b`` and two-sided ``p_value`` of Mann and Whitney's U, as in the paper, and ``p_paired`` of
        Wilcoxon's signed ranks, which sees smaller differences: all methods are asked about the same interactions.
        ``lead`` and ``lead_paired``, -1 to 1, are how far a has the larger ranks in each: means may say otherwise.
    """
    from scipy.stats import (  # half a second that no process without a table should wait for
        mannwhitneyu,
        rankdata,
        wilcoxon,
    )

    rows, ours = [], methods[against]
    for name, theirs in methods.items():
        if name == against or not len(mine := ours[~np.isnan(ours)]) or not len(other := theirs[~np.isnan(theirs)]):
            continue
        tested = mannwhitneyu(mine, other)
        lead = 2 * float(tested.statistic) / (len(mine) * len(other)) - 1
        paired, lead_paired = math.nan, math.nan
        if len(ours) == len(theirs):
            difference = (ours - theirs)[~np.isnan(ours - theirs)]
            ranks = rankdata(np.abs(difference))
            lead_paired = float((np.sign(difference) * ranks).sum() / max(ranks.sum(), 1.0))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # of few samples scipy says that it approximates
                paired = float(wilcoxon(difference).pvalue) if (difference != 0).any() else 1.0
        p_values = {"p_value": float(tested.pvalue), "p_paired": paired}
        rows.append({"a": against, "b": name, **p_values, "lead": lead, "lead_paired": lead_paired})
    return rows


def corrected(comparisons: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """The same with ``p_holm`` and ``p_paired_holm``, over the cells of a line of a table."""
    adjusted = [dict(comparison) for comparison in comparisons]
    tables: dict[tuple[Any, ...], list[dict[str, Any]]] = {}
    for comparison in adjusted:
        tables.setdefault(tuple(comparison.get(key) for key in TABLE), []).append(comparison)
    for table in tables.values():
        for key in ("p_value", "p_paired"):
            some = [comparison for comparison in table if not math.isnan(comparison[key])]
            name = key.replace("_value", "") + "_holm"
            for comparison in table:
                comparison[name] = math.nan
            for comparison, p in zip(some, holm([comparison[key] for comparison in some]), strict=True):
                comparison[name] = p
    return adjusted


def verdicts(results: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Of a reference, for each table and other method: in how many cells it is better and worse, and how surely.

    Args:
        results: of `experiments.results.summarise`.

    Returns:
        Without a reference nothing; else a row each with ``metric``, ``modality``, ``ahead`` (None: the end),
        ``method``, ``cells``, ``better`` and ``worse`` (their number where either test says so with an adjusted p
        below `LEVEL`), ``p_worse``, the smallest adjusted p of a test in which the reference has the worse ranks,
        1 where there is none. Coverage, which should be neither large nor small, has none.
    """
    if results["reference"] is None:
        return []
    tables: dict[tuple[Any, ...], list[dict[bool, float]]] = {}
    for c in results["comparisons"]:
        smallest = {False: 1.0, True: 1.0}  # by whether the reference is worse
        for lead, p in ((c["lead"], c["p_holm"]), (c["lead_paired"], c["p_paired_holm"])):
            if not math.isnan(p):
                worse = (lead < 0) if c["metric"] in LARGER_IS_BETTER else (lead > 0)
                smallest[worse] = min(smallest[worse], p)
        tables.setdefault(tuple(c.get(key) for key in TABLE), []).append(smallest)
    return [
        {
            "metric": metric, "modality": modality, "ahead": ahead, "method": method, "cells": len(cells),
            "better": sum(p[False] < LEVEL for p in cells), "worse": sum(p[True] < LEVEL for p in cells),
            "p_worse": min(p[True] for p in cells),
        }
        for (metric, modality, ahead, method), cells in tables.items()
        if metric != "coverage_95"
    ]  # fmt: skip
