"""A scene that is exported for hloc is triangulated and localized: by pycolmap as in hloc, by hloc, and by the benchmark.

hloc (Sarlin et al., CVPR 2019) is not on PyPI. Where it is not installed, its steps are taken by pycolmap: the files in its
layout are read, mutual nearest neighbours matched, points triangulated from the poses of the model, and queries localized.
"""

import importlib.util
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import h5py
import numpy as np
import pycolmap
import pytest
from gallery_stretch import list_queries, list_references
from scipy.stats import fisher_exact

from bench import cli
from bench.datasets.colmap import Colmap
from bench.datasets.gallery import Gallery
from bench.extractors.colmap_database import ColmapDatabase
from bench.extractors.sift import Sift
from bench.formats import lists, pairs, scene_export
from bench.images.scene import Scene
from bench.localization.pose import compute_errors
from bench.runner import execute
from bench.tasks.localization import Localization
from defenses.none import Undefended

RATIO = 0.8  # hloc's matcher NN-ratio
EPIPOLAR = 4.0  # pixels; hloc's `geometric_verification`
MAX_ERROR = 12.0  # pixels; hloc's `localize_sfm`
NEIGHBOURS, ROTATION = 20, 30.0  # references and degrees; hloc's `pairs_from_poses`
CHANCE = 0.05  # level of Fisher's exact test that two recalls differ
STRICT = np.array([0.25, 2.0])  # metres, degrees
INSTALL = "pip install git+https://github.com/cvg/Hierarchical-Localization"

Poses = dict[str, pycolmap.Rigid3d]


@dataclass(frozen=True, kw_only=True)
class Export:
    """The files of an exported scene, and the recall of the benchmark on it."""

    scene: Path  # as `bench dataset --layout colmap` writes it
    features: Path
    model: Path
    pairs: Path  # query and retrieved references
    localized: dict[str, bool]  # query -> whether the benchmark localized it


def export_scene(scene: Scene, folder: Path, keypoints: int) -> Export:
    scene_export.write(scene, "colmap", folder / "scene")
    features, model = folder / "features.h5", folder / "model"
    arguments = ["--dataset", f"colmap:path={folder / 'scene'}", "--extractor", f"sift:max_keypoints={keypoints}"]
    assert cli.main(["export", *arguments, "--layout", "hloc", "--out", str(features), "--model", str(model)]) == 0
    task, dataset, extractor = Localization(), Colmap(path=folder / "scene"), Sift(max_keypoints=keypoints)
    records = execute.run([Undefended()], task=task, dataset=dataset, extractor=extractor)
    pairs.write(folder / "pairs.txt", {record["sample"]: record["estimates"]["retrieved"] for record in records})
    localized = {record["sample"]: record["metrics"]["recall_0.25m_2deg"] == 1 for record in records}
    return Export(scene=folder / "scene", features=features, model=model, pairs=folder / "pairs.txt", localized=localized)


@pytest.fixture(scope="module")
def stretch(tmp_path_factory: pytest.TempPathFactory) -> Export:
    """Fifteen references and five queries between them."""
    scene = Scene(name="stretch", references=list_references(), queries=list_queries())
    return export_scene(scene, tmp_path_factory.mktemp("stretch"), 400)


@pytest.fixture(scope="module")
def gallery(tmp_path_factory: pytest.TempPathFactory) -> Export:
    return export_scene(Gallery(views=120, queries=40).scene(), tmp_path_factory.mktemp("gallery"), 1000)


# ---- hloc's steps by pycolmap, from the files alone


def read_features(path: Path, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return keypoints in COLMAP's convention, (N, 2), and descriptors, (N, D)."""
    with h5py.File(path) as opened:
        group = opened[name]
        assert set(group) == {"keypoints", "descriptors", "scores", "image_size"}
        assert group["scores"].shape == (len(group["keypoints"]),)
        return group["keypoints"][()] + 0.5, group["descriptors"][()].T


def match(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return mutual nearest neighbours that pass the ratio test in both directions. (N, D), (M, D) -> (P, 2)"""
    distances = 2 - 2 * one @ other.T  # squared

    def find(rows: np.ndarray) -> np.ndarray:
        nearest = np.argpartition(rows, (0, 1), axis=1)[:, :2]
        first, second = np.take_along_axis(rows, nearest, axis=1).T
        return np.where(first <= RATIO**2 * second, nearest[:, 0], -1)

    there, back = find(distances), find(distances.T)
    rows = np.flatnonzero(there >= 0)
    rows = rows[back[there[rows]] == rows]
    return np.stack([rows, there[rows]], axis=1)


def select_pairs(model: pycolmap.Reconstruction) -> set[tuple[int, int]]:
    """Return pairs of images: to each, the nearest of those whose rotation differs by less than `ROTATION` degrees."""
    poses = {number: image.cam_from_world() for number, image in model.images.items()}
    chosen = set()
    for a, pose in poses.items():
        near = {b: compute_errors(pose, other) for b, other in poses.items() if b != a}
        similar = [b for b, (_, angle) in near.items() if angle < ROTATION]
        chosen |= {(min(a, b), max(a, b)) for b in sorted(similar, key=lambda b: near[b][0])[:NEIGHBOURS]}
    return chosen


def triangulate(export: Export, out: Path, shift: float = 0.0) -> pycolmap.Reconstruction:
    """Triangulate the exported features with the exported poses. `shift` displaces the principal points, in pixels."""
    model = pycolmap.Reconstruction(export.model)
    for camera in model.cameras.values():
        camera.principal_point_x += shift
    features = {number: read_features(export.features, image.name) for number, image in model.images.items()}
    out.mkdir()
    with pycolmap.Database.open(out / "database.db") as database:
        for number, camera in model.cameras.items():
            database.write_camera(camera, use_camera_id=True)
            database.write_rig(model.rig(number), use_rig_id=True)
        for number, image in model.images.items():
            database.write_frame(model.frame(image.frame_id), use_frame_id=True)
            database.write_image(image, use_image_id=True)
            database.write_keypoints(number, features[number][0])
        for a, b in sorted(select_pairs(model)):
            found = match(features[a][1], features[b][1])
            rays = [
                np.asarray(model.images[number].camera.cam_from_img(features[number][0][found[:, column]].astype(np.float64)))
                for column, number in enumerate((a, b))
            ]
            b_from_a = model.images[b].cam_from_world() * model.images[a].cam_from_world().inverse()
            errors = pycolmap.compute_squared_sampson_error(*rays, pycolmap.essential_matrix_from_pose(b_from_a))
            inliers = found[np.sqrt(errors) * model.images[a].camera.mean_focal_length() < EPIPOLAR]
            geometry = pycolmap.TwoViewGeometry(inlier_matches=inliers.astype(np.uint32))
            # COLMAP 4 ignores geometries without a configuration, such as those that hloc writes from known poses.
            geometry.config = pycolmap.TwoViewGeometryConfiguration.CALIBRATED
            database.write_two_view_geometry(a, b, geometry)
    options = pycolmap.IncrementalPipelineOptions(num_threads=1, random_seed=0)
    return pycolmap.triangulate_points(model, out / "database.db", export.scene / "images", out, options=options)


def localize(export: Export, model: pycolmap.Reconstruction) -> Poses:
    """Localize the queries in a triangulated model, among the retrieved references."""
    images = {image.name: image for image in model.images.values()}
    retrieved, found = pairs.read(export.pairs), {}
    for name, camera in read_queries(export).items():
        keypoints, descriptors = read_features(export.features, name)
        matched = set()
        for reference in retrieved[name]:
            points = images[reference].points2D
            for row, other in match(descriptors, read_features(export.features, reference)[1]).tolist():
                if points[other].has_point3D():
                    matched.add((row, points[other].point3D_id))
        xy = np.array([keypoints[row] for row, _ in sorted(matched)], dtype=np.float64).reshape(-1, 2)
        xyz = np.array([model.points3D[point].xyz for _, point in sorted(matched)]).reshape(-1, 3)
        options = pycolmap.AbsolutePoseEstimationOptions()
        options.ransac = pycolmap.RANSACOptions(max_error=MAX_ERROR, random_seed=0)
        if (result := pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera, options)) is not None:
            found[name] = result["cam_from_world"]
    return found


def read_queries(export: Export) -> dict[str, pycolmap.Camera]:
    """Return the cameras in the lists of queries."""
    lines = [line.split() for path in (export.scene / "queries").glob("*_with_intrinsics.txt") for line in path.open()]
    return {
        name: pycolmap.Camera(model=kind, width=int(width), height=int(height), params=[float(value) for value in params])
        for name, kind, width, height, *params in lines
    }


def find_localized(export: Export, poses: Poses) -> dict[str, bool]:
    """Return whether the pose of each query is within `STRICT`."""
    truth = {name: pose for name, (_, pose) in lists.read_poses(export.scene / "ground_truth.txt").items()}
    return {name: name in poses and bool(np.all(compute_errors(poses[name], truth[name]) <= STRICT)) for name in truth}


def compare_recalls(one: Iterable[bool], other: Iterable[bool]) -> float:
    """Return the p-value of Fisher's exact test that two fractions are equal."""
    counts = [[sum(each), len(each) - sum(each)] for each in (list(one), list(other))]
    return float(fisher_exact(counts).pvalue)


def is_whole_map(model: pycolmap.Reconstruction, least: int) -> bool:
    """Return whether a model has `least` points that agree with its poses to half a pixel."""
    return model.num_points3D() >= least and model.compute_mean_reprojection_error() < 0.5


# ---- tests


@pytest.mark.slow
def test_the_export_is_triangulated_and_localized_as_by_hloc(stretch: Export, tmp_path: Path) -> None:
    model = triangulate(stretch, tmp_path / "sfm")
    assert is_whole_map(model, 300)
    found = find_localized(stretch, localize(stretch, model))
    assert found == stretch.localized == dict.fromkeys(found, True)
    assert not is_whole_map(triangulate(stretch, tmp_path / "shifted", shift=20), 300)  # the negative control


@pytest.mark.slow
def test_an_exported_database_localizes_as_its_extractor(stretch: Export, tmp_path: Path) -> None:
    """Its keypoints are in pixels of the whole image, as the intrinsics are."""
    database = tmp_path / "database.db"
    arguments = ["--dataset", f"colmap:path={stretch.scene}", "--extractor", "sift:max_keypoints=400", "--layout", "colmap"]
    assert cli.main(["export", *arguments, "--out", str(database)]) == 0
    stored, dataset = ColmapDatabase(path=database), Colmap(path=stretch.scene)
    records = execute.run([Undefended()], task=Localization(), dataset=dataset, extractor=stored)
    assert {record["sample"]: record["metrics"]["recall_0.25m_2deg"] == 1 for record in records} == stretch.localized


@pytest.mark.exhaustive
def test_recall_on_the_gallery_is_that_of_the_benchmark(gallery: Export, tmp_path: Path) -> None:
    model = triangulate(gallery, tmp_path / "sfm")
    found = find_localized(gallery, localize(gallery, model))
    assert compare_recalls(found.values(), gallery.localized.values()) > CHANCE


def test_the_comparison_of_recalls_can_fail() -> None:
    assert compare_recalls([True] * 40, [True] * 34 + [False] * 6) < CHANCE  # 6 of 40 queries
    assert compare_recalls([True] * 40, [True] * 36 + [False] * 4) > CHANCE


@pytest.mark.exhaustive
@pytest.mark.skipif(importlib.util.find_spec("hloc") is None, reason=f"needs hloc, which is not on PyPI: {INSTALL}")
def test_recall_of_hloc_is_that_of_the_benchmark(gallery: Export, tmp_path: Path) -> None:
    from hloc import localize_sfm, match_features, pairs_from_poses, triangulation

    conf = match_features.confs["NN-ratio"]
    near, sfm, results = tmp_path / "pairs-sfm.txt", tmp_path / "sfm", tmp_path / "results.txt"
    mapped, matched = tmp_path / "matches-sfm.h5", tmp_path / "matches-loc.h5"
    pairs_from_poses.main(gallery.model, near, NEIGHBOURS)
    match_features.main(conf, near, features=gallery.features, matches=mapped)
    images = gallery.scene / "images"
    # Otherwise hloc writes geometries without a configuration, which COLMAP 4 ignores.
    options = {"estimate_two_view_geometries": True}
    model = triangulation.main(sfm, gallery.model, images, near, gallery.features, mapped, **options)
    assert model.num_points3D() > 1000
    match_features.main(conf, gallery.pairs, features=gallery.features, matches=matched)
    queries = gallery.scene / "queries" / "*_with_intrinsics.txt"
    localize_sfm.main(sfm, queries, gallery.pairs, gallery.features, matched, results)
    by_file = {name: pose for name, (_, pose) in lists.read_poses(results).items()}  # hloc drops the folders of names
    poses = {name: by_file[name.rpartition("/")[2]] for name in gallery.localized if name.rpartition("/")[2] in by_file}
    found = find_localized(gallery, poses)
    assert compare_recalls(found.values(), gallery.localized.values()) > CHANCE
