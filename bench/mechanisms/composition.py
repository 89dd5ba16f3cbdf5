"""Composition of many ε-LDP answers.

N answers, each ε-LDP, are N·ε-LDP (basic composition). If the guarantee may fail with a chance of δ, ε is smaller. The least such
ε is the optimal composition of Kairouz, Oh and Viswanath (ICML 2015, Theorem 3.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np

DELTA = 1e-6
# Parts of a release that no ε covers.
UNCOVERED = ("the keypoints' positions", "the number of keypoints")
LINKS = "which keypoints share a word"  # within a release and across releases, for a memoized defense


def compose_basic(epsilon: float, answers: int) -> float:
    """Return the ε of all answers together, with certainty."""
    return answers * epsilon if answers else 0.0


@lru_cache(maxsize=4096)
def compose_optimal(epsilon: float, answers: int, delta: float = DELTA) -> float:
    """Return the least ε' such that any `answers` answers, each ε-LDP, are together (ε', δ)-LDP.

    The worst answers are randomised responses: with P(l) = C(N, l) p^(N − l) q^l, where p = 1 − q = e^ε / (1 + e^ε), and Q(l) the
    same with p and q exchanged, (ε', δ)-LDP requires Σ_l max(0, P(l) − e^ε' Q(l)) ≤ δ. The sum is the greatest, over i, of
    A_i − e^ε' B_i with A_i = P(0) + ... + P(i) and B_i likewise. So ε' is the greatest of ln ((A_i − δ) / B_i), computed in
    logarithms.

    Parameters
    ----------
    epsilon : of one answer, at least 0
    answers : N
    delta : from 0, which gives basic composition, up to but not including 1
    """
    from scipy.special import gammaln

    if answers == 0 or epsilon == 0 or math.isinf(epsilon) or delta == 0:
        return compose_basic(epsilon, answers)
    lies = np.arange(answers + 1)
    ways = gammaln(answers + 1) - gammaln(lies + 1) - gammaln(answers - lies + 1)
    truth = -math.log1p(math.exp(-epsilon))  # ln p; ln q is ε less
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
    """Return the ε of one answer at which `answers` of them, at least 1, together cost `total`."""
    from scipy.optimize import brentq

    if total == 0 or math.isinf(total):
        return total
    return float(brentq(lambda epsilon: cost(epsilon, answers) - total, 0.0, 2 * total + 10, xtol=1e-12, rtol=1e-12))
