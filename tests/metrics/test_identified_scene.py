"""The metric `identified-scene`, and the other views that it compares with: synthetic planes, and the gallery."""

import dataclasses

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from bench import scene_views
from bench.datasets.gallery import Gallery
from bench.identification import distractors
from bench.identification.thumbnails import compare_shifted, compare_thumbnails, compute_thumbnail
from bench.images.scene import File, SceneImage
from bench.scene_views import Glance
from bench.testing import check_metric
from metrics.identified_scene import IdentifiedScene


def draw_thumbnails(rng: np.random.Generator, count: int = 256) -> np.ndarray:
    return rng.random((count, 16, 16))


def enlarge(thumbnail: np.ndarray) -> np.ndarray:
    """Return an image with about that thumbnail. (16, 16) -> (256, 256, 3)"""
    return np.repeat(np.kron(thumbnail, np.ones((16, 16)))[..., None], 3, axis=2).astype(np.float32)


# ---- the metric


def test_the_contract_holds() -> None:
    check_metric(IdentifiedScene())


def test_another_view_is_found_though_it_is_shifted(rng: np.random.Generator) -> None:
    wide = rng.random((16, 20))
    views = np.concatenate([wide[None, :, 4:], draw_thumbnails(rng, 255)])
    assert IdentifiedScene()(views, enlarge(wide[:, :16])) == 1.0
    assert compare_thumbnails(wide[:, :16], wide[:, 4:]) < 0.3, "without shifts the views have little in common"


@pytest.mark.parametrize("grey", [0.0, 0.45, 1.0])
def test_control_a_constant_image_scores_chance(grey: float, rng: np.random.Generator) -> None:
    assert IdentifiedScene()(draw_thumbnails(rng), np.full((64, 48, 3), grey, np.float32)) == 1 / 128.5


def test_control_noise_has_any_rank(rng: np.random.Generator) -> None:
    ranks = [1 / IdentifiedScene()(draw_thumbnails(rng), rng.random((32, 32, 3))) for _ in range(40)]
    assert 100 < np.mean(ranks) < 157, "within about three deviations of 128.5"


def test_the_similarity_is_the_greatest_correlation_of_overlaps(rng: np.random.Generator) -> None:
    one, other = draw_thumbnails(rng, 2)
    padded = np.full((24, 24), np.nan)
    padded[4:20, 4:20] = other
    expected = -1.0
    for down in range(9):
        for right in range(9):
            window = padded[down : down + 16, right : right + 16]
            both = np.isfinite(window)
            expected = max(expected, np.corrcoef(one[both], window[both])[0, 1])
    assert compare_shifted(one, other[None], 4) == pytest.approx([expected])


# ---- what two views share


def look_at_wall(x: float, away: float = 4.0, size: tuple[int, int] = (48, 36), focal: float = 40.0) -> Glance:
    """Return the glance of a camera that looks straight at a wall, from `x` along it."""
    width, height = size
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", focal, width, height)
    pose = pycolmap.Rigid3d(pycolmap.Rotation3d(), np.array([-x, 0.0, away]))
    image = SceneImage(name="", camera=camera, cam_from_world=pose, condition="day", pixels=None)  # type: ignore[arg-type]
    return scene_views._build_glance(image, np.zeros((16, 16)), np.full((height, width), away))


@pytest.mark.parametrize(("step", "expected"), [(0.0, 1.0), (1.2, 0.75), (2.4, 0.5), (4.8, 0.0), (50.0, 0.0)])
def test_views_along_a_wall_share_what_overlaps(step: float, expected: float) -> None:
    """At 4 metres, 48 pixels of focal length 40 see 4.8 metres of wall."""
    (shared,) = scene_views.measure_shared(look_at_wall(0.0), [look_at_wall(step)])
    np.testing.assert_allclose(shared, expected, atol=0.03)


def test_a_closer_view_is_a_part() -> None:
    (shared,) = scene_views.measure_shared(look_at_wall(0.0), [look_at_wall(0.0, away=2.0)])
    np.testing.assert_allclose(shared, [0.25, 1.0], atol=0.03)


def test_what_is_hidden_or_behind_is_not_shared() -> None:
    near = look_at_wall(0.0)
    hidden = dataclasses.replace(near, depth=np.full_like(near.depth, 1.0))  # another wall stands in front
    assert not hidden.find_visible(near.points).any()
    turned = np.hstack([Rotation.from_euler("y", 180, degrees=True).as_matrix(), np.zeros((3, 1))])
    behind = dataclasses.replace(near, projection=near.projection[:, :3] @ turned)
    assert not behind.find_visible(near.points).any()
    sky = dataclasses.replace(near, points=np.full_like(near.points, np.nan))
    assert not near.find_visible(sky.points).any()


# ---- candidates


def test_only_scenes_of_the_gallery_have_other_views() -> None:
    gallery = Gallery(views=2, queries=1, width=64, height=48)
    scene = gallery.scene()
    (query,) = scene.queries
    assert scene_views.list_candidates(query, ()) is None
    assert scene_views.list_candidates(dataclasses.replace(query, cam_from_world=None), scene.references) is None
    photograph = dataclasses.replace(query, pixels=File(path=None, size=(64, 48)))  # type: ignore[arg-type]
    assert scene_views.list_candidates(photograph, scene.references) is None


@pytest.mark.exhaustive
def test_the_photograph_itself_identifies_its_scene_and_a_blank_image_does_not() -> None:
    """The first room alone, by day, without people: 40 references within it, 12 queries."""
    scene = Gallery(views=40, queries=12, rooms=1, night=0.0, people=0.0, width=96, height=72).scene()
    values = []
    for query in scene.queries:
        views = scene_views.list_candidates(query, scene.references)
        if views is None:
            continue
        assert views.shape == (256, 16, 16)
        photograph = query.pixels.read() / 255
        values.append(IdentifiedScene()(views, photograph))
        assert IdentifiedScene()(views, np.full_like(photograph, 0.5)) == 1 / 128.5
        assert compare_thumbnails(compute_thumbnail(photograph), views[0]) < distractors.DUPLICATE, "the target is another view"
    assert len(values) >= 6
    assert np.mean(values) > 0.2, "a random order has 0.024"
