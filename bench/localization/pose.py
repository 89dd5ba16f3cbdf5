"""Pose estimation with fixed intrinsics, from matches of keypoints with points: P3P in LO-RANSAC, then refinement.

PoseLib (Larsson, 2020) runs as many trials as COLMAP in less than half the time, finds as many poses, and reports its number of
trials. COLMAP limits its trials by `min_inlier_ratio` without a message, and does not report their number. Here the ratio is so
small that this limit is never reached, and COLMAP runs all allowed trials.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from bench.core.errors import unknown_name

if TYPE_CHECKING:
    import pycolmap

Doubles = NDArray[np.float64]
Solver = Literal["poselib", "pycolmap"]

MAX_ERROR = 12.0  # pixels of reprojection; COLMAP's and hloc's
CONFIDENCE = 0.9999  # RANSAC stops when the chance that it missed the best pose is below one minus this
MULTIPLIER = 3.0  # COLMAP's and PoseLib's, of the trials that `CONFIDENCE` needs
MIN_TRIALS = 1000  # unless fewer are allowed
MIN_MATCHES = 4  # P3P uses 3, and the fourth selects among its solutions
NO_CAP = 1e-9  # min_inlier_ratio
# Camera models that PoseLib shares with COLMAP. It accepts unknown models without an error, and returns wrong poses.
POSELIB_MODELS = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"}

ROUNDS = 3  # of the fit of a focal length and a new selection of inliers
MIN_FOCAL_MISMATCH = 0.05  # fraction of the focal length
MIN_F_STATISTIC = 100.0  # of one more parameter: ten standard errors; a wall that faces the camera reached 51 in the gallery


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """The result of RANSAC on C matches."""

    cam_from_world: pycolmap.Rigid3d
    inliers: NDArray[np.bool_]  # (C,)
    trials: int  # that RANSAC ran


def estimate(
    xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, *, trials: int, seed: int, solver: Solver = "poselib"
) -> Estimate | None:
    """Return the pose with most inliers, refined on them; None below `MIN_MATCHES` matches, or if RANSAC finds no pose.

    Parameters
    ----------
    xy, xyz : (C, 2) pixels and (C, 3) in the map's unit of length
    trials : largest number of trials
    solver : for a camera model that PoseLib does not support, COLMAP's solver is used in any case

    Raises
    ------
    UserError
        if the solver is unknown.
    """
    if solver not in get_args(Solver):
        raise unknown_name("solver", solver, get_args(Solver))
    if len(xy) < MIN_MATCHES:
        return None
    solve = _estimate_with_poselib if solver == "poselib" and camera.model.name in POSELIB_MODELS else _estimate_with_pycolmap
    return solve(xy, xyz, camera, trials, seed)


def compute_errors(estimated: pycolmap.Rigid3d, truth: pycolmap.Rigid3d) -> tuple[float, float]:
    """Return the error of the camera's centre, in the map's unit of length, and of its rotation, in degrees."""
    offset = estimated.inverse().translation - truth.inverse().translation
    return float(np.linalg.norm(offset)), float(np.degrees(estimated.rotation.angle_to(truth.rotation)))


def compute_reprojection_errors(pose: pycolmap.Rigid3d, camera: pycolmap.Camera, xy: Doubles, xyz: Doubles) -> Doubles:
    """Return the distance from each projected point to its keypoint, in pixels; infinite behind the camera. -> (C,)"""
    in_camera = pose * xyz  # (C, 3)
    before = in_camera[:, 2] > 0
    errors = np.full(len(xy), np.inf)
    errors[before] = np.linalg.norm(np.asarray(camera.img_from_cam(in_camera[before])) - xy[before], axis=1)
    errors[np.isnan(errors)] = np.inf  # points outside the lens model's range
    return errors


def estimate_focal_mismatch(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, estimated: Estimate) -> float | None:
    """Return the focal length estimated from the inliers, relative to the camera's; None unless the two clearly differ.

    The focal length is refined on the inliers, which are then selected again, `ROUNDS` times. It clearly differs if the relative
    difference exceeds `MIN_FOCAL_MISMATCH` and the F statistic exceeds `MIN_F_STATISTIC`. The F statistic is the decrease of the
    sum of squares, divided by the remaining sum per degree of freedom. Few matches give None, as do matches on a plane that faces
    the camera.
    """
    import pycolmap

    free, pose, inliers = deepcopy(camera), estimated.cam_from_world, estimated.inliers
    options = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=True)
    for _ in range(ROUNDS):
        if inliers.sum() < 2 * MIN_MATCHES:
            return None
        refined = pycolmap.refine_absolute_pose(pose, xy, xyz, inliers, free, options)
        if refined is None:
            return None
        pose = refined["cam_from_world"]
        inliers = compute_reprojection_errors(pose, free, xy, xyz) < MAX_ERROR
    before, after = (
        (np.minimum(compute_reprojection_errors(each, lens, xy[inliers], xyz[inliers]), MAX_ERROR) ** 2).sum()
        for each, lens in ((estimated.cam_from_world, camera), (pose, free))
    )
    ratio = free.mean_focal_length() / camera.mean_focal_length()
    f_statistic = (before - after) * (2 * inliers.sum() - 7) / max(after, np.finfo(float).tiny)
    return ratio if abs(ratio - 1) > MIN_FOCAL_MISMATCH and f_statistic > MIN_F_STATISTIC else None


def _estimate_with_poselib(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, trials: int, seed: int) -> Estimate | None:
    import poselib
    import pycolmap

    lens = {"model": camera.model.name, "width": camera.width, "height": camera.height, "params": camera.params.tolist()}
    options = {
        "max_reproj_error": MAX_ERROR,
        "max_iterations": trials,
        "min_iterations": min(MIN_TRIALS, trials),
        "success_prob": CONFIDENCE,
        "dyn_num_trials_mult": MULTIPLIER,
        "seed": seed,
    }
    pose, report = poselib.estimate_absolute_pose(xy, xyz, lens, options, {})
    inliers = np.array(report["inliers"], dtype=bool)
    if inliers.sum() < MIN_MATCHES:
        return None
    cam_from_world = pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(pose.q, -1)), pose.t)
    return Estimate(cam_from_world=cam_from_world, inliers=inliers, trials=int(report["iterations"]))


def _estimate_with_pycolmap(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, trials: int, seed: int) -> Estimate | None:
    import pycolmap

    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = pycolmap.RANSACOptions(
        max_error=MAX_ERROR,
        min_inlier_ratio=NO_CAP,
        min_num_trials=trials,
        max_num_trials=trials,
        random_seed=seed,
        num_threads=1,
    )
    report = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera, options)
    if report is None or report["num_inliers"] < MIN_MATCHES:
        return None
    return Estimate(cam_from_world=report["cam_from_world"], inliers=np.array(report["inlier_mask"], dtype=bool), trials=trials)
