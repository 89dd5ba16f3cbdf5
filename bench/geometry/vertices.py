"""Degenerate vertices of a batch of polytopes {x = o + Bᵀ c : x >= 0}, by the simplex method in coordinates of the subspace.

At a vertex, `dim` components vanish: its *frame*. The vertex is degenerate if more components vanish. With s the components of
the frame, x = T [1, s] for a tableau T (D, 1 + dim), whose first column is the vertex. A pivot removes one component from the
frame and follows that edge to the least objective. The component that vanishes there joins the frame, an update of rank one.

The objective is Σ_j w_j x_j. A negative x_j counts PENALTY w_j |x_j|, so no feasible initial vertex is needed. Along an edge the
objective is convex and piecewise linear. At an optimum the weights become 1 / (x + SOFT) (reweighted L1; Candès, Wakin, Boyd
2008). After ROUNDS of these updates the weights are drawn again.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bench.core.device import pick_double_device
from bench.geometry.pivoting import select_independent_rows

if TYPE_CHECKING:
    from torch import Tensor

Doubles = NDArray[np.float64]

PENALTY = 20.0
SOFT = 0.02
ROUNDS = 4
ZERO = 1e-6  # components up to this count as zero: float32 has errors of about 1e-8, which a frame amplifies
UNIT = 1e-5  # a norm this near to 1 counts as 1
FLAT = 1e-6  # a component that changes by less along an edge is constant on it
SLOPE = 1e-9  # an edge with a smaller descent of the objective does not lead down
EQUAL_TOLERANCE = 1e-4  # vertices that are equal after rounding to this count as one
BATCH = 256  # polytopes per batch, whose tableaus fit into the cache
REFRESH = 32  # pivots after which tableaus are recomputed and finished walks are dropped


def find_unit_vertices(
    origins: Doubles, bases: Doubles, pivots: int, enough: Callable[[Tensor], Tensor], rng: np.random.Generator
) -> tuple[NDArray[np.int64], Doubles]:
    """Walk over the vertices of each polytope and return those that are degenerate, non-negative and of norm 1.

    Parameters
    ----------
    origins, bases : (N, D), (N, dim, D)
    pivots : length of a walk
    enough : (n, D) vertices -> (n,) bool, whether the walk of their polytope ends

    Returns
    -------
    (n,) the polytope of each vertex, ascending, and (n, D) the vertices, each once.
    """
    owners, points = [np.empty(0, dtype=np.int64)], [np.empty((0, origins.shape[1]))]
    for start in range(0, len(origins), BATCH):
        o, b = origins[start : start + BATCH], bases[start : start + BATCH]
        owner, point = _deduplicate(*_walk(o, b, pivots, enough, rng))
        owners.append(owner + start)
        points.append(_polish(o[owner], b[owner], point))
    return np.concatenate(owners), np.concatenate(points)


def _walk(
    origins: Doubles, bases: Doubles, pivots: int, enough: Callable[[Tensor], Tensor], rng: np.random.Generator
) -> tuple[NDArray[np.int64], Doubles]:
    """Compute `find_unit_vertices` for one batch, without polishing."""
    import torch

    count, dim, length = bases.shape
    device = pick_double_device()
    o, b = torch.from_numpy(origins).to(device), torch.from_numpy(bases).to(device)

    def draw_weights(rows: int) -> Tensor:
        return torch.from_numpy(rng.random((rows, length))).to(device)

    # Rows scaled at random make the first frame a function of D and `rng` alone: their norms do not depend on the basis.
    scaled = bases.transpose(0, 2, 1) * rng.random((count, length, 1))  # (n, D, dim)
    frame = torch.from_numpy(select_independent_rows(scaled)).to(device)  # (n, dim)
    owner, weights, rounds = torch.arange(count, device=device), draw_weights(count), torch.zeros(count, device=device)
    live = torch.ones(count, dtype=torch.bool, device=device)
    owners, points = [owner[:0]], [o[:0]]
    for pivot in range(pivots):
        if pivot % REFRESH == 0:
            o, b, frame, owner, weights, rounds = (part[live] for part in (o, b, frame, owner, weights, rounds))
            live = live[live]
            varying = b.norm(dim=1) > FLAT  # (n, D)
            tableau = _build_tableau(o, b, frame)  # (n, D, 1 + dim)
        hit = live & _certify(tableau[:, :, 0], varying, dim)
        owners.append(owner[hit])
        points.append(tableau[hit, :, 0])
        live[hit] = ~enough(points[-1])
        edge, sign, slope = _select_edge(tableau, frame, weights)
        optimal = slope >= -SLOPE
        into = _select_component(tableau, frame, weights, edge, sign, slope)
        if optimal.any():
            again, over = optimal & (rounds < ROUNDS), optimal & (rounds >= ROUNDS)
            weights[again] = SOFT / (tableau[again, :, 0].clamp(min=0) + SOFT)
            weights[over] = draw_weights(int(over.sum()))
            rounds = torch.where(again, rounds + 1, torch.where(over, 0, rounds))
        _exchange(tableau, frame, edge, into, ~optimal)
    return torch.cat(owners).cpu().numpy(), torch.cat(points).cpu().numpy()


def _certify(x: Tensor, varying: Tensor, dim: int) -> Tensor:
    """Return whether each vertex is degenerate, non-negative and of norm 1. (n, D), (n, D) -> (n,)"""
    vanishing = ((x.abs() <= ZERO) & varying).sum(dim=1)
    return (vanishing > dim) & (x.amin(dim=1) >= -ZERO) & ((x.norm(dim=1) - 1).abs() <= UNIT)


def _build_tableau(o: Tensor, b: Tensor, frame: Tensor) -> Tensor:
    """Return the tableau of each frame. (n, D), (n, dim, D), (n, dim) -> (n, D, 1 + dim)"""
    import torch

    at_frame = b.gather(2, frame[:, None].expand(-1, b.shape[1], -1))  # (n, dim, dim)
    edges = torch.linalg.solve_ex(at_frame, b)[0].mT  # (n, D, dim)
    x = o - (edges @ o.gather(1, frame)[:, :, None])[:, :, 0]
    return torch.cat([x[:, :, None], edges], dim=2)


def _select_edge(tableau: Tensor, frame: Tensor, weights: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return the edge of steepest descent. -> (n,) index, (n,) direction ±1, (n,) slope"""
    import torch

    x = tableau[:, :, 0]
    gain = torch.where(x >= -ZERO, weights, -PENALTY * weights).scatter(1, frame, 0.0)  # (n, D) without the frame
    slopes = torch.bmm(gain[:, None], tableau[:, :, 1:])[:, 0]  # (n, dim)
    own = weights.gather(1, frame)
    up, down = slopes + own, PENALTY * own - slopes
    slope, edge = torch.minimum(up, down).min(dim=1)
    rises = (up <= down).gather(1, edge[:, None])[:, 0]
    return edge, torch.where(rises, 1.0, -1.0).to(x), slope


def _select_component(tableau: Tensor, frame: Tensor, weights: Tensor, edge: Tensor, sign: Tensor, slope: Tensor) -> Tensor:
    """Return the component that vanishes at the least objective along an edge. -> (n,)"""
    import torch

    x = tableau[:, :, 0]
    direction = tableau.gather(2, (edge + 1)[:, None, None].expand(-1, x.shape[1], 1))[:, :, 0] * sign[:, None]  # (n, D)
    meets = ((x > ZERO) & (direction < -FLAT)) | ((x < -ZERO) & (direction > FLAT)) | ((x.abs() <= ZERO) & (direction < -FLAT))
    meets.scatter_(1, frame, False)
    distance = torch.where(meets, (-x / direction).clamp(min=0), torch.inf)
    # Where a component changes its sign, the slope grows by its weight before and after.
    bend = torch.where(meets, (1 + PENALTY) * weights * direction.abs(), 0.0)
    order = distance.argsort(dim=1)
    rising = slope[:, None] + bend.gather(1, order).cumsum(dim=1) >= 0
    return order.gather(1, rising.to(torch.int8).argmax(dim=1, keepdim=True))[:, 0]


def _exchange(tableau: Tensor, frame: Tensor, edge: Tensor, into: Tensor, where: Tensor) -> None:
    """Replace entry `edge` of the frame by component `into`, and update the tableau in place."""
    import torch

    rows = torch.arange(len(tableau), device=tableau.device)
    row = tableau[rows, into]  # (n, 1 + dim)
    pivot = row[rows, edge + 1]
    row[rows, edge + 1] = pivot - 1
    column = tableau[rows, :, edge + 1] / pivot[:, None]  # (n, D)
    column[~where] = 0
    tableau.baddbmm_(column[:, :, None], row[:, None], alpha=-1)
    frame[rows, edge] = torch.where(where, into, frame[rows, edge])


def _deduplicate(owners: NDArray[np.int64], points: Doubles) -> tuple[NDArray[np.int64], Doubles]:
    """Return each vertex of each polytope once. (n,), (n, D) -> (m,), (m, D)"""
    key = np.column_stack([owners, np.rint(points / EQUAL_TOLERANCE)]).astype(np.int64)
    first = np.sort(np.unique(key, axis=0, return_index=True)[1])
    first = first[np.argsort(owners[first], kind="stable")]
    return owners[first], points[first]


def _polish(origins: Doubles, bases: Doubles, points: Doubles) -> Doubles:
    """Return the points of D with the least mean square of the vanishing components. (n, D), (n, dim, D), (n, D) -> (n, D)"""
    vanishing = bases * (points <= 10 * ZERO)[:, None]  # (n, dim, D)
    coordinates = np.linalg.solve(vanishing @ bases.transpose(0, 2, 1), -vanishing @ origins[:, :, None])  # (n, dim, 1)
    return origins + (coordinates.transpose(0, 2, 1) @ bases)[:, 0]
