"""The hard night: its queries by night alone differ from the gallery's."""

import numpy as np
import pytest

from bench.core.errors import UserError
from bench.datasets.gallery import Gallery
from bench.datasets.hard_night import HardNight

SMALL = {"views": 3, "queries": 6, "night": 0.5, "width": 160, "height": 120, "rooms": 1, "detail": 0.2}


def test_only_queries_by_night_differ_from_the_gallery() -> None:
    scene, gallery = HardNight(**SMALL, noise=5.0, blur=1.0).scene(), Gallery(**SMALL).scene()  # type: ignore[arg-type]
    assert [image.pixels for image in scene.references] == [image.pixels for image in gallery.references]  # the same map
    assert [query.name for query in scene.queries] == [query.name for query in gallery.queries]
    equal = [
        own.pixels.content_hash() == other.pixels.content_hash()
        for own, other in zip(scene.queries, gallery.queries, strict=True)
    ]
    assert equal == [query.condition == "day" for query in scene.queries] == [True] * 3 + [False] * 3
    poses = [(own.cam_from_world, other.cam_from_world) for own, other in zip(scene.queries, gallery.queries, strict=True)]
    assert all(own is not None and np.array_equal(own.matrix(), other.matrix()) for own, other in poses if other is not None)


@pytest.mark.slow
def test_noise_and_viewpoint_reach_the_queries_by_night() -> None:
    easy, noisy, far = (
        HardNight(**SMALL, **more).scene().queries[5]  # type: ignore[arg-type]
        for more in ({"noise": 1.0, "blur": 1.0}, {"noise": 9.0, "blur": 1.0}, {"noise": 1.0, "blur": 1.0, "viewpoint": 3.0})
    )

    def measure_grain(pixels: np.ndarray) -> float:
        return float(np.abs(np.diff(pixels.astype(float), axis=1)).mean())

    assert measure_grain(noisy.pixels.read()) > 2 * measure_grain(easy.pixels.read())
    assert far.cam_from_world is not None
    assert easy.cam_from_world is not None
    assert not np.allclose(far.cam_from_world.matrix(), easy.cam_from_world.matrix())


def test_invalid_settings_name_the_dataset() -> None:
    with pytest.raises(UserError, match="hard-night: viewpoint, people, blur and noise are finite"):
        HardNight(noise=-1.0)
