"""Composition of many ε-LDP answers.

N answers, each ε-LDP, are together N·ε-LDP (basic composition). A guarantee that may fail with a chance of δ has a smaller ε. The
least such ε is the optimal composition of Kairouz, Oh and Viswanath (ICML 2015, Theorem 3.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

from bench.types import Points

DELTA = 1e-6
# Parts of a release that no ε covers.
COUNT = "the number of keypoints"
UNCOVERED = (Points.disclosed, COUNT)  # of a defense that releases positions in the clear
LINKS = "which keypoints share a word"  # within a release and between releases, for a memoized defense


def compose_basic(epsilon: float, answers: int) -> float:
    """Return the ε of all answers together, for δ = 0."""
    return answers * epsilon if answers else 0.0


@lru_cache(maxsize=4096)
def compose_optimal(epsilon: float, answers: int, delta: float = DELTA) -> float:
    """Return the least ε' such that any `answers` answers, each ε-LDP, are together (ε', δ)-LDP.

    The worst answers are randomised responses. Let p = 1 − q = e^ε / (1 + e^ε), P(l) = C(N, l) p^(N − l) q^l, and
    Q(l) = C(N, l) q^(N − l) p^l. Then (ε', δ)-LDP requires Σ_l max(0, P(l) − e^ε' Q(l)) ≤ δ. The sum is the maximum over i of
    A_i − e^ε' B_i, with A_i = P(0) + ... + P(i) and B_i = Q(0) + ... + Q(i). So ε' is the maximum over i of
    ln ((A_i − δ) / B_i), computed in logarithms.

    Parameters
    ----------
    epsilon : of one answer, at least 0
    answers : N
    delta : at least 0, which gives basic composition, and less than 1
    """
    from scipy.special import gammaln

    if answers == 0 or epsilon == 0 or math.isinf(epsilon) or delta == 0:
        return compose_basic(epsilon, answers)
    lies = np.arange(answers + 1)
    ways = gammaln(answers + 1) - gammaln(lies + 1) - gammaln(answers - lies + 1)
    truth = -math.log1p(math.exp(-epsilon))  # ln p = ln q + ε
    P = ways + answers * truth - lies * epsilon
    Q = P[::-1]
    A, B = np.logaddexp.accumulate(P), np.logaddexp.accumulate(Q)
    more = np.log(delta) < A
    left = A[more] + np.log1p(-delta * np.exp(-A[more]))  # ln (A_i − δ)
    return float((left - B[more]).max(initial=0.0))


def compose(epsilon: float, answers: int, delta: float = DELTA) -> float:
    """Return the smaller ε of basic and optimal composition."""
    return min(compose_basic(epsilon, answers), compose_optimal(epsilon, answers, delta))


def solve_epsilon(total: float, answers: int, cost: Callable[[float, int], float] = compose) -> float:
    """Return the ε of one answer for which `answers` answers (at least 1) together cost `total`."""
    from scipy.optimize import brentq

    if total == 0 or math.isinf(total):
        return total
    return float(brentq(lambda epsilon: cost(epsilon, answers) - total, 0.0, 2 * total + 10, xtol=1e-12, rtol=1e-12))
