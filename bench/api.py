"""The base classes of plugins. A plugin is one frozen, keyword-only dataclass whose typed fields are its whole configuration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import TYPE_CHECKING, Any, ClassVar, Literal, final

import numpy as np

from bench.types import Bytes, Features, Floats, Indices, Knowledge, Release, Subspaces

if TYPE_CHECKING:
    from pathlib import Path

    from bench.codebook.public import Public
    from bench.images.samples import Collection, Images, Sample
    from bench.images.scene import Mask, Scene


class Asset(str):
    """A field's type: `shipped`, or the path of a file. Records hold the content's hash instead of the name."""


@dataclass(frozen=True)
class Between:
    """All real settings of a field from `low` to `high`."""

    low: float
    high: float

    def sample(self, rng: np.random.Generator) -> float:
        return float(rng.uniform(self.low, self.high))

    def __contains__(self, value: object) -> bool:
        return isinstance(value, (int, float)) and self.low <= value <= self.high

    def __str__(self) -> str:
        return f"{self.low:g} to {self.high:g}"


@dataclass(frozen=True)
class OneOf:
    """The listed settings of a field."""

    values: tuple[float | str, ...]

    def sample(self, rng: np.random.Generator) -> float | str:
        return self.values[rng.integers(len(self.values))]

    def __contains__(self, value: object) -> bool:
        return value in self.values

    def __str__(self) -> str:
        return ", ".join(map(str, self.values))


@dataclass(frozen=True)
class Privacy:
    """What a defense promises of one descriptor."""

    guarantee: str  # "none", "epsilon-ldp", "epsilon-ldp-by-word" of a defense that remembers, "d-chi", ...
    epsilon: float | None = None  # nats, of one descriptor; None where nothing is promised
    log10_true: float | None = None  # log10 of the chance that the true word is in its set
    # Nats per unit of distance, where descriptors are promised to be hidden among near ones ("d-chi"): nothing to compare ε with.
    per_distance: float | None = None


class Plugin:
    """What every plugin has in common. Its name is its file's."""

    @classmethod
    def name(cls) -> str:
        return cls.__module__.rpartition(".")[2].replace("_", "-")

    @classmethod
    def summary(cls) -> str:
        """The first line of the docstring."""
        return (cls.__doc__ or "").strip().partition("\n")[0]

    @classmethod
    def description(cls) -> str:
        """The summary, and whatever else a reader of a list of plugins needs."""
        return cls.summary()


class Defense(Plugin, ABC):
    """Turns the secret features into what leaves the phone."""

    releases: ClassVar[type[Release]]
    # The settings that one trained attacker serves. A network trained for this plugin sees them drawn at random.
    supported_settings: ClassVar[Mapping[str, Between | OneOf]] = {}
    # The field that names the dictionary by which descriptors are quantised, if they are, and the field that says how many of
    # its words are used.
    dictionary_field: ClassVar[str | None] = None
    word_count_field: ClassVar[str | None] = None
    # Whether the descriptors that it releases are buried in noise.
    noisy: ClassVar[bool] = False

    @abstractmethod
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Release:
        """Return a release that shares no memory with the secret. All randomness comes from `rng`."""

    @abstractmethod
    def privacy(self, public: Public) -> Privacy:
        """What is promised of one descriptor, and where it can be computed, the chance that it is told."""

    def distance(self, secret: Features, public: Public, one: int, other: int) -> Fraction:
        """How far apart the promise takes two of these descriptors to be: ε-LDP treats all alike. One's own distance is 0."""
        return Fraction(int(one != other))

    def is_memoized(self) -> bool:
        """Whether one device gives equal descriptors equal answers. `rng` then is the device: in the same state at each call."""
        return False


@dataclass(frozen=True, kw_only=True, eq=False)
class LiftedRelease:
    """A release of subspaces beside what only its owner knows of it."""

    release: Subspaces
    words: Indices  # (N, adversarial) rows of the defense's `database` that each subspace goes through


class Lifting(Defense):
    """A defense that hides each descriptor in a subspace, and may lead it through words of a database on purpose.

    How many words is public, as the whole configuration is; an attack on such words asks for this type. The field `database`
    names where they are from.
    """

    releases = Subspaces

    @property
    @abstractmethod
    def adversarial(self) -> int:
        """Words of the database that a subspace goes through."""

    @abstractmethod
    def lift(self, secret: Features, public: Public, rng: np.random.Generator) -> LiftedRelease:
        """Make the release of `protect`, and tell which words it goes through."""

    @final
    def protect(self, secret: Features, public: Public, rng: np.random.Generator) -> Subspaces:
        return self.lift(secret, public, rng).release


@dataclass(frozen=True, kw_only=True, eq=False)
class View:
    """All that an attack may look at: the release, how it was made, and the knowledge that it declared to need."""

    release: Release
    defense: Defense  # its configuration is public; its randomness is not
    extractor: Extractor
    knowledge: Mapping[Knowledge, Callable[[], Any]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)  # what the attack says of its run; the record keeps it

    def know(self, what: Knowledge) -> Any:
        """Return the knowledge `what`.

        Raises
        ------
        PermissionError
            if the attack did not list it in its `needs`.
        """
        if what not in self.knowledge:
            raise PermissionError(f"this attack did not declare {what.name} in its `needs`")
        return self.knowledge[what]()


def explain_no_words(defense: Defense) -> str | None:
    """Why the subspaces of that defense go through no word of a database; None if they do."""
    if not isinstance(defense, Lifting):
        return f"{defense.name()} does not say how many words its subspaces go through"
    if defense.adversarial == 0:
        return f"{defense.name()} as configured leads its subspaces through no word"
    return None


def require_subspaces(view: View) -> tuple[Subspaces, int]:
    """The subspaces that a lifting released, and how many words of its database each goes through.

    Raises
    ------
    TypeError
        if it is another release, or another defense's.
    """
    release, defense = view.release, view.defense
    if not isinstance(release, Subspaces) or not isinstance(defense, Lifting):
        raise TypeError(f"expected the Subspaces of a Lifting, got {type(release).__name__} of {type(defense).__name__}")
    return release, defense.adversarial


class Attack(Plugin, ABC):
    """Sees a `View` and tries to undo the defense. Subclass `DescriptorAttack`, `SelectiveAttack` or `ImageAttack`."""

    accepts: ClassVar[tuple[type[Release], ...]]
    needs: ClassVar[frozenset[Knowledge]] = frozenset()

    def repeats(self) -> int:
        """Further releases of the same photograph that this attack, as configured, sees: those of REPEATED_RELEASES."""
        return 0

    def explain_incompatible(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Why this attack, as configured, has nothing adapted to that defense; None if it has."""
        return None

    def assets(self, defense: Defense, extractor: Extractor, public: Public) -> Mapping[str, str]:
        """Field -> digest of the content that this attack would use against that defense; records hold it for the name."""
        return {}

    @final
    def explain_not_applicable(self, defense: Defense, extractor: Extractor, public: Public) -> str | None:
        """Why this attack does not apply to that defense, decided by types and declarations; None if it does."""
        if not issubclass(defense.releases, self.accepts):
            accepted = " or ".join(kind.__name__ for kind in self.accepts)
            return f"{self.name()} attacks {accepted}; {defense.name()} releases {defense.releases.__name__}"
        return self.explain_incompatible(defense, extractor, public)


# Carries out a method of an attack, such as `attack.recover`, on what it sees.
Execute = Callable[[Callable[[View, np.random.Generator], Any], View, np.random.Generator], Any]


def execute_in_process(method: Callable[[View, np.random.Generator], Any], view: View, rng: np.random.Generator) -> Any:
    """Carry it out here and now. `bench.runner.attack_process` does it in another process."""
    return method(view, rng)


class DescriptorAttack(Attack):
    """Recovers one descriptor a keypoint. Images are then made by the network for raw descriptors."""

    @abstractmethod
    def recover(self, view: View, rng: np.random.Generator) -> Floats:
        """Return (N, D) float32 unit-norm estimates, in the order of the release's keypoints."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Selection:
    """Descriptors of some of a release's keypoints."""

    rows: Indices  # (R,) of the release
    descriptors: Floats  # (R, D) unit norm


class SelectiveAttack(Attack):
    """Recovers descriptors where it can. Images are made of those keypoints alone, by the network for raw descriptors."""

    @abstractmethod
    def select(self, view: View, rng: np.random.Generator) -> Selection:
        """Return the keypoints that it is sure of, perhaps none, and float32 estimates of their descriptors."""


class ImageAttack(Attack):
    """Recovers the photograph itself."""

    @abstractmethod
    def reconstruct(self, view: View, rng: np.random.Generator) -> Floats:
        """Return an (H, W, 3) float32 RGB image in [0, 1] of the release's size."""


class Metric(Plugin, ABC):
    """A pure function of the truth and an estimate."""

    compares: ClassVar[Literal["images", "descriptors"]]
    unit: ClassVar[str]
    range: ClassVar[tuple[float, float]]
    higher_is_better_for: ClassVar[Literal["attacker", "defender"]]
    # What the formula leaves open, as records hold it.
    parameters: ClassVar[Mapping[str, Any]] = {}

    @classmethod
    def description(cls) -> str:
        """The summary with the unit, the range, and for whom higher is better."""
        low, high = cls.range
        return f"{cls.summary()} ({cls.unit}, {low:g} to {high:g}, higher is better for the {cls.higher_is_better_for})"

    @abstractmethod
    def __call__(self, truth: Floats, estimate: Floats) -> float | None:
        """Images are (H, W, 3) in [0, 1]; descriptors are (N, D). None where the value is not finite."""


class LocalMetric(Metric):
    """A metric of images that can be told for each pixel, so that parts of an image can be compared."""

    compares = "images"

    @abstractmethod
    def local(self, truth: Floats, estimate: Floats) -> Floats:
        """(H, W, 3) twice -> (H, W), the mean over channels."""


class Dataset(Plugin, ABC):
    """A place that was photographed, for tasks that need to know where."""

    @abstractmethod
    def scene(self) -> Scene:
        """Return the scene; its images are read when they are asked for.

        Raises
        ------
        UserError
            naming file and line, if something of it is missing or damaged.
        """


class Extractor(Plugin, ABC):
    """Turns a photograph into `Features`."""

    # What is publicly known of its descriptors, which attacks may rest on.
    exact_zeros: bool = False  # none is negative, and many components are exactly zero
    eight_bit: bool = False  # each is an 8-bit integer vector, scaled to unit norm

    @abstractmethod
    def extract(self, image: np.ndarray, source: Path | None = None) -> Features:
        """Extract from an (H, W, 3) uint8 RGB image, in the order of `Features.by_position`.

        `source` is the photograph's file, where it has one.

        Raises
        ------
        UnitError
            if there is no keypoint.
        """

    def mirror_order(self) -> Indices | None:
        """The order in which a descriptor's components are those of the mirrored photograph's, (D,); None if there is none."""
        return None

    def turn_order(self) -> Indices | None:
        """The same for the photograph turned by a quarter, counter-clockwise."""
        return None

    def without_limit(self) -> Extractor:
        """The same without its limit on the number of keypoints, if it has one: for dictionaries, which are made of many."""
        return self


@dataclass(frozen=True, kw_only=True, eq=False)
class ProtectedImage:
    """One image of a unit: what only its owner has, and what was released of it."""

    pixels: Callable[[], Bytes]  # (H, W, 3); read when it is asked for
    secret: Features
    release: Release
    foreground: Callable[[], Mask | None] = lambda: None  # (H, W) where something hides the scene that moves, if that is known


@dataclass(frozen=True, kw_only=True, eq=False)
class Trial:
    """One unit of one cell of the experiment: the truth, what was released of it, and who attacks."""

    sample: Sample
    images: tuple[ProtectedImage, ...]  # one for each image of the unit
    defense: Defense
    attack: Attack | None  # None where the task judges the release itself
    extractor: Extractor
    public: Public
    metrics: tuple[Metric, ...]
    rng: np.random.Generator
    others: Callable[[int], Iterator[Release]]  # the first so many releases of other photographs
    repeats: tuple[Release, ...]  # further releases of the first image's features
    execute: Execute = execute_in_process  # where the attack is carried out
    provenance: Mapping[str, Any] | None = None  # JSON: all that the releases are a function of; None keeps nothing of the trial

    @property
    def secret(self) -> Features:
        """Of the unit's first image, for most the only one."""
        return self.images[0].secret

    @property
    def release(self) -> Release:
        """Of the unit's first image, for most the only one."""
        return self.images[0].release

    def pixels(self) -> Bytes:
        """(H, W, 3) of the unit's first image, for most the only one."""
        return self.images[0].pixels()

    def released(self, release: Release) -> Trial:
        """The same trial, had that been released of the unit's first image."""
        return replace(self, images=(replace(self.images[0], release=release), *self.images[1:]))


@dataclass(frozen=True, kw_only=True, eq=False)
class Outcome:
    """How a trial ended."""

    metrics: Mapping[str, float | None]
    image: Floats | None = None  # (H, W, 3) in [0, 1], where one was made
    estimates: Mapping[str, Any] = field(default_factory=dict)  # what was found that is no measure of it, such as a pose; JSON
    notes: tuple[str, ...] = ()
    saved_seconds: float = 0.0  # seconds that it would have taken longer, had nothing been kept


class Task(Plugin, ABC):
    """What a release is judged by. The runner plans, resumes and records; a task does one trial at a time."""

    judges_attacks: ClassVar[bool]  # whether it judges what an attack makes of the release, and not the release itself
    needs_scene: ClassVar[bool] = False  # whether it is about a place, even if none is named
    needs_map: ClassVar[bool] = False  # whether it asks for the place's map

    @abstractmethod
    def collect(self, images: Images, dataset: Dataset | None) -> Collection:
        """What there is to judge, given photographs or a place; the built-in ones where neither is given.

        Raises
        ------
        UserError
            if they are missing or damaged, or are not what this task judges.
        """

    @abstractmethod
    def explain_not_applicable(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> str | None:
        """Why there is nothing to judge in that pair; None if there is."""

    @abstractmethod
    def resolve(self, defense: Defense, attack: Attack | None, extractor: Extractor, public: Public) -> Mapping[str, Any]:
        """What the attack would use of other plugins and files, with digests: merged into its recorded configuration.

        Raises
        ------
        UserError
            if something that it would use is missing or damaged.
        """

    @abstractmethod
    def evaluate(self, trial: Trial) -> Outcome:
        """Carry out one trial.

        Raises
        ------
        UnitError
            if it cannot be done.
        """
