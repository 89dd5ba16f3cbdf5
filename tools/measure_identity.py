"""Calibration of the metrics `identity`, `identity-distance` and `perceptual` on pairs with known answers.

The photographs are two portraits from the wheels of scikit-image and matplotlib. The non-matching faces are the 100 of
scikit-image's subset of Labeled Faces in the Wild (25 x 25 pixels), put in place of each portrait's face. The page is
docs/results/identity.md.

    python tools/measure_identity.py
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np
import skimage.data
from PIL import Image
from result_page import format_interval, write_page
from scipy.ndimage import gaussian_filter

from attacks.dia import DIA
from attacks.keypoints import Keypoints
from bench.api import Defense, Metric
from bench.core.table import markdown_row
from bench.extractors.sift import Sift
from bench.identification import face_embedding
from bench.images import photographs
from bench.images.photographs import Source
from bench.runner.plan import RunConfiguration, build_plan, cross
from bench.runner.records import Record
from bench.runner.trial import TrialRunner
from bench.tasks.reconstruction import Reconstruction
from bench.types import Bytes, Floats
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended
from leaderboard.intervals import proportion
from leaderboard.tables import build_labels
from metrics.identity import Identity
from metrics.identity_distance import IdentityDistance
from metrics.perceptual import Perceptual
from metrics.ssim import SSIM

TEXT = """# Identity and perceptual distance: calibration

[Metrics of optional extras](../method.md#metrics-of-optional-extras) describes the metrics. Distances are those of
`identity-distance`: below 0.6, two faces count as one person. `identified` is the metric `identity`. A blur is Gaussian, with its
standard deviation.

## Pairs with known answers

{pairs}

## Non-matching faces

The faces are the 100 of scikit-image's subset of Labeled Faces in the Wild (25 by 25 pixels, grey). Each replaces the face of
both portraits. The pictures without a face are the other 100 of that subset. The noise fills the image. The rate of false
acceptance has Wilson's interval.

{non_matching}

## Reconstructions

The shipped networks reconstruct the two portraits from upright SIFT features, with seed 0. Two faces are an example, and no
estimate of a rate.

{reconstructions}

## Cost

Seconds are CPU time of one thread, the median of five estimates of one photograph with one face, once the models are loaded. They
are noisy: other processes shared the machine. `identity-distance` costs nothing beside `identity`, which shares its embeddings.

{seconds}
"""
FACES = 100  # the first pictures of the subset are faces, the others are not
NOISES = 50


def list_portraits() -> list[Source]:
    """Return the astronaut and the admiral."""
    astronaut, _, admiral = photographs.list_people()
    return [astronaut, admiral]


def read(source: Source) -> Floats:
    """Return a photograph. -> (256, 256, 3) float32 in [0, 1]"""
    return (photographs.read(source.path).pixels / 255).astype(np.float32)


def list_other_pictures() -> tuple[list[Bytes], list[Bytes]]:
    """Return faces and other pictures of scikit-image's subset of Labeled Faces in the Wild, (25, 25) uint8 each."""
    pictures = np.rint(skimage.data.lfw_subset() * 255).astype(np.uint8)
    return list(pictures[:FACES]), list(pictures[FACES:])


def replace_face(portrait: Floats, picture: Bytes) -> Floats:
    """Return the portrait with a picture in place of its detected face, resized to its box by Pillow's bicubic filter."""
    ((top, left, height, width),) = face_embedding.detect_faces(portrait.astype(np.float64)).astype(int)
    replaced = portrait.copy()
    resized = np.asarray(Image.fromarray(picture).convert("RGB").resize((width, height), Image.Resampling.BICUBIC))
    replaced[top : top + height, left : left + width] = resized / np.float32(255)
    return replaced


def blur(image: Floats, sigma: float) -> Floats:
    """Return the image under a Gaussian blur. (H, W, 3) -> the same shape"""
    return np.clip(gaussian_filter(image, (sigma, sigma, 0)), 0, 1)


def draw_noises(seed: int = 0) -> Iterator[Floats]:
    """Yield images of white noise, and of smooth noise by turns."""
    rng = np.random.default_rng(seed)
    for number in range(NOISES):
        noise = rng.random((256, 256, 3), np.float32)
        smooth = gaussian_filter(noise, (6, 6, 0))
        yield noise if number % 2 == 0 else (smooth - smooth.min()) / (smooth.max() - smooth.min())


def list_known_pairs(portrait: Floats, other: Floats) -> dict[str, Floats]:
    """Return estimates of a portrait with known answers."""
    return {
        "itself": portrait,
        **{f"blur of {sigma} pixels": blur(portrait, sigma) for sigma in (1, 2, 4)},
        "the other portrait": other,
        "grey": np.full_like(portrait, 0.5),
        "white noise": next(draw_noises()),
    }


def list_non_matching() -> dict[str, Callable[[Floats], Iterator[Floats]]]:
    """Return sets of estimates that show no face of the person."""
    faces, others = list_other_pictures()
    return {
        "other faces": lambda portrait: (replace_face(portrait, face) for face in faces),
        "pictures without a face": lambda portrait: (replace_face(portrait, other) for other in others),
        "white and smooth noise": lambda portrait: draw_noises(),
    }


def reconstruct(sources: list[Source]) -> tuple[dict[str, list[Floats]], list[Record]]:
    """Return the reconstructions of each experiment, one for each photograph, and the configurations."""
    task = Reconstruction()
    defenses: list[Defense] = [Undefended(), Affine(), LDP(epsilon=16), LDP()]
    pairs = (*cross(task, defenses, [DIA()]), (Undefended(), Keypoints()))
    plan = build_plan(RunConfiguration(pairs=pairs, images=sources, task=task, extractor=Sift(), dataset=None, seed=0))
    runner = TrialRunner(plan)
    labels = build_labels([(experiment.metadata["defense"], experiment.metadata["attack"]) for experiment in plan.experiments])
    images: dict[str, list[Floats]] = {}
    for experiment, (defense, attack) in zip(plan.experiments, labels, strict=True):
        outcomes = [plan.task.evaluate(runner.build_trial(experiment, sample)) for sample in plan.samples]
        images[f"`{attack}` on `{defense}`"] = [outcome.image for outcome in outcomes if outcome.image is not None]
    configurations = [experiment.metadata[part] for experiment in plan.experiments for part in ("defense", "attack")]
    return images, configurations


def compare(portraits: Sequence[Floats], estimates: Sequence[Floats]) -> Iterator[str]:
    """Yield distance, whether the person is identified, and perceptual distance, for each portrait."""
    for portrait, estimate in zip(portraits, estimates, strict=True):
        distance, identified = IdentityDistance()(portrait, estimate), Identity()(portrait, estimate)
        yield f"{distance:.3f}"
        yield "yes" if identified else "no"
        yield f"{Perceptual()(portrait, estimate):.3f}"


def measure_acceptance(portraits: Sequence[Floats], draw: Callable[[Floats], Iterator[Floats]]) -> Iterator[str]:
    """Yield the number of pairs, those with a detected face, those below the threshold, and the rate of acceptance."""
    compared = [face for portrait in portraits for estimate in draw(portrait) if (face := Identity().compare(portrait, estimate))]
    distances = np.concatenate([face.distances for face in compared])
    accepted = np.concatenate([face.identified for face in compared])
    yield str(len(distances))
    yield str(sum(int(face.detected.sum()) for face in compared))
    yield f"{np.median(distances):.3f}"
    yield f"{distances.min():.3f}"
    yield str(int((distances < face_embedding.THRESHOLD).sum()))
    yield str(int(accepted.sum()))
    yield format_interval(proportion(accepted.astype(float)), 3)


def measure_seconds(portrait: Floats) -> dict[str, str]:
    """Return the median CPU time of each metric, once its models are loaded."""
    metrics: dict[str, Metric] = {"`identity`": Identity(), "`perceptual`": Perceptual(), "`ssim`, for comparison": SSIM()}
    seconds: dict[str, list[float]] = {name: [] for name in metrics}
    for estimate in [blur(portrait, 0.5 + number / 4) for number in range(6)]:
        for name, metric in metrics.items():
            started = time.process_time()
            metric(portrait, estimate)
            seconds[name].append(time.process_time() - started)
    return {name: f"{np.median(each[1:]):.2f}" for name, each in seconds.items()}


def build_table(heading: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join(map(markdown_row, [heading, ["---"] * len(heading), *rows]))


def main() -> None:
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    sources = list_portraits()
    portraits = [read(source) for source in sources]
    scores = [f"{source.name}: {score}" for source in sources for score in ("distance", "identified", "perceptual")]
    known = [list_known_pairs(portrait, other) for portrait, other in (portraits, portraits[::-1])]
    pairs = {name: [pair[name] for pair in known] for name in known[0]}
    non_matching = {name: list(measure_acceptance(portraits, draw)) for name, draw in list_non_matching().items()}
    reconstructions, configurations = reconstruct(sources)
    columns = ("estimate", "pairs", "face detected", "median distance", "least distance", "below 0.6", "identified", "rate")
    text = TEXT.format(
        pairs=build_table(["estimate", *scores], [(name, *compare(portraits, pairs[name])) for name in pairs]),
        non_matching=build_table(columns, [(name, *row) for name, row in non_matching.items()]),
        reconstructions=build_table(
            ["reconstruction", *scores], [(name, *compare(portraits, images)) for name, images in reconstructions.items()]
        ),
        seconds=build_table(["metric", "seconds for a photograph"], measure_seconds(portraits[0]).items()),
    )
    write_page("identity.md", text, configurations)


if __name__ == "__main__":
    main()
