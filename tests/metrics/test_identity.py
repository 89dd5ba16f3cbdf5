"""Identity of faces against dlib's own calls, on pairs with known answers, and on non-matching faces."""

import importlib.util
import urllib.request
from pathlib import Path
from typing import Any

import measure_identity
import numpy as np
import pytest
from measure_identity import list_known_pairs, list_other_pictures, read, replace_face

from bench import testing
from bench.api import Metric
from bench.core.errors import UserError
from bench.identification import face_embedding
from bench.identification.face_embedding import ComparedFaces
from bench.images import photographs
from bench.registry import discovery
from metrics.identity import Identity
from metrics.identity_distance import IdentityDistance

dlib = pytest.importorskip("dlib", reason="dlib is not installed (pip install -e '.[identity]')")

pytestmark = pytest.mark.usefixtures("no_connections")

ASTRONAUT, ADMIRAL = (read(source) for source in measure_identity.list_portraits())


@pytest.fixture(scope="module")
def identity() -> Identity:
    try:
        return Identity()
    except UserError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="module")
def distance() -> IdentityDistance:
    try:
        return IdentityDistance()
    except UserError as error:
        pytest.skip(str(error))


def embed_aligned(models: tuple[Any, Any], image: np.ndarray, box: Any) -> np.ndarray:
    """Return the embedding of a face that dlib cuts out and aligns by a separate call."""
    predictor, network = models
    pixels = np.rint(image * 255).astype(np.uint8)
    chip = dlib.get_face_chip(pixels, predictor(pixels, box), size=150, padding=0.25)
    return np.array(network.compute_face_descriptor(chip))


@pytest.mark.slow
def test_distances_are_those_of_dlib(distance: IdentityDistance) -> None:
    models = dlib.shape_predictor(str(distance.landmarks)), dlib.face_recognition_model_v1(str(distance.network))
    (box,) = dlib.get_frontal_face_detector()(np.rint(ASTRONAUT * 255).astype(np.uint8), 1)
    pairs = list_known_pairs(ASTRONAUT, ADMIRAL)
    for name, estimate in ((name, pairs[name]) for name in ("blur of 2 pixels", "the other portrait", "white noise")):
        expected = np.linalg.norm(embed_aligned(models, ASTRONAUT, box) - embed_aligned(models, estimate, box))
        assert distance(ASTRONAUT, estimate) == pytest.approx(expected, abs=1e-5), name
    turned = dlib.rectangle(box.top(), box.left(), box.bottom(), box.right())  # control: rows and columns exchanged
    assert np.linalg.norm(embed_aligned(models, ASTRONAUT, box) - embed_aligned(models, ASTRONAUT, turned)) > 0.3


@pytest.mark.slow
@pytest.mark.parametrize(("portrait", "other"), [(ASTRONAUT, ADMIRAL), (ADMIRAL, ASTRONAUT)], ids=["astronaut", "admiral"])
def test_pairs_with_known_answers(
    identity: Identity, distance: IdentityDistance, portrait: np.ndarray, other: np.ndarray
) -> None:
    pairs = list_known_pairs(portrait, other)
    identified = {name: identity(portrait, estimate) for name, estimate in pairs.items()}
    same = ["itself", "blur of 1 pixels", "blur of 2 pixels"]
    assert identified == {name: float(name in same) for name in pairs}
    distances = [distance(portrait, pairs[name]) for name in same]
    assert distances[0] == 0
    assert distances == sorted(distances)
    assert distance(portrait, pairs["the other portrait"]) > 0.7


@pytest.mark.slow
def test_a_face_counts_only_at_its_position(identity: Identity) -> None:
    elsewhere = np.roll(ASTRONAUT, 60, axis=1)
    assert identity(elsewhere, elsewhere.copy()) == 1.0  # it is the person's face there,
    assert identity(ASTRONAUT, elsewhere) == 0.0  # but not at the position of the photograph's


@pytest.mark.slow
def test_each_face_counts(identity: Identity, distance: IdentityDistance) -> None:
    beside = np.concatenate([ASTRONAUT, ADMIRAL], axis=1)
    exchanged = np.concatenate([ASTRONAUT, replace_face(ADMIRAL, list_other_pictures()[0][0])], axis=1)
    assert identity(beside, exchanged) == 0.5
    assert identity.describe_truth(beside) == "faces in the photograph: 2"
    compared = identity.compare(beside, exchanged)
    assert compared is not None
    assert compared.detected.tolist() == [True, True]
    assert distance(beside, exchanged) == pytest.approx(compared.distances.mean())


@pytest.mark.parametrize("plugin", [Identity, IdentityDistance])
def test_a_photograph_without_a_face_has_no_value(plugin: type[Metric], identity: Identity) -> None:
    (ground, *_) = photographs.list_ground_textures()
    assert plugin()(read(ground), ASTRONAUT) is None


def test_an_undetected_face_counts_as_not_identified() -> None:
    compared = ComparedFaces(distances=np.array([0.5, 0.5, 0.6]), detected=np.array([True, False, True]))
    assert compared.identified.tolist() == [True, False, False]


@pytest.mark.slow
def test_a_face_that_is_near_but_undetected_is_not_identified(identity: Identity, monkeypatch: pytest.MonkeyPatch) -> None:
    assert identity(ASTRONAUT, ASTRONAUT.copy()) == 1.0
    nothing = np.zeros((0, 4))
    truth = face_embedding.detect_faces(ASTRONAUT.astype(np.float64))
    dimmed = ASTRONAUT * np.float32(0.9)
    monkeypatch.setattr(
        face_embedding, "detect_faces", lambda image: truth if np.array_equal(image, ASTRONAUT.astype(np.float64)) else nothing
    )
    assert identity(ASTRONAUT, dimmed) == 1.0  # by the cascade
    monkeypatch.setattr(face_embedding.faces, "detect_faces", lambda image: nothing)
    assert identity(ASTRONAUT, dimmed) == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("count", [6, pytest.param(100, marks=pytest.mark.exhaustive)])
def test_few_other_faces_are_accepted(identity: Identity, count: int) -> None:
    """Of 100 faces in place of the astronaut's, at most 3: the rate on 200 pairs is 1%."""
    estimates = [replace_face(ASTRONAUT, face) for face in list_other_pictures()[0][:count]]
    compared = [face for estimate in estimates if (face := identity.compare(ASTRONAUT, estimate))]
    assert sum(bool(face.detected[0]) for face in compared) > 0.8 * count  # so the distance decides, and not the detection
    assert sum(bool(face.identified[0]) for face in compared) <= 3


@pytest.mark.slow
@pytest.mark.parametrize("plugin", [Identity, IdentityDistance])
def test_contract_of_metrics(plugin: type[Metric], identity: Identity) -> None:
    discovery.check(discovery.METRIC, plugin)
    testing.check_metric(plugin())


@pytest.mark.slow
def test_nothing_is_downloaded(identity: Identity) -> None:
    for cache in (face_embedding._detect_faces, face_embedding._embed_faces, face_embedding._load_models):
        cache.cache_clear()
    assert identity(ASTRONAUT, ASTRONAUT.copy()) == 1.0
    with pytest.raises(AssertionError, match="a connection"):  # negative control
        urllib.request.urlopen("http://127.0.0.1:9/shape_predictor_5_face_landmarks.dat")


def test_other_files_are_refused(identity: Identity, tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.dat"
    wrong.write_bytes(b"nothing of the kind")
    with pytest.raises(UserError, match=r"wrong\.dat.*: not models of dlib"):
        Identity(network=wrong)(ASTRONAUT, ASTRONAUT)
    with pytest.raises(UserError, match="absent: no such file"):
        Identity(landmarks=tmp_path / "absent")


@pytest.mark.parametrize("plugin", [Identity, IdentityDistance])
def test_without_dlib_the_error_names_the_extra(plugin: type[Metric], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(UserError, match=rf"{plugin.name()}: .* pip install 'feature-privacy-bench\[identity\]'"):
        plugin()
