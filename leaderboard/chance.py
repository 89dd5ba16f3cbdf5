"""Metrics of identification, and their scores by chance: a random order of the 256 images among which the true one is ranked."""

from __future__ import annotations

import numpy as np

from bench.identification.distractors import COUNT

IDENTIFIED = "identified"  # the metric: the reciprocal rank of the photograph
IDENTIFIED_SCENE = "identified-scene"  # that of another view of the same scene
IDENTIFICATION = (IDENTIFIED, IDENTIFIED_SCENE)
PHOTOGRAPHS = COUNT + 1
_RANKS = np.arange(1, PHOTOGRAPHS + 1)
FIRST = 1 / PHOTOGRAPHS  # the probability of rank 1
RECIPROCAL_RANK = float(np.mean(1 / _RANKS))
LOG_RECIPROCAL_RANK = float(np.mean(-np.log2(_RANKS)))  # in bits

_TARGETS = {IDENTIFIED: "the photograph", IDENTIFIED_SCENE: "another view of the query's scene"}


def explain_identification(metric: str) -> str:
    """Return a remark on a metric of identification, with the values of a random order."""
    return (
        f"{metric}: the mean reciprocal rank of {_TARGETS[metric]} among {PHOTOGRAPHS}, how often it has rank 1, and the bits of "
        f"information about which of the {PHOTOGRAPHS} it is, with a likelihood interval. Chance, a random order, gives "
        f"{RECIPROCAL_RANK:.3g}, rank 1 for 1 of {PHOTOGRAPHS}, and 0 bits. A constant image counts as chance."
    )


def label_identified(metric: str = IDENTIFIED) -> str:
    """Return the label of the mean reciprocal rank, with its value by chance."""
    return f"{metric} (chance {RECIPROCAL_RANK:.2g})"


def label_rank_1(metric: str = IDENTIFIED) -> str:
    """Return the label of the fraction of images of rank 1, with its value by chance."""
    return f"{metric}, rank 1 (chance {FIRST:.2g})"


def label_bits(metric: str = IDENTIFIED) -> str:
    """Return the label of the bits, with their value by chance."""
    return f"{metric}, bits of {PHOTOGRAPHS.bit_length() - 1} (chance 0)"


def name_rank_1(metric: str) -> str:
    """Return the name of the fraction of images of rank 1 in files."""
    return f"{metric}_rank_1"


def name_bits(metric: str) -> str:
    """Return the name of the bits in files."""
    return f"{metric}_bits"
