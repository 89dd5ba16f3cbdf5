"""Structure from motion by COLMAP: verified pairs go through `pycolmap.Database` to its mapping, incremental or global.

Incremental mapping (Schönberger and Frahm, CVPR 2016) begins with the points of two images and adds an image that sees enough
of them; of a private release another image shows few. Global mapping (Pan et al., ECCV 2024) takes the poses from the geometry
of all pairs at once. Intrinsics are known, shared and fixed. One thread and a seed, so that the same matches make the same model.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap

from bench.core.colmap_log import quietly
from bench.sfm.consistency import Doubles
from bench.sfm.verification import Geometry, Pair
from bench.types import Floats

Mapper = Literal["incremental", "global"]

MATCHES = 15  # with points that an image of a model has; COLMAP asks for 30 to add one, and a private release has fewer
SMALLEST = 3  # images of a model


@dataclass(frozen=True, kw_only=True, eq=False)
class Model:
    """The largest model that was made."""

    images: tuple[int, ...]  # registered ones, ascending
    poses: tuple[pycolmap.Rigid3d, ...]  # cam_from_world of each
    points: Doubles  # (P, 3)
    observations: int
    reprojection_error: float  # pixels, the mean over points of their mean

    @property
    def track_length(self) -> float | None:
        """Observations of a point, on average."""
        return self.observations / len(self.points) if len(self.points) else None

    @property
    def centres(self) -> Doubles:
        """(V, 3) of the cameras"""
        return np.array([pose.inverse().translation for pose in self.poses]).reshape(-1, 3)


def mapped(
    camera: pycolmap.Camera, keypoints: Sequence[Floats], geometries: Mapping[Pair, Geometry], mapper: Mapper, seed: int
) -> Model | None:
    """The model with most images, and of those with most points; None if there is none of `SMALLEST` images.

    Global mapping places whatever a chain of pairs leads to. An image that sees fewer than `MATCHES` points is left out.

    Parameters
    ----------
    camera : of all images
    keypoints : (N, 2) of each image
    """
    with tempfile.TemporaryDirectory() as scratch, quietly():
        database = Path(scratch) / "database.db"
        _write(database, camera, keypoints, geometries)
        if mapper == "incremental":
            models = pycolmap.incremental_mapping(database, scratch, scratch, _incremental(seed))
        else:
            models = pycolmap.global_mapping(database, scratch, scratch, _global(seed))
    found = [_summary(model) for model in models.values()]
    best = max(found, key=lambda model: (len(model.images), len(model.points)), default=None)
    return None if best is None or len(best.images) < SMALLEST else best


def _incremental(seed: int) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=seed,
        num_threads=1,
        min_model_size=SMALLEST,
        extract_colors=False,
        ba_refine_focal_length=False,
        ba_refine_principal_point=False,
        ba_refine_extra_params=False,
    )
    options.mapper.num_threads = 1
    options.mapper.abs_pose_min_num_inliers = MATCHES
    options.mapper.abs_pose_refine_focal_length = False
    options.mapper.abs_pose_refine_extra_params = False
    return options


def _global(seed: int) -> pycolmap.GlobalPipelineOptions:
    options = pycolmap.GlobalPipelineOptions(random_seed=seed, num_threads=1, min_model_size=SMALLEST)
    adjustment = options.mapper.bundle_adjustment
    adjustment.refine_focal_length = adjustment.refine_principal_point = adjustment.refine_extra_params = False
    adjustment.ceres.use_gpu = options.mapper.global_positioning.use_gpu = False  # sums in another order each time
    return options


def _write(database: Path, camera: pycolmap.Camera, keypoints: Sequence[Floats], geometries: Mapping[Pair, Geometry]) -> None:
    """Numbers count from 1."""
    model = pycolmap.Reconstruction()
    known = pycolmap.Camera(camera.todict() | {"camera_id": 1, "has_prior_focal_length": True})
    model.add_camera_with_trivial_rig(known)
    with pycolmap.Database.open(database) as opened:
        opened.write_camera(known, use_camera_id=True)
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


def _summary(model: pycolmap.Reconstruction) -> Model:
    model.update_point_3d_errors()
    numbers = [number for number in sorted(model.reg_image_ids()) if model.image(number).num_points3D >= MATCHES]
    return Model(
        images=tuple(number - 1 for number in numbers),
        poses=tuple(pycolmap.Rigid3d(model.image(number).cam_from_world().matrix()) for number in numbers),  # copies
        points=np.array([model.points3D[point].xyz for point in sorted(model.points3D)]).reshape(-1, 3),
        observations=model.compute_num_observations(),
        reprojection_error=float(model.compute_mean_reprojection_error()),
    )
