"""Construction of the map of a scene: matches among neighbouring references, and points triangulated from their known poses.

A match counts if it agrees with the poses: COLMAP's Sampson error is at most `EPIPOLAR` pixels. COLMAP reads these matches from a
`pycolmap.Database` and triangulates them. It uses one thread and a fixed seed, so that the same images give the same map.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from bench.core.colmap_log import silence_colmap
from bench.core.device import pick_device
from bench.core.errors import UserError
from bench.core.progress import Progress
from bench.geometry.distances import find_mutual_nearest, points_to_points
from bench.images.scene import Reference
from bench.localization import covisibility
from bench.localization.maps import Map
from bench.types import Features, Indices

if TYPE_CHECKING:
    import pycolmap

EPIPOLAR = 4.0  # pixels

Matches = dict[tuple[int, int], Indices]  # references a < b -> (M, 2) keypoints of a, of b


def build_map(references: Sequence[Reference], features: Sequence[Features], ratio: float) -> Map:
    """Return the map of references, built from their features. `ratio` is that of Lowe's test of matches.

    Raises
    ------
    UserError
        if no point could be triangulated.
    """
    matches = verify_matches(references, features, _match_pairs(features, covisibility.select_pairs(references), ratio))
    points, xyz = triangulate(references, features, matches)
    if len(xyz) == 0:
        raise UserError("the map has no point: do the references overlap?")
    codes = [each.codes for each in features if each.codes is not None]
    return Map(
        names=tuple(reference.name for reference in references),
        starts=np.concatenate([[0], np.cumsum([len(each) for each in features])]).astype(np.int64),
        keypoints=np.concatenate([each.keypoints for each in features]),
        descriptors=np.concatenate([each.descriptors for each in features]),
        codes=np.concatenate(codes) if len(codes) == len(features) else None,
        points=points,
        xyz=xyz,
    )


def verify_matches(
    references: Sequence[Reference], features: Sequence[Features], matches: Iterable[tuple[tuple[int, int], Indices]]
) -> Matches:
    """Return the matches that agree with the known poses."""
    import pycolmap

    rays = [_compute_rays(reference, each) for reference, each in zip(references, features, strict=True)]
    inliers = {}
    for (a, b), rows in matches:
        essential = pycolmap.essential_matrix_from_pose(references[b].cam_from_world * references[a].cam_from_world.inverse())
        errors = np.asarray(pycolmap.compute_squared_sampson_error(rays[a][rows[:, 0]], rays[b][rows[:, 1]], essential))
        focal = (references[a].camera.mean_focal_length() + references[b].camera.mean_focal_length()) / 2
        inliers[a, b] = rows[errors * focal**2 <= EPIPOLAR**2]
    return inliers


def triangulate(references: Sequence[Reference], features: Sequence[Features], matches: Matches) -> tuple[Indices, np.ndarray]:
    """Return the points that COLMAP triangulates. -> (T,) point of each keypoint of all references, or -1; (P, 3)"""
    import pycolmap

    with tempfile.TemporaryDirectory() as scratch, silence_colmap():
        database = Path(scratch) / "database.db"
        model = _write_database(database, references, features, matches)
        options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0, extract_colors=False)
        options.mapper.num_threads = 1
        model = pycolmap.triangulate_points(model, database, scratch, scratch, options=options)
    ids = sorted(model.points3D)
    rows = {point: row for row, point in enumerate(ids)}
    points = [
        [rows[point.point3D_id] if point.has_point3D() else -1 for point in model.images[number].points2D]
        for number in range(1, len(references) + 1)
    ]
    return np.concatenate(points).astype(np.int64), np.array([model.points3D[point].xyz for point in ids]).reshape(-1, 3)


def _match_pairs(
    features: Sequence[Features], pairs: Sequence[tuple[int, int]], ratio: float
) -> Iterable[tuple[tuple[int, int], Indices]]:
    """Yield the mutually nearest descriptors of each pair of references."""
    import torch

    device = pick_device()
    rows = [torch.from_numpy(each.descriptors).to(device) for each in features]
    with Progress("map: matches", len(pairs)) as progress:
        for a, b in pairs:
            yield (a, b), np.stack(find_mutual_nearest(points_to_points(rows[a], rows[b]), ratio), axis=1)
            progress.advance()


def _write_database(
    database: Path, references: Sequence[Reference], features: Sequence[Features], matches: Matches
) -> pycolmap.Reconstruction:
    """Write the database for COLMAP's triangulation, and return a model with poses and no points. Numbers count from 1."""
    import pycolmap

    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(database) as opened:
        for number, (reference, each) in enumerate(zip(references, features, strict=True), 1):
            camera = pycolmap.Camera(reference.camera.todict() | {"camera_id": number})
            model.add_camera_with_trivial_rig(camera)
            image = pycolmap.Image(reference.name, each.keypoints.astype(np.float64), camera_id=number, image_id=number)
            model.add_image_with_trivial_frame(image, reference.cam_from_world)
            opened.write_camera(camera, use_camera_id=True)
            opened.write_rig(model.rig(number), use_rig_id=True)
            opened.write_frame(model.frame(number), use_frame_id=True)
            opened.write_image(model.image(number), use_image_id=True)
            opened.write_keypoints(number, each.keypoints)
        for (a, b), rows in matches.items():
            pair = pycolmap.TwoViewGeometry()
            pair.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            pair.inlier_matches = rows.astype(np.uint32)
            opened.write_two_view_geometry(a + 1, b + 1, pair)
    return model


def _compute_rays(reference: Reference, features: Features) -> np.ndarray:
    """Return the keypoints projected to the plane at depth one. -> (N, 2) float64"""
    return np.asarray(reference.camera.cam_from_img(features.keypoints.astype(np.float64)))
