"""Pose estimation with fixed intrinsics, from matches of image lines with points: P6L in LO-RANSAC, then refinement.

Source: Speciale et al., "Privacy Preserving Image Queries for Camera Localization", ICCV 2019. A released line passes through its
hidden keypoint, so each match gives one constraint, and a pose needs six. The minimal solver is PoseLib's (Kukelova et al., CVPR
2016), the refinement SciPy's.

A random line is more often near a wrong point than a random keypoint is: many poses have inliers by chance. A pose counts only if
its inliers are too many for chance (Moisan and Stival, IJCV 2004): chance is the rate of inliers among all C² pairs of a line and
a point, under the same pose.
"""

from __future__ import annotations

import ctypes
import math
from typing import TYPE_CHECKING, Any

import numpy as np

from bench.localization.pose import CONFIDENCE, MIN_TRIALS, MULTIPLIER, Doubles, Estimate

if TYPE_CHECKING:
    import pycolmap

MAX_LINE_ERROR = 4.0  # pixels from the projected point to its line
SAMPLE = 6  # matches of the minimal solver
MIN_LINES = SAMPLE + 1  # the seventh selects among the solutions
SOLUTIONS = 8  # of the minimal solver, at most
BATCH = 64  # trials whose solutions are scored together
MAX_FALSE_ALARMS = 1e-3  # expected number of wrong poses with as many inliers, over all trials
PAIRS = 1000  # largest number of lines, and of points, whose pairs estimate the rate of inliers by chance


def estimate(lines: Doubles, xyz: Doubles, camera: pycolmap.Camera, *, trials: int, seed: int) -> Estimate | None:
    """Return the pose with most inliers, refined on them; None below `MIN_LINES` matches, or if chance explains the inliers.

    Parameters
    ----------
    lines : (C, 3) lines {(x, y): a x + b y + c = 0} in pixels, a² + b² = 1
    xyz : (C, 3) in the map's unit of length
    trials : largest number of trials
    """
    if len(lines) < MIN_LINES:
        return None
    # PoseLib's solver turns its equations by the C library's random numbers.
    ctypes.CDLL(None).srand(seed % 2**31)
    normals, scales = _find_planes(lines, camera)
    usable = np.isfinite(scales)  # the lens model need not reach as far as a line does
    if usable.sum() < MIN_LINES:
        return None
    normals, scales, points = normals[usable], scales[usable], xyz[usable]
    rng, best, most, needed, done = np.random.default_rng(seed), None, 0.0, math.inf, 0
    while done < min(trials, max(needed, MIN_TRIALS)):
        batch = min(BATCH, trials - done)
        done += batch
        poses = _solve(normals, points, batch, rng)
        scores = _score(poses, normals, scales, points)  # (P,)
        if len(poses) == 0 or scores.max() <= most:
            continue
        refined = _refine(poses[scores.argmax()], lines, xyz, camera)
        errors = compute_line_errors(refined, camera, lines, xyz)
        most = float(scores.max())
        if best is None or _rate(errors).sum() > _rate(compute_line_errors(best, camera, lines, xyz)).sum():
            best, needed = refined, MULTIPLIER * _count_trials(float((errors < MAX_LINE_ERROR).mean()))
    if best is None:
        return None
    best = _refine(best, lines, xyz, camera)
    inliers = compute_line_errors(best, camera, lines, xyz) < MAX_LINE_ERROR
    if inliers.sum() < MIN_LINES or _count_false_alarms(best, camera, lines, xyz, inliers, done) > MAX_FALSE_ALARMS:
        return None
    return Estimate(cam_from_world=_to_rigid(best), inliers=inliers, trials=done)


def compute_line_errors(pose: Doubles, camera: pycolmap.Camera, lines: Doubles, xyz: Doubles) -> Doubles:
    """Return the distance from each projected point to its line, in pixels; infinite outside the image. -> (C,)

    `pose` is (3, 4), from world to camera.
    """
    xy = _project(pose, camera, xyz)
    return np.where(np.isnan(xy[:, 0]), np.inf, np.abs((lines[:, :2] * xy).sum(axis=1) + lines[:, 2]))


def _project(pose: Doubles, camera: pycolmap.Camera, xyz: Doubles) -> Doubles:
    """Return the pixels of points; NaN behind the camera or outside the image. -> (C, 2)"""
    in_camera = xyz @ pose[:, :3].T + pose[:, 3]  # (C, 3)
    before = in_camera[:, 2] > 0
    xy = np.full((len(xyz), 2), np.nan)
    xy[before] = camera.img_from_cam(in_camera[before])
    xy[~((xy >= 0) & (xy <= (camera.width, camera.height))).all(axis=1)] = np.nan
    return xy


def _find_planes(lines: Doubles, camera: pycolmap.Camera) -> tuple[Doubles, Doubles]:
    """Return the unit normal of the plane through camera and line, and the pixels per unit of the line's equation.

    Under lens distortion the plane passes through two points of the line, a quarter of the image from its middle.
    Both are NaN if the lens model does not reach these points. -> (C, 3), (C,)
    """
    normal, middle = lines[:, :2], np.array([camera.width, camera.height]) / 2
    foot = middle - (normal @ middle + lines[:, 2])[:, None] * normal  # (C, 2) of the line, nearest to the middle
    along = np.stack([-normal[:, 1], normal[:, 0]], axis=1) * (min(camera.width, camera.height) / 4)
    one, other = (
        np.column_stack([np.asarray(camera.cam_from_img(each)), np.ones(len(lines))]) for each in (foot - along, foot + along)
    )
    planes: Doubles = np.cross(one, other)
    planes /= np.linalg.norm(planes, axis=1, keepdims=True)
    return planes, camera.mean_focal_length() / np.linalg.norm(planes[:, :2], axis=1)


def _solve(normals: Doubles, xyz: Doubles, count: int, rng: np.random.Generator) -> Doubles:
    """Return the poses from random minimal samples whose points are all in front of the camera. -> (P, 3, 4)"""
    import poselib

    poses = [np.empty((0, 3, 4))]
    for _ in range(count):
        sample = rng.choice(len(xyz), SAMPLE, replace=False)
        solutions = poselib.p6lp(normals[sample], xyz[sample])
        if solutions:
            matrices = np.array([solution.Rt for solution in solutions])  # (S, 3, 4)
            depths = matrices[:, 2, :3] @ xyz[sample].T + matrices[:, 2, 3:]  # (S, 6)
            poses.append(matrices[(depths > 0).all(axis=1)])
    return np.concatenate(poses)


def _score(poses: Doubles, normals: Doubles, scales: Doubles, xyz: Doubles) -> Doubles:
    """Return the sum of `_rate` of all matches for each pose, without lens distortion. -> (P,)"""
    in_camera = poses[:, :, :3] @ xyz.T + poses[:, :, 3:]  # (P, 3, C)
    depths = in_camera[:, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.abs(np.einsum("pdc,cd->pc", in_camera, normals)) * scales / depths
    return _rate(np.where(depths > 0, errors, np.inf)).sum(axis=1)


def _rate(errors: Doubles) -> Doubles:
    """Return 1 − (error / `MAX_LINE_ERROR`)², at least 0 (MSAC)."""
    return np.maximum(0.0, 1 - (np.minimum(errors, MAX_LINE_ERROR) / MAX_LINE_ERROR) ** 2)


def _refine(pose: Doubles, lines: Doubles, xyz: Doubles, camera: pycolmap.Camera) -> Doubles:
    """Return the pose of least squared line errors over its inliers. -> (3, 4)"""
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation

    inliers = compute_line_errors(pose, camera, lines, xyz) < MAX_LINE_ERROR
    if inliers.sum() < MIN_LINES:
        return pose

    def move(step: Doubles) -> Doubles:
        turn = Rotation.from_rotvec(step[:3]).as_matrix()
        return np.column_stack([turn @ pose[:, :3], turn @ pose[:, 3] + step[3:]])

    def compute_residuals(step: Doubles) -> Doubles:
        moved = move(step)
        in_camera = xyz[inliers] @ moved[:, :3].T + moved[:, 3]
        xy = np.asarray(camera.img_from_cam(in_camera))
        return np.nan_to_num((lines[inliers, :2] * xy).sum(axis=1) + lines[inliers, 2], nan=1e3, posinf=1e3, neginf=-1e3)

    return move(least_squares(compute_residuals, np.zeros(6), x_scale="jac", max_nfev=20).x)


def _count_trials(rate: float) -> float:
    """Return the trials after which the chance of no sample without outlier is below 1 − `CONFIDENCE`."""
    hit = rate**SAMPLE
    return math.inf if hit < 1e-12 else 0.0 if hit >= 1 else math.log(1 - CONFIDENCE) / math.log1p(-hit)


def _count_false_alarms(pose: Doubles, camera: pycolmap.Camera, lines: Doubles, xyz: Doubles, inliers: Any, trials: int) -> float:
    """Return the expected number of poses with as many inliers, if lines and points were matched at random."""
    from scipy.stats import binom

    step = max(1, -(-len(lines) // PAIRS))
    xy = _project(pose, camera, xyz[::step])
    near = np.abs(xy @ lines[::step, :2].T + lines[::step, 2]) < MAX_LINE_ERROR  # (points, lines), False where NaN
    np.fill_diagonal(near, False)
    chance = min(1.0, (near.sum() + 1) / (near.size - len(near)))
    free = int(inliers.sum()) - SAMPLE
    return trials * SOLUTIONS * float(binom.sf(free - 1, len(lines) - SAMPLE, chance))


def _to_rigid(pose: Doubles) -> pycolmap.Rigid3d:
    import pycolmap

    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.ascontiguousarray(pose[:, :3])), pose[:, 3])
