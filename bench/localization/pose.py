"""The pose of a query whose intrinsics are fixed, from matches of its keypoints with points: P3P in LO-RANSAC, then refined.

PoseLib (Larsson, 2020) makes as many trials as COLMAP in less than half the time, finds as many poses, and says how many trials
it made. COLMAP caps its trials by `min_inlier_ratio`, in silence, and does not say how many it made: here the ratio is so small
that the cap is not reached, and all trials that are allowed are made.
"""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
import pycolmap
from numpy.typing import NDArray

from bench.core.errors import unknown_name

Doubles = NDArray[np.float64]
Solver = Literal["poselib", "pycolmap"]

MAX_ERROR = 12.0  # pixels of reprojection; COLMAP's and hloc's
CONFIDENCE = 0.9999  # RANSAC stops when it has missed the best pose with a chance of less than one minus this
MULTIPLIER = 3.0  # COLMAP's and PoseLib's, of the trials that this asks for
AT_LEAST = 1000  # trials, if so many are allowed
LEAST = 4  # matches; P3P takes 3, and the fourth tells its solutions apart
NO_CAP = 1e-9  # min_inlier_ratio
# Models of cameras that PoseLib shares with COLMAP. Those it does not know it takes without a word, and gives nonsense.
SHARED = {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV", "OPENCV_FISHEYE"}

ROUNDS = 3  # of fitting a focal length and choosing inliers anew
MISFIT = 0.05  # of the focal length, that is reported
EVIDENCE = 100.0  # F, of one parameter more: ten standard errors; a wall that faces the camera reached 51 in the gallery


@dataclass(frozen=True, kw_only=True, eq=False)
class Estimate:
    """What RANSAC found of C matches."""

    cam_from_world: pycolmap.Rigid3d
    inliers: NDArray[np.bool_]  # (C,)
    trials: int  # that were made


def estimate(
    xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, *, trials: int, seed: int, solver: Solver = "poselib"
) -> Estimate | None:
    """The pose that most matches agree with, refined on them; None if there are fewer than `LEAST` matches, or none was found.

    Parameters
    ----------
    xy, xyz : (C, 2) pixels and (C, 3) in the map's unit of length
    trials : at most
    solver : PoseLib's, unless it does not know the model of the camera; or COLMAP's

    Raises
    ------
    UserError
        if there is no such solver.
    """
    if solver not in get_args(Solver):
        raise unknown_name("solver", solver, get_args(Solver))
    if len(xy) < LEAST:
        return None
    solve = _poselib if solver == "poselib" and camera.model.name in SHARED else _pycolmap
    return solve(xy, xyz, camera, trials, seed)


def errors(found: pycolmap.Rigid3d, truth: pycolmap.Rigid3d) -> tuple[float, float]:
    """How far the camera's centre is off, in the map's unit of length, and by how much it is turned, in degrees."""
    apart = found.inverse().translation - truth.inverse().translation
    return float(np.linalg.norm(apart)), float(np.degrees(found.rotation.angle_to(truth.rotation)))


def reprojection(pose: pycolmap.Rigid3d, camera: pycolmap.Camera, xy: Doubles, xyz: Doubles) -> Doubles:
    """How far each point is from its keypoint, in pixels; infinite behind the camera. -> (C,)"""
    seen = pose * xyz  # (C, 3)
    before = seen[:, 2] > 0
    apart = np.full(len(xy), np.inf)
    apart[before] = np.linalg.norm(np.asarray(camera.img_from_cam(seen[before])) - xy[before], axis=1)
    apart[np.isnan(apart)] = np.inf  # what a lens does not map
    return apart


def misfit(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, found: Estimate) -> float | None:
    """The focal length that the inliers ask for, relative to the camera's, if they leave no doubt that it is another.

    It is set free on the inliers, which are then chosen anew, `ROUNDS` times. There is no doubt if it is off by more than
    `MISFIT` and its F, the sum of squares that it saves over what is left a degree of freedom, is above `EVIDENCE`. Few matches,
    and matches on a plane that faces the camera, tell nothing.
    """
    free, pose, inliers = deepcopy(camera), found.cam_from_world, found.inliers
    options = pycolmap.AbsolutePoseRefinementOptions(refine_focal_length=True)
    for _ in range(ROUNDS):
        if inliers.sum() < 2 * LEAST:
            return None
        refined = pycolmap.refine_absolute_pose(pose, xy, xyz, inliers, free, options)
        if refined is None:
            return None
        pose = refined["cam_from_world"]
        inliers = reprojection(pose, free, xy, xyz) < MAX_ERROR
    before, after = (
        (np.minimum(reprojection(each, lens, xy[inliers], xyz[inliers]), MAX_ERROR) ** 2).sum()
        for each, lens in ((found.cam_from_world, camera), (pose, free))
    )
    ratio = free.mean_focal_length() / camera.mean_focal_length()
    evidence = (before - after) * (2 * inliers.sum() - 7) / max(after, np.finfo(float).tiny)
    return ratio if abs(ratio - 1) > MISFIT and evidence > EVIDENCE else None


def _poselib(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, trials: int, seed: int) -> Estimate | None:
    import poselib

    lens = {"model": camera.model.name, "width": camera.width, "height": camera.height, "params": camera.params.tolist()}
    options = {
        "max_reproj_error": MAX_ERROR,
        "max_iterations": trials,
        "min_iterations": min(AT_LEAST, trials),
        "success_prob": CONFIDENCE,
        "dyn_num_trials_mult": MULTIPLIER,
        "seed": seed,
    }
    pose, told = poselib.estimate_absolute_pose(xy, xyz, lens, options, {})
    inliers = np.array(told["inliers"], dtype=bool)
    if inliers.sum() < LEAST:
        return None
    found = pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(pose.q, -1)), pose.t)
    return Estimate(cam_from_world=found, inliers=inliers, trials=int(told["iterations"]))


def _pycolmap(xy: Doubles, xyz: Doubles, camera: pycolmap.Camera, trials: int, seed: int) -> Estimate | None:
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac = pycolmap.RANSACOptions(
        max_error=MAX_ERROR,
        min_inlier_ratio=NO_CAP,
        min_num_trials=trials,
        max_num_trials=trials,
        random_seed=seed,
        num_threads=1,
    )
    told = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera, options)
    if told is None or told["num_inliers"] < LEAST:
        return None
    return Estimate(cam_from_world=told["cam_from_world"], inliers=np.array(told["inlier_mask"], dtype=bool), trials=trials)
