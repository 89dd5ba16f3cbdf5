"""No defense: the features are released unchanged, in separate memory."""

from typing import Any

import numpy as np
import pytest
from fakes import draw_texture

from bench.api import Privacy
from bench.codebook.examples import draw_features
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.types import Features
from defenses.none import PLUGIN


def test_releases_the_descriptors_and_shares_no_memory() -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.normal(size=(5, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    keypoints = rng.uniform(0, 64, (5, 2)).astype(np.float32)
    secret = Features(keypoints=keypoints, descriptors=descriptors, codes=None, size=(64, 48))
    release = PLUGIN().protect(secret, Public(), rng)
    copies = descriptors.copy(), keypoints.copy()
    descriptors[:] = 0
    keypoints[:] = 0
    np.testing.assert_array_equal(release.descriptors, copies[0])
    np.testing.assert_array_equal(release.keypoints, copies[1])
    assert release.size == (64, 48)


def test_has_no_guarantee() -> None:
    assert PLUGIN().privacy(Public()) == Privacy("none")
    assert PLUGIN.name() == "none"


@pytest.mark.parametrize(("sends", "columns"), [("positions", None), ("scale", 1), ("scale-and-orientation", 2)])
def test_sends_the_configured_parts_of_a_keypoint(sends: Any, columns: int | None) -> None:
    secret = Sift(upright=False).extract(np.array(draw_texture(0, (256, 256))))
    release = PLUGIN(sends=sends).protect(secret, Public(), np.random.default_rng(0))
    if columns is None:
        assert release.frames is None
        return
    np.testing.assert_array_equal(release.frames, secret.frames[:, :columns])
    assert not np.shares_memory(release.frames, secret.frames)


def test_cannot_send_what_the_extractor_does_not_provide() -> None:
    with pytest.raises(UserError, match="extractor does not provide"):
        PLUGIN(sends="scale").protect(draw_features(), Public(), np.random.default_rng(0))


def test_scales_and_orientations_are_those_of_the_keypoints() -> None:
    """An image of twice the size has twice the scales, and a quarter turn adds a quarter turn to orientations."""
    picture = draw_texture(0, (128, 128))
    small = Sift(upright=False).extract(np.array(picture))
    large = Sift(upright=False).extract(np.array(picture.resize((256, 256))))
    assert 1.6 < np.median(large.frames[:, 0]) / np.median(small.frames[:, 0]) < 2.4
    turned = Sift(upright=False).extract(np.array(picture.rotate(-90)))  # clockwise, as OpenCV counts
    quarters = [
        (frame[1] - small.frames[near, 1]) / (np.pi / 2) % 4
        for (x, y), frame in zip(turned.keypoints, turned.frames, strict=True)
        if (near := int(np.abs(small.keypoints - [y, 128 - x]).sum(axis=1).argmin())) >= 0
        and np.abs(small.keypoints[near] - [y, 128 - x]).sum() < 0.5
    ]
    assert len(quarters) > 50
    assert np.mean(np.abs(np.array(quarters) - 1) < 0.1) > 0.5
    assert np.mean(np.abs(np.array(quarters) - 2) < 0.1) < 0.3  # negative control
