"""The database attack in three dimensions, as in the paper's toy example. The plugins compute everything that is drawn.

Words lie along a curve on the sphere, as real descriptors lie on a manifold of few dimensions. One descriptor is lifted to a
plane through it and one word. The attacker knows the words. The attack assumes that the plane intersects the curve nowhere
else, which is so for this seed. With other seeds the plane intersects it again, since three dimensions are few, and the
estimate is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.api import DescriptorAttack, Lifting, View
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import find_nearest_to_subspaces
from bench.registry import discovery
from bench.settings import Asset
from bench.threat_model import DefenseDatabase
from bench.types import Features, Floats, Indices, Subspaces
from leaderboard.reproduce.drawing import Drawing, FigureData
from leaderboard.reproduce.study import build_plugin

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

Doubles = NDArray[np.float64]

SEED = 11
WORDS = 160
SPREAD = 0.02  # standard deviation of the words around the curve
NEIGHBOURS, ESTIMATORS = 10, 4  # |V|, |U|
NEAR = 0.1  # words with a smaller distance to the plane are drawn in it


@dataclass(frozen=True, kw_only=True, eq=False)
class Toy:
    """One descriptor, its plane, and the attack's estimate."""

    words: Floats  # (K, 3) ordered along the curve
    d: Floats  # (3,)
    release: Subspaces
    adversarial: int  # the word a_1
    near: Indices  # (|V|,) the words next nearest to the plane
    estimators: Indices  # (|U|,) the words of `near` that are farthest from a_1
    distances: Doubles  # (K,) from the words to the plane
    estimate: Floats  # (3,)


def run_attack(seed: int = SEED) -> Toy:
    """Lift a descriptor and attack the release."""
    rng = np.random.default_rng(seed)
    codes = np.rint(255 * (sample_curve(np.linspace(0, 1, WORDS)) + SPREAD * rng.normal(size=(WORDS, 3))).clip(0, 1)).astype(
        np.uint8
    )
    dictionary = Dictionary(codes, {"photographs": []}, "toy")
    public = Public(dictionaries={"toy": dictionary})
    words = unit_rows(codes)
    d = unit_rows((sample_curve(np.array([0.72])) + SPREAD * rng.normal(size=(1, 3))).astype(np.float32))  # (1, 3)
    secret = Features(keypoints=np.zeros((1, 2), np.float32), descriptors=d, codes=None, size=(1, 1))
    defense = build_plugin(discovery.DEFENSE, "affine", {"dim": 2, "sub_databases": 1, "database": Asset("toy")})
    attack = build_plugin(discovery.ATTACK, "database", {"neighbours": NEIGHBOURS, "estimators": ESTIMATORS})
    assert isinstance(defense, Lifting)
    assert isinstance(attack, DescriptorAttack)
    lifted = defense.lift(secret, public, rng)
    view = View(
        release=lifted.release,
        defense=defense,
        extractor=Sift(),
        knowledge={DefenseDatabase: lambda: DefenseDatabase(words=dictionary.words)},
    )
    order, distances = find_nearest_to_subspaces(lifted.release, codes, WORDS)
    near = order[0, 1 : 1 + NEIGHBOURS]
    from_adversarial = np.linalg.norm(words[near] - words[order[0, 0]], axis=1)
    return Toy(
        words=words,
        d=d[0],
        release=lifted.release,
        adversarial=int(lifted.words[0, 0]),
        near=near,
        estimators=near[np.argsort(-from_adversarial, kind="stable")[:ESTIMATORS]],
        distances=distances[0][np.argsort(order[0])],
        estimate=attack.recover(view, rng)[0],
    )


def sample_curve(t: Doubles) -> Doubles:
    """Return points of an arch over the positive octant of the unit sphere. (n,) -> (n, 3)"""
    points = np.stack([1.1 - t, 0.1 + t, 0.25 + 1.1 * np.sin(np.pi * t) ** 2], axis=1)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def draw_figures(data: FigureData) -> Iterator[tuple[str, Figure]]:
    from matplotlib.figure import Figure

    toy = run_attack()
    figure = Figure(figsize=(12, 4.4), layout="constrained", dpi=120)
    figure.suptitle("The database attack in three dimensions: a plane D through the descriptor d and the word a", fontsize=9)
    _draw_space(figure.add_subplot(1, 3, 1, projection="3d"), toy)
    _draw_plane(figure.add_subplot(1, 3, 2), toy)
    _draw_distances(figure.add_subplot(1, 3, 3), toy)
    figure.legend(*figure.axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=len(MARKERS), fontsize=8)
    yield "", figure


MARKERS: dict[str, dict[str, Any]] = {
    "words W": {"marker": ".", "color": "0.6", "s": 14},
    "V, near D": {"marker": "o", "facecolors": "white", "edgecolors": "black", "s": 30},
    "U, of these far from a": {"marker": "o", "color": "black", "s": 30},
    "a": {"marker": "s", "color": "black", "s": 50},
    "d": {"marker": "*", "facecolors": "white", "edgecolors": "black", "s": 150},
    "estimate of d": {"marker": "X", "facecolors": "white", "edgecolors": "black", "s": 60},
}


def _group_points(toy: Toy) -> tuple[Floats, ...]:
    """Return the points of each of `MARKERS`. -> (n, 3) each"""
    rest = np.setdiff1d(toy.near, toy.estimators)
    words = (toy.words, toy.words[rest], toy.words[toy.estimators], toy.words[[toy.adversarial]])
    return (*words, toy.d[None], toy.estimate[None])


def _draw_space(axes: Axes3D, toy: Toy) -> None:
    """Draw the curve, and the part of the plane that contains the near words."""
    origin, basis = toy.release.origins[0], toy.release.bases[0]
    coordinates = (np.concatenate([toy.words[toy.near], toy.d[None]]) - origin) @ basis.T  # (|V| + 1, 2)
    (left, bottom), (right, top) = coordinates.min(axis=0) - 0.2, coordinates.max(axis=0) + 0.2
    corners = np.array([[left, bottom], [left, top], [right, bottom], [right, top]]) @ basis + origin  # (4, 3)
    axes.plot_surface(*corners.T.reshape(3, 2, 2), color="0.5", alpha=0.3)
    for (name, marker), points in zip(MARKERS.items(), _group_points(toy), strict=True):
        if name in ("words W", "a", "d"):
            axes.scatter(*points.T, depthshade=False, **marker)
    axes.set_axis_off()
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.view_init(elev=25, azim=35)
    axes.set_title("words along a curve, and D", fontsize=8)


def _draw_plane(axes: Axes, toy: Toy) -> None:
    """Draw the plane, with the near words projected onto it."""
    origin, basis = toy.release.origins[0], toy.release.bases[0]
    for (name, marker), points in zip(MARKERS.items(), _group_points(toy), strict=True):
        selection = points if name != "words W" else toy.words[toy.distances < NEAR]
        axes.scatter(*((selection - origin) @ basis.T).T, label=name, **marker)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"within D: words less than {NEAR:g} from it, projected", fontsize=8)


def _draw_distances(axes: Axes, toy: Toy) -> None:
    """Draw the distances to the plane. They have two minima, at the adversarial word and at d."""
    positions, markers = np.arange(len(toy.words)), list(MARKERS.values())
    rest = np.setdiff1d(toy.near, toy.estimators)
    for marker, words in zip(markers[:4], (positions, rest, toy.estimators, np.array([toy.adversarial])), strict=True):
        axes.scatter(words, toy.distances[words], **marker)
    axes.scatter([int((toy.words @ toy.d).argmax())], [0.0], **MARKERS["d"])
    axes.set(xlabel="words, ordered along the curve")
    axes.set_title("distance of each word to D (d at the word nearest to it)", fontsize=8)


DRAWING = Drawing(name="toy", draw=draw_figures)
