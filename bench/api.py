"""Base classes of plugins. A plugin is one frozen, keyword-only dataclass; its typed fields are its whole configuration."""

from __future__ import annotations

import shutil
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar, Literal, TypeVar, final

import numpy as np

from bench.core import environment
from bench.settings import Between, OneOf
from bench.threat_model import Knowledge
from bench.types import Features, Floats, Indices, Lines, Points, Positions, Release, Subspaces

if TYPE_CHECKING:
    from bench.codebook.public import Public
    from bench.images.photographs import Source
    from bench.images.scene import Scene

K = TypeVar("K", bound=Knowledge)

NOT_CONVERGED = "not converged"  # start of a note in `View.notes`: the attack reached its budget first


class Plugin:
    """Base class of all plugins."""

    @classmethod
    def name(cls) -> str:
        """Return the plugin's name: the name of its file, with hyphens for underscores."""
        return cls.__module__.rpartition(".")[2].replace("_", "-")

    @classmethod
    def summary(cls) -> str:
        """Return the first line of the docstring."""
        return (cls.__doc__ or "").strip().partition("\n")[0]

    @classmethod
    def description(cls) -> str:
        """Return the text of `bench list`: the summary, and further declarations of some kinds of plugins."""
        return cls.summary()


@dataclass(frozen=True)
class Privacy:
    """The guarantee of a defense for one descriptor."""

    guarantee: str  # "none", "epsilon-ldp", "epsilon-ldp-by-word" of a memoized defense, "d-chi", ...
    epsilon: float | None = None  # nats, for one descriptor; None without a guarantee
    log10_true: float | None = None  # log10 of the probability that the true word is in its set
    # Nats per unit of distance, if the guarantee grows with the distance of descriptors ("d-chi"); not comparable with ε.
    per_distance: float | None = None


# ---- defenses


class Defense(Plugin, ABC):
    """Turns the secret features into a release."""

    releases: ClassVar[type[Release]]
    positions: ClassVar[type[Positions]] = Points  # of the release
    # Field -> the values that one trained network supports. Training draws them at random.
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {}
    # Field that names the dictionary for the quantisation, and field with the number of its words in use.
    dictionary_field: ClassVar[str | None] = None
    word_count_field: ClassVar[str | None] = None
    # Whether released descriptors carry added noise.
    noisy: ClassVar[bool] = False

    @abstractmethod
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Release:
        """Return a release that shares no memory with the secret. All randomness comes from `rng`."""

    @abstractmethod
    def privacy(self, public: Public) -> Privacy:
        """Return the guarantee for one descriptor, and the probability of the true word if it can be computed."""

    def distance(self, secret: Features, public: Public, one: int, other: int) -> Fraction:
        """Return the distance between descriptors `one` and `other` of the secret, in the metric of the guarantee.

        Under ε-LDP the distance of different descriptors is 1. `one` and `other` are indices.
        """
        return Fraction(int(one != other))

    def hides_positions(self) -> bool:
        """Return whether the release has other positions than the keypoints in the clear."""
        return not issubclass(self.positions, Points)

    def is_memoized(self) -> bool:
        """Return whether a device always gives the same answer for equal descriptors.

        `protect` then receives a generator in the same state at each call: the state stands for the device.
        """
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class LiftedRelease:
    """A release of subspaces, with its secret: the database words in each subspace."""

    release: Subspaces
    words: Indices  # (N, adversarial) rows of the defense's `database` in each subspace


class Lifting(Defense):
    """A defense that hides each descriptor in a subspace, which may also contain words of a database.

    The number of words is public, as is the whole configuration. An attack on such words requires a defense of this type. The
    field `database` names the database.
    """

    releases = Subspaces

    @property
    @abstractmethod
    def adversarial(self) -> int:
        """Number of database words in each subspace."""

    @abstractmethod
    def lift(self, secret: Features, public: Public, rng: np.random.Generator) -> LiftedRelease:
        """Return the release of `protect`, with the database words in its subspaces."""

    @final
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Subspaces:
        """Return the release of `lift`."""
        return self.lift(secret, public, rng).release


# ---- attacks


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """Input of an attack: the release, its public configuration, and the knowledge that the attack declares in `needs`."""

    release: Release
    defense: Defense  # its configuration is public; its randomness is not
    extractor: Extractor
    knowledge: Mapping[type[Knowledge], Callable[[], Knowledge]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # remarks of the attack, copied to the record

    def know(self, kind: type[K]) -> K:
        """Return the knowledge of class `kind`.

        Raises
        ------
        PermissionError
            if the attack did not list it in its `needs`.
        """
        if kind not in self.knowledge:
            raise PermissionError(f"this attack did not declare {kind.__name__} in its `needs`")
        knowledge = self.knowledge[kind]()
        assert isinstance(knowledge, kind)
        return knowledge


class Attack(Plugin, ABC):
    """Reads a `View` and undoes the defense. Subclass one of the four classes below."""

    accepts: ClassVar[tuple[type[Release], ...]]
    accepts_positions: ClassVar[tuple[type[Positions], ...]] = (Points,)
    needs: ClassVar[frozenset[type[Knowledge]]] = frozenset()

    def repeats(self) -> int:
        """Return the number of further releases of the same photograph that this attack reads (`RepeatedReleases`)."""
        return 0

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why this attack, as configured, has nothing adapted to the defense; None if it has.

        For example, no network was trained for the releases of that defense.
        """
        return None

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        """Return field -> digest of the file that this attack uses against the defense. Records hold it in place of the name."""
        return {}

    @final
    def explain_not_applicable(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Return the reason why this attack does not apply to the defense, by types and declarations; None if it applies."""
        if not issubclass(defense.releases, self.accepts):
            accepted = " or ".join(kind.__name__ for kind in self.accepts)
            return f"{self.name()} attacks {accepted}; {defense.name()} releases {defense.releases.__name__}"
        if not issubclass(defense.positions, self.accepts_positions):
            accepted = " or ".join(kind.__name__ for kind in self.accepts_positions)
            return f"{self.name()} reads {accepted}; {defense.name()} releases {defense.positions.__name__}"
        return self.explain_incompatible(defense, extractor, public)


class DescriptorAttack(Attack):
    """Recovers one descriptor per keypoint. The network for raw descriptors then reconstructs the image."""

    @abstractmethod
    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        """Return (N, D) float32 unit-norm estimates, in the order of the release's keypoints."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Selection:
    """Estimated descriptors for some keypoints of a release."""

    rows: Indices  # (R,) of the release
    descriptors: Floats  # (R, D) unit norm


class SelectiveAttack(Attack):
    """Recovers descriptors of selected keypoints. The network for raw descriptors reconstructs the image from these alone."""

    @abstractmethod
    def select(self, view: View, rng: np.random.Generator) -> Selection:
        """Return the selected keypoints, possibly none, and float32 estimates of their descriptors."""


class ImageAttack(Attack):
    """Reconstructs the photograph itself."""

    @abstractmethod
    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        """Return an (H, W, 3) float32 RGB image in [0, 1] of the release's size."""


class PositionAttack(Attack):
    """Recovers the hidden position of each keypoint. The network for the released descriptors then reconstructs the image."""

    accepts_positions = (Lines,)

    @abstractmethod
    def locate(self, view: View, rng: np.random.Generator) -> Floats:
        """Return (N, 2) float32 positions in pixels, in the order of the release's keypoints."""


def explain_no_words(defense: Defense) -> str | None:
    """Return the reason why the subspaces of the defense contain no database word; None if they contain some."""
    if not isinstance(defense, Lifting):
        return f"{defense.name()} does not say how many database words its subspaces contain"
    if defense.adversarial == 0:
        return f"{defense.name()} as configured has no database words in its subspaces"
    return None


def require_subspaces(view: View) -> tuple[Subspaces, int]:
    """Return the subspaces that a lifting released, and the number of database words in each.

    Raises
    ------
    TypeError
        if the release is of another type, or the defense is no `Lifting`.
    """
    release, defense = view.release, view.defense
    if not isinstance(release, Subspaces) or not isinstance(defense, Lifting):
        raise TypeError(f"expected the Subspaces of a Lifting, got {type(release).__name__} of {type(defense).__name__}")
    return release, defense.adversarial


# ---- metrics, datasets, extractors


class Metric(Plugin, ABC):
    """A pure function of the truth and an estimate."""

    # "views" compares a reconstruction with other views of its scene, and is computed on datasets alone.
    # "positions" compares keypoints, and is computed only for defenses that hide positions.
    compares: ClassVar[Literal["images", "descriptors", "views", "positions"]]
    unit: ClassVar[str]
    range: ClassVar[tuple[float, float]]
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]]
    # Parameters that the formula leaves open, as records hold them.
    parameters: ClassVar[Mapping[str, Any]] = {}
    # Distributions of an optional extra. Where all are installed, `bench run` and suites compute the metric.
    packages: ClassVar[tuple[str, ...]] = ()
    # Programs of the operating system, likewise.
    programs: ClassVar[tuple[str, ...]] = ()

    @classmethod
    def is_installed(cls) -> bool:
        """Return whether all packages and programs are installed."""
        return all(map(environment.is_installed, cls.packages)) and all(map(shutil.which, cls.programs))

    @classmethod
    def description(cls) -> str:
        """Return the summary with the unit, the range, and for whom higher is better."""
        low, high = cls.range
        return f"{cls.summary()} ({cls.unit}, {low:g} to {high:g}, higher is better for the {cls.higher_is_better_for})"

    @abstractmethod
    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        """Return the value; None if it is not finite. Images are (H, W, 3) in [0, 1], descriptors are (N, D),
        positions are (N, 2) pixels.

        For "views", the truth has (256, 16, 16) thumbnails (`bench.identification`): another view of the scene, then views of
        others. The estimate is an image.
        """

    def describe_truth(self, truth: Floats) -> str | None:
        """Return a note for the records on an image (H, W, 3) in [0, 1], such as the number of objects that are compared."""
        return None


class LocalMetric(Metric):
    """A metric of images with a value for each pixel, so that it can be averaged over parts of an image."""

    compares = "images"

    @abstractmethod
    def local(self, truth: Floats, estimate: Floats) -> Floats:
        """Return the value of each pixel, the mean over channels. (H, W, 3) twice -> (H, W)"""


class Dataset(Plugin, ABC):
    """A photographed scene, for tasks that need camera poses."""

    @abstractmethod
    def scene(self) -> Scene:
        """Return the scene. Its images are read on demand.

        Raises
        ------
        UserError
            if a part is missing or damaged; the message names file and line.
        """


class Extractor(Plugin, ABC):
    """Turns a photograph into `Features`."""

    # Public properties of the descriptors, which attacks may use.
    exact_zeros: bool = False  # no component is negative, and many are exactly zero
    eight_bit: bool = False  # each descriptor is an 8-bit integer vector, scaled to unit norm
    match_ratio: ClassVar[float] = 0.8  # of Lowe's test between raw descriptors; 1 leaves it out
    # Whether features are found by the photograph's name, so that its content does not determine them.
    reads_stored: ClassVar[bool] = False

    @abstractmethod
    def extract(self, image: np.ndarray, source: Source | None = None) -> Features:
        """Return the features of an (H, W, 3) uint8 RGB image, in the order of `Features.by_position`.

        `source` is the photograph's file and its name below the image folder, if it has them.

        Raises
        ------
        SampleError
            if there is no keypoint.
        """

    def list_notes(self, source: Source | None) -> tuple[str, ...]:
        """Return remarks on the features of a photograph, which its record holds. `source` is as in `extract`."""
        return ()

    def mirror_order(self) -> Indices | None:
        """Return the (D,) permutation of a descriptor's components in the mirrored photograph; None if there is none."""
        return None

    def turn_order(self) -> Indices | None:
        """Return the permutation for the photograph turned by 90 degrees counter-clockwise; None if there is none."""
        return None

    def without_limit(self) -> Extractor:
        """Return the extractor without its limit on the number of keypoints, for the construction of dictionaries."""
        return self
