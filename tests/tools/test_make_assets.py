"""The trainings that rebuild the shipped networks have the releases, photographs, sizes and inputs of the shipped files.

Their steps may differ: several stages are merged into one.
"""

import dataclasses
from collections.abc import Iterator

import make_assets
import pytest
from make_assets import SAMPLERS, TRAININGS, Training

from bench.codebook.public import ASSETS
from bench.formats import tensor_file
from bench.inversion import weights
from bench.inversion.network import Shape
from bench.registry import discovery, spec

ELSEWHERE = {"inversion-ldp"}  # trained by tools/train_word_attackers.py
THIRDS = {"2": 266, "012": 800}  # photographs of a set, in thirds
ALL = (*TRAININGS, *SAMPLERS)


def name_defense(text: str) -> str:
    """Return the name of a defense, and how it lifts, if it does."""
    defense = spec.read(text, discovery.DEFENSE)
    return f"{defense.name()}:{getattr(defense, 'lifting', '')}"


def list_differences(training: Training) -> Iterator[str]:
    """Yield what differs between a training and the metadata of the shipped file."""
    meta = weights.load(ASSETS / f"{training.file}.safetensors").meta
    options = dict(zip(training.options[::2], training.options[1::2], strict=True))
    trained = [meta["defense"], *(other["defense"] for other in meta.get("others", []))]
    if sorted(map(name_defense, training.defenses)) != sorted(f"{each['name']}:{each.get('lifting', '')}" for each in trained):
        yield "defenses"
    widths = [int(width) for width in training.widths.split(",")] if training.widths else list(Shape.widths)
    if widths != meta["shape"]["widths"]:
        yield "widths"
    extractor = options.get("--extractor", "sift")
    fields = spec.parse(extractor, discovery.EXTRACTOR)[1]
    if meta["extractor"]["name"] != extractor.partition(":")[0] or any(
        str(meta["extractor"][field]) != str(value) for field, value in fields.items()
    ):
        yield "extractor"
    if THIRDS[training.photographs] != meta["photographs"]:
        yield "photographs"
    if options.get("--encoding", "invariant") != meta["encoding"]:
        yield "encoding"
    if options.get("--model") != meta.get("model"):
        yield "model"
    drafts = meta.get("drafts") or {}
    shipped = {tensor_file.read_header(path)[2] for path in ASSETS.glob(weights.SHIPPED["shipped"])}
    if ("--drafts" in options) != bool(drafts) or not set(drafts.values()) <= shipped:
        yield "drafts"
    limits = [int(limit) for limit in options["--keypoints"].split(",")] if "--keypoints" in options else None
    if limits != meta.get("keypoints"):
        yield "keypoints"


@pytest.mark.parametrize("training", ALL, ids=lambda training: training.file)
def test_a_shipped_network_is_that_of_its_training(training: Training) -> None:
    assert list(list_differences(training)) == []


def test_differences_are_found() -> None:
    first = next(training for training in ALL if training.file == "inversion-none")
    wrong = {"defenses": ("affine",), "widths": "8,8", "photographs": "012"}
    for field, value in wrong.items():
        assert list(list_differences(dataclasses.replace(first, **{field: value}))) == [field]
    liftings = next(training for training in ALL if training.file == "inversion-liftings")
    equal = dataclasses.replace(liftings, defenses=("affine:lifting=random", "affine:lifting=random"))
    assert list(list_differences(equal)) == ["defenses"]
    more = {
        "--encoding positions": "encoding",
        "--extractor xfeat": "extractor",
        "--model flow": "model",
        "--drafts shipped": "drafts",
        "--keypoints 250,1000": "keypoints",
    }
    for options, difference in more.items():
        assert list(list_differences(dataclasses.replace(first, options=tuple(options.split())))) == [difference]


def test_every_shipped_network_has_a_training() -> None:
    shipped = {path.stem for path in ASSETS.glob("*.safetensors") if tensor_file.read_header(path)[0] == weights.KIND}
    assert shipped == {training.file for training in ALL} | ELSEWHERE


def test_a_network_starts_from_one_that_was_trained_before() -> None:
    trained = {make_assets.FIRST.file}
    for training in ALL:
        assert training.initial is None or training.initial in trained
        assert training.crossfit in (None, make_assets.CROSSFIT[0])
        trained.add(training.file)
