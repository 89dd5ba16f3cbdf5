"""The database attack in three dimensions (the paper's toy example): all that is drawn has been computed by the plugins.

Words lie along a curve on the sphere, as real descriptors lie on a manifold of few dimensions. One descriptor is lifted to a
plane through it and one word, and attacked by someone who knows the words. The seed shows what the attack counts on: the plane
meets the curve nowhere else. By other seeds it does, for in three dimensions a plane has little room, and the estimate is wrong.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bench.api import Asset, DescriptorAttack, Lifting, View
from bench.codebook.dictionary import Dictionary
from bench.codebook.public import Public
from bench.extractors.sift import Sift
from bench.geometry.nearest_words import unit_rows
from bench.geometry.subspaces import nearest_to_subspaces
from bench.registry import discovery
from bench.types import Features, Floats, Indices, Knowledge, Subspaces
from leaderboard.reproduce.drawing import Drawing, Scene
from leaderboard.reproduce.study import build

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D  # type: ignore[import-untyped]

Doubles = NDArray[np.float64]

SEED = 11
WORDS = 160
SPREAD = 0.02  # of the words about the curve
NEIGHBOURS, ESTIMATORS = 10, 4  # |V|, |U|
NEAR = 0.1  # distance to the plane up to which words are drawn within it


@dataclass(frozen=True, kw_only=True, eq=False)
class Toy:
    """One descriptor, its plane, and what the attack makes of it."""

    words: Floats  # (K, 3) in their order along the curve
    d: Floats  # (3,)
    release: Subspaces
    adversarial: int  # the word a_1
    near: Indices  # (|V|,) words next nearest to the plane
    chosen: Indices  # (|U|,) those of them that are farthest from a_1
    distances: Doubles  # (K,) from the words to the plane
    estimate: Floats  # (3,)


def compute(seed: int = SEED) -> Toy:
    """Lift a descriptor, and attack it."""
    rng = np.random.default_rng(seed)
    codes = np.rint(255 * (curve(np.linspace(0, 1, WORDS)) + SPREAD * rng.normal(size=(WORDS, 3))).clip(0, 1)).astype(np.uint8)
    dictionary = Dictionary(codes, {"photographs": []}, "toy")
    public = Public(known={"toy": dictionary})
    words = unit_rows(codes)
    d = unit_rows((curve(np.array([0.72])) + SPREAD * rng.normal(size=(1, 3))).astype(np.float32))  # (1, 3)
    secret = Features(keypoints=np.zeros((1, 2), np.float32), descriptors=d, codes=None, size=(1, 1))
    defense = build(discovery.DEFENSE, "affine", {"dim": 2, "sub_databases": 1, "database": Asset("toy")})
    attack = build(discovery.ATTACK, "database", {"neighbours": NEIGHBOURS, "estimators": ESTIMATORS})
    assert isinstance(defense, Lifting)
    assert isinstance(attack, DescriptorAttack)
    lifted = defense.lift(secret, public, rng)
    seen = View(release=lifted.release, defense=defense, extractor=Sift(), knowledge={Knowledge.DATABASE: lambda: dictionary})
    found, apart = nearest_to_subspaces(lifted.release, codes, WORDS)
    near = found[0, 1 : 1 + NEIGHBOURS]
    away = np.linalg.norm(words[near] - words[found[0, 0]], axis=1)
    return Toy(
        words=words,
        d=d[0],
        release=lifted.release,
        adversarial=int(lifted.words[0, 0]),
        near=near,
        chosen=near[np.argsort(-away, kind="stable")[:ESTIMATORS]],
        distances=apart[0][np.argsort(found[0])],
        estimate=attack.recover(seen, rng)[0],
    )


def curve(t: Doubles) -> Doubles:
    """Points of an arch over the positive octant of the unit sphere. (n,) -> (n, 3)"""
    points = np.stack([1.1 - t, 0.1 + t, 0.25 + 1.1 * np.sin(np.pi * t) ** 2], axis=1)
    return points / np.linalg.norm(points, axis=1, keepdims=True)


def drawn(scene: Scene) -> Iterator[tuple[str, Figure]]:
    from matplotlib.figure import Figure

    toy = compute()
    figure = Figure(figsize=(12, 4.4), layout="constrained", dpi=120)
    figure.suptitle("The database attack in three dimensions: a plane D through the descriptor d and the word a", fontsize=9)
    _space(figure.add_subplot(1, 3, 1, projection="3d"), toy)
    _plane(figure.add_subplot(1, 3, 2), toy)
    _distances(figure.add_subplot(1, 3, 3), toy)
    figure.legend(*figure.axes[1].get_legend_handles_labels(), loc="outside lower center", ncols=len(MARKS), fontsize=8)
    yield "", figure


MARKS: dict[str, dict[str, Any]] = {
    "words W": {"marker": ".", "color": "0.6", "s": 14},
    "V, near D": {"marker": "o", "facecolors": "white", "edgecolors": "black", "s": 30},
    "U, of these far from a": {"marker": "o", "color": "black", "s": 30},
    "a": {"marker": "s", "color": "black", "s": 50},
    "d": {"marker": "*", "facecolors": "white", "edgecolors": "black", "s": 150},
    "estimate of d": {"marker": "X", "facecolors": "white", "edgecolors": "black", "s": 60},
}


def _points(toy: Toy) -> tuple[Floats, ...]:
    """What each of `MARKS` is put on. -> (n, 3) each"""
    rest = np.setdiff1d(toy.near, toy.chosen)
    words = (toy.words, toy.words[rest], toy.words[toy.chosen], toy.words[[toy.adversarial]])
    return (*words, toy.d[None], toy.estimate[None])


def _space(axes: Axes3D, toy: Toy) -> None:
    """The curve, and the piece of the plane that holds what is near it."""
    origin, basis = toy.release.origins[0], toy.release.bases[0]
    within = (np.concatenate([toy.words[toy.near], toy.d[None]]) - origin) @ basis.T  # (|V| + 1, 2)
    (left, bottom), (right, top) = within.min(axis=0) - 0.2, within.max(axis=0) + 0.2
    corners = np.array([[left, bottom], [left, top], [right, bottom], [right, top]]) @ basis + origin  # (4, 3)
    axes.plot_surface(*corners.T.reshape(3, 2, 2), color="0.5", alpha=0.3)
    for (name, mark), points in zip(MARKS.items(), _points(toy), strict=True):
        if name in ("words W", "a", "d"):
            axes.scatter(*points.T, depthshade=False, **mark)
    axes.set_axis_off()
    axes.set_box_aspect((1, 1, 1), zoom=1.35)
    axes.view_init(elev=25, azim=35)
    axes.set_title("words along a curve, and D", fontsize=8)


def _plane(axes: Axes, toy: Toy) -> None:
    """The plane itself, and what is near it projected onto it."""
    origin, basis = toy.release.origins[0], toy.release.bases[0]
    for (name, mark), points in zip(MARKS.items(), _points(toy), strict=True):
        shown = points if name != "words W" else toy.words[toy.distances < NEAR]
        axes.scatter(*((shown - origin) @ basis.T).T, label=name, **mark)
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set_title(f"within D: words less than {NEAR:g} from it, projected", fontsize=8)


def _distances(axes: Axes, toy: Toy) -> None:
    """Two valleys: where the plane meets the curve on purpose, and where it hides d."""
    along, marks = np.arange(len(toy.words)), list(MARKS.values())
    rest = np.setdiff1d(toy.near, toy.chosen)
    for mark, chosen in zip(marks[:4], (along, rest, toy.chosen, np.array([toy.adversarial])), strict=True):
        axes.scatter(chosen, toy.distances[chosen], **mark)
    axes.scatter([int((toy.words @ toy.d).argmax())], [0.0], **MARKS["d"])
    axes.set(xlabel="words, in their order along the curve")
    axes.set_title("distance of each word to D (d at the word nearest to it)", fontsize=8)


DRAWING = Drawing(name="toy", draw=drawn)
