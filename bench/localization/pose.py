"""The pose of a query from matches of its keypoints with points of the map; its intrinsics are fixed."""
from __future__ import annotations
from dataclasses import dataclass
import numpy as np
import pycolmap
import poselib

def colmap(xy, xyz, camera, trials, seed=0, max_error=12.0, confidence=0.9999, mult=3.0):
    est = pycolmap.AbsolutePoseEstimationOptions()
    est.ransac.max_error=max_error; est.ransac.min_inlier_ratio=1e-6; est.ransac.confidence=confidence; est.ransac.dyn_num_trials_multiplier=mult
    est.ransac.min_num_trials=min(1000, trials); est.ransac.max_num_trials=trials; est.ransac.random_seed=seed; est.ransac.num_threads=1
    f = pycolmap.estimate_and_refine_absolute_pose(xy, xyz, camera, est)
    return None if f is None else (f["cam_from_world"], f["inlier_mask"], None)

def plib(xy, xyz, camera, trials, seed=0, max_error=12.0, confidence=0.9999, mult=3.0):
    cam = {"model": camera.model.name, "width": camera.width, "height": camera.height, "params": list(camera.params)}
    p, info = poselib.estimate_absolute_pose(xy - 0.0, xyz, cam, {"max_reproj_error": max_error, "max_iterations": trials, "min_iterations": min(1000, trials), "success_prob": confidence, "dyn_num_trials_mult": mult, "seed": seed}, {})
    return pycolmap.Rigid3d(pycolmap.Rotation3d(np.roll(p.q, -1)), p.t), np.array(info["inliers"]), info["iterations"]

def errors(found, truth):
    d = found.inverse().translation - truth.inverse().translation
    return float(np.linalg.norm(d)), float(np.degrees(found.rotation.angle_to(truth.rotation)))
