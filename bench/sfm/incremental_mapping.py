"""Structure from motion by COLMAP, incremental or global, from verified pairs of images.

Incremental mapping (Schönberger and Frahm, CVPR 2016) starts with the points of two images and adds images that show enough of
them. In private releases, few points occur in a third image. Global mapping (Pan et al., ECCV 2024) estimates all poses together
from the geometry of all pairs. COLMAP reads the pairs from a `pycolmap.Database`. Intrinsics are known, common to all images and
fixed. With one thread and a seed, the same matches give the same model.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

from bench.core.colmap_log import silence_colmap
from bench.sfm.consistency import Doubles
from bench.sfm.verification import Geometry, Pair
from bench.types import Floats

if TYPE_CHECKING:
    import pycolmap

Mapper = Literal["incremental", "global"]

MIN_POINTS = 15  # in each image of a model; COLMAP adds an image from 30 by default, which private releases do not reach
MIN_IMAGES = 3  # of a model


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """A model with its registered images."""

    images: tuple[int, ...]  # the registered images, ascending
    poses: tuple[pycolmap.Rigid3d, ...]  # cam_from_world of each
    points: Doubles  # (P, 3)
    observations: int
    reprojection_error: float  # pixels, the mean over points of their mean

    @property
    def track_length(self) -> float | None:
        """Observations per point, on average."""
        return self.observations / len(self.points) if len(self.points) else None

    @property
    def centres(self) -> Doubles:
        """(V, 3) of the cameras"""
        return np.array([pose.inverse().translation for pose in self.poses]).reshape(-1, 3)


def build_model(
    camera: pycolmap.Camera, keypoints: Sequence[Floats], geometries: Mapping[Pair, Geometry], mapper: Mapper, seed: int
) -> Model | None:
    """Return the model with most images, and among equals with most points; None if no model has `MIN_IMAGES` images.

    Global mapping registers every image that a chain of pairs reaches. Images with fewer than `MIN_POINTS` points are dropped.

    Parameters
    ----------
    camera : of all images
    keypoints : (N, 2) of each image
    """
    import pycolmap

    with tempfile.TemporaryDirectory() as scratch, silence_colmap():
        database = Path(scratch) / "database.db"
        _write_database(database, camera, keypoints, geometries)
        if mapper == "incremental":
            models = pycolmap.incremental_mapping(database, scratch, scratch, _incremental_options(seed))
        else:
            models = pycolmap.global_mapping(database, scratch, scratch, _global_options(seed))
    candidates = [_summarize(model) for model in models.values()]
    best = max(candidates, key=lambda model: (len(model.images), len(model.points)), default=None)
    return None if best is None or len(best.images) < MIN_IMAGES else best


def _incremental_options(seed: int) -> pycolmap.IncrementalPipelineOptions:
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(
        random_seed=seed,
        num_threads=1,
        min_model_size=MIN_IMAGES,
        extract_colors=False,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    options.mapper.num_threads = 1
    options.mapper.abs_pose_min_num_inliers = MIN_POINTS
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _global_options(seed: int) -> pycolmap.GlobalPipelineOptions:
    import pycolmap

    options = pycolmap.GlobalPipelineOptions(random_seed=seed, num_threads=1, min_model_size=MIN_IMAGES)
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = options.mapper.global_positioning.use_gpu = False  # its order of summation varies
    return options


def _write_database(
    database: Path, camera: pycolmap.Camera, keypoints: Sequence[Floats], geometries: Mapping[Pair, Geometry]
) -> None:
    """Write a database with all inputs of the mapping. Numbers count from 1."""
    import pycolmap

    model = pycolmap.Reconstruction()
    calibrated = pycolmap.Camera(camera.todict() | {"camera_id": 1, "has_prior_focal_length": True})
    model.add_camera_with_trivial_rig(calibrated)
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(calibrated, use_camera_id=True)
        opened.write_rig(model.rig(1), use_rig_id=True)
        for number, each in enumerate(keypoints, 1):
            image = pycolmap.Image(f"{number:06}", each.astype(np.float64), camera_id=1, image_id=number)
            model.add_image_with_trivial_frame(image)
            opened.write_frame(model.frame(number), use_frame_id=True)
            opened.write_image(model.image(number), use_image_id=True)
            opened.write_keypoints(number, each)
        for (a, b), geometry in geometries.items():
            pair = pycolmap.TwoViewGeometry()
            pair.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            pair.E = geometry.essential
            pair.cam2_from_cam1 = geometry.second_from_first
            pair.inlier_matches = geometry.matches.astype(np.uint32)
            opened.write_matches(a + 1, b + 1, pair.inlier_matches)
            opened.write_two_view_geometry(a + 1, b + 1, pair)


def _summarize(model: pycolmap.Reconstruction) -> Model:
    import pycolmap

    model.update_point_3d_errors()
    numbers = [number for number in sorted(model.reg_image_ids()) if model.image(number).num_points3D >= MIN_POINTS]
    return Model(
        images=tuple(number - 1 for number in numbers),
        poses=tuple(pycolmap.Rigid3d(model.image(number).cam_from_world().matrix()) for number in numbers),  # copies
        points=np.array([model.points3D[point].xyz for point in sorted(model.points3D)]).reshape(-1, 3),
        observations=model.compute_num_observations(),
        reprojection_error=float(model.compute_mean_reprojection_error()),
    )
