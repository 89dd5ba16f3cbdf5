"""What many ε-LDP answers cost together.

N answers, each ε-LDP, are N·ε-LDP (basic composition). Who grants that the promise fails with a chance of δ gets a smaller ε, of
which the least is known: the optimal composition of Kairouz, Oh and Viswanath (ICML 2015, Theorem 3.3).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache

import numpy as np
from scipy.optimize import brentq
from scipy.special import gammaln

DELTA = 1e-6
# What is released of a photograph and covered by no ε.
UNCOVERED = ("the keypoints' positions", "the number of keypoints")
LINKS = "which keypoints share a word"  # in one release and from one to the next, by a defense that remembers


def basic(epsilon: float, answers: int) -> float:
    """ε of all the answers together, with certainty."""
    return answers * epsilon if answers else 0.0


@lru_cache(maxsize=4096)
def optimal(epsilon: float, answers: int, delta: float = DELTA) -> float:
    """The least ε' such that `answers` answers, each ε-LDP, are together (ε', δ)-LDP, whatever they are.

    The worst answers are randomised responses: with P(l) = C(N, l) p^(N − l) q^l, where p = 1 − q = e^ε / (1 + e^ε), and Q(l) the
    same with p and q exchanged, (ε', δ)-LDP asks that Σ_l max(0, P(l) − e^ε' Q(l)) ≤ δ. The sum is the greatest, over i, of
    A_i − e^ε' B_i with A_i = P(0) + ... + P(i) and B_i likewise. So ε' is the greatest of ln ((A_i − δ) / B_i). All of it is done
    in logarithms.

    Parameters
    ----------
    epsilon : of one answer, at least 0
    answers : N
    delta : from 0, which gives basic composition, up to but not including 1
    """
    if answers == 0 or epsilon == 0 or math.isinf(epsilon) or delta == 0:
        return basic(epsilon, answers)
    lies = np.arange(answers + 1)
    ways = gammaln(answers + 1) - gammaln(lies + 1) - gammaln(answers - lies + 1)
    truth = -math.log1p(math.exp(-epsilon))  # ln p; ln q is ε less
    P = ways + answers * truth - lies * epsilon
    Q = P[::-1]
    A, B = np.logaddexp.accumulate(P), np.logaddexp.accumulate(Q)
    more = np.log(delta) < A
    left = A[more] + np.log1p(-delta * np.exp(-A[more]))  # ln (A_i − δ)
    return float((left - B[more]).max(initial=0.0))


def together(epsilon: float, answers: int, delta: float = DELTA) -> float:
    """The smaller of the two."""
    return min(basic(epsilon, answers), optimal(epsilon, answers, delta))


def epsilon_left(total: float, answers: int, cost: Callable[[float, int], float] = together) -> float:
    """The ε of one answer at which all of them, at least 1, together cost `total`."""
    if total == 0 or math.isinf(total):
        return total
    return float(brentq(lambda epsilon: cost(epsilon, answers) - total, 0.0, 2 * total + 10, xtol=1e-12, rtol=1e-12))
