"""A camera's sensor: blur, exposure, white balance, noise, tone curve, eight bits."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from bench.rendering.mipmap import GAMMA
from bench.types import Bytes, Floats

GREY = 0.16  # the linear value that exposure brings the image's geometric mean to
HIGHEST_GAIN = 9.0  # of the automatic exposure: darker scenes stay dark
EXPOSURE_ERROR = 0.2  # deviation, in stops
SHOT, READ = 1.5e-4, 6e-4  # variance of a value of one, and deviation of darkness, at a gain of one
SHOULDER = 0.35  # curvature of the tone curve


@dataclass(frozen=True, kw_only=True)
class Sensor:
    """The defects of a camera."""

    defocus: float  # pixels, deviation of a Gaussian
    shake: float  # pixels, typical length of the trace of a point
    noise: float  # relative to a good sensor
    cast: float  # typical deviation of a colour's gain


def compute_gain(light: Floats) -> float:
    """Compute the gain of automatic exposure for (H, W, 3) linear light."""
    brightness = float(np.exp(np.log(light.mean(axis=2) + 1e-4).mean()))
    return min(GREY / brightness, HIGHEST_GAIN)


def expose(light: Floats, sensor: Sensor, gain: float, rng: np.random.Generator) -> Bytes:
    """Expose an image: (H, W, 3) linear light -> (H, W, 3) uint8."""
    blurred = _blur_motion(light, sensor.shake * abs(rng.normal()), rng.uniform(0, np.pi))
    focus = sensor.defocus * rng.uniform(0.5, 1.5)
    if focus > 0.1:
        blurred = np.asarray(cv2.GaussianBlur(blurred, (0, 0), focus), np.float32)
    gain *= 2 ** rng.normal(0, EXPOSURE_ERROR)
    values = (
        blurred
        * _compute_vignette(light.shape[:2])[..., None]
        * np.float32(gain)
        * rng.normal(1, sensor.cast, 3).astype(np.float32)
    )
    deviation = np.sqrt(SHOT * gain * np.maximum(values, 0) + (READ * gain) ** 2) * np.float32(sensor.noise)
    values = np.maximum(values + deviation * rng.standard_normal(values.shape, dtype=np.float32), 0)
    toned = values * (1 + SHOULDER) / (1 + SHOULDER * values)
    return np.rint(255 * np.clip(toned, 0, 1) ** (1 / GAMMA)).astype(np.uint8)


def _blur_motion(light: Floats, length: float, turn: float) -> Floats:
    """Blur along a line."""
    if length < 0.5:
        return light
    side = 2 * int(np.ceil(length / 2)) + 3
    middle = side // 2
    kernel = np.zeros((side, side), np.uint8)
    half = length / 2 * np.array([np.cos(turn), np.sin(turn)])
    ends = np.rint((np.array([-half, half]) + middle) * 16).astype(int)
    cv2.line(kernel, ends[0], ends[1], 255, 1, cv2.LINE_AA, 4)
    spread = kernel.astype(np.float32) / float(kernel.sum())
    return np.asarray(cv2.filter2D(light, -1, spread, borderType=cv2.BORDER_REPLICATE), np.float32)


def _compute_vignette(size: tuple[int, int]) -> Floats:
    """Compute the darkening towards the corners. -> (h, w)"""
    y, x = np.meshgrid(np.linspace(-1, 1, size[0]), np.linspace(-1, 1, size[1]), indexing="ij")
    return (1 - 0.12 * (x * x + y * y)).astype(np.float32)
