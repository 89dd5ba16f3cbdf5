"""The renderer against pycolmap's projection and geometry worked out by hand."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from scipy.ndimage import center_of_mass, label
from scipy.spatial.transform import Rotation

from bench.rendering.mipmap import Texture
from bench.rendering.raster import Drawing, PinholeCamera, Quad, draw

SIZE = 160, 120
FOCAL = 140.0
WHITE = np.ones((1, 1, 3), np.float32)


def create_camera(rotation: np.ndarray | None = None, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> PinholeCamera:
    turned = np.eye(3) if rotation is None else rotation
    calibration = np.array([[FOCAL, 0, SIZE[0] / 2], [0, FOCAL, SIZE[1] / 2], [0, 0, 1]])
    return PinholeCamera(calibration=calibration, rotation=turned, translation=-turned @ np.array(centre), size=SIZE)


def create_quad(pixels: np.ndarray, corner=(-1.0, -1.0, 3.0), across=(2.0, 0.0, 0.0), down=(0.0, 2.0, 0.0), **rest) -> Quad:
    texture = Texture.of(pixels)
    edges = {"corner": np.array(corner), "across": np.array(across), "down": np.array(down)}
    return Quad(**edges, texture=lambda: texture, light=WHITE, **rest)


def flat(value: int) -> np.ndarray:
    return np.full((8, 8, 3), value, np.uint8)


def black(rays: np.ndarray) -> np.ndarray:
    return np.zeros_like(rays)


def render(camera: PinholeCamera, *quads: Quad, foreground: tuple[Quad, ...] = ()) -> Drawing:
    return draw(camera, quads, foreground, black)


@pytest.fixture(scope="module")
def dots() -> tuple[np.ndarray, np.ndarray]:
    """A texture with white discs, and their centres as (u, v)."""
    texture = np.zeros((512, 512, 3), np.uint8)
    y, x = np.mgrid[:512, :512] + 0.5
    centres = np.array([(u, v) for u in (0.2, 0.5, 0.8) for v in (0.25, 0.6, 0.85)])
    for u, v in centres:
        texture[np.hypot(x - 512 * u, y - 512 * v) < 16] = 255
    return texture, centres


def measure_offset(image: np.ndarray, expected: np.ndarray) -> float:
    """Measure the largest distance in pixels from an expected point to the nearest disc in the image."""
    labels, count = label(image > 0.08)
    found = np.array(center_of_mass(image, labels, range(1, count + 1)))[:, ::-1] + 0.5
    return float(np.linalg.norm(expected[:, None] - found[None], axis=2).min(axis=1).max())


def test_points_are_drawn_where_pycolmap_projects_them(dots) -> None:
    texture, centres = dots
    rotation = Rotation.from_euler("xyz", [6, 12, 5], degrees=True).as_matrix()
    camera = create_camera(rotation, (0.3, 0.2, -0.1))
    plane = create_quad(texture, (-1.1, -0.9, 2.7), (2.0, 0.1, 0.7), (0.0, 1.7, 0.2))
    image = render(camera, plane).light[..., 0]
    points = plane.corner + centres @ np.stack([plane.across, plane.down])
    intrinsics = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, *SIZE)

    def project(pose: pycolmap.Rigid3d) -> np.ndarray:
        return np.array([intrinsics.img_from_cam(pose * point) for point in points])

    exact = pycolmap.Rigid3d(pycolmap.Rotation3d(rotation), camera.translation)
    assert measure_offset(image, project(exact)) < 0.12  # perspective moves a disc's centroid a little
    # Controls: 3 cm aside, half a degree aside, and the convention that puts the first pixel's centre at 0.
    aside = pycolmap.Rigid3d(exact.rotation, exact.translation + np.array([0.03, 0, 0]))
    turned = pycolmap.Rigid3d(
        pycolmap.Rotation3d(Rotation.from_euler("y", 0.5, degrees=True).as_matrix() @ rotation), exact.translation
    )
    assert measure_offset(image, project(aside)) > 0.8
    assert measure_offset(image, project(turned)) > 0.8
    assert measure_offset(image, project(exact) - 0.5) > 0.5


def test_nearer_quads_hide_those_behind_in_any_order() -> None:
    behind, before = create_quad(flat(255)), create_quad(flat(128), (-0.2, -0.2, 1.5), (0.4, 0, 0), (0, 0.4, 0))
    one, other = render(create_camera(), behind, before), render(create_camera(), before, behind)
    np.testing.assert_array_equal(one.light, other.light)
    assert one.light[60, 80, 0] < 0.5 < one.light[30, 80, 0]
    assert one.depth[60, 80] == pytest.approx(1.5, rel=1e-5)
    assert one.depth[30, 80] == pytest.approx(3, rel=1e-5)


def test_crossing_planes_are_resolved_at_every_pixel() -> None:
    left = create_quad(flat(255), (-1, -1, 2), (2, 0, 2), (0, 2, 0))  # z = 3 + x
    right = create_quad(flat(128), (-1, -1, 4), (2, 0, -2), (0, 2, 0))  # z = 3 - x
    image = render(create_camera(), left, right).light[60, :, 0]
    assert (image[60:79] > 0.9).all()
    assert (image[82:100] < 0.5).all()


def test_quads_have_one_side() -> None:
    from_behind = create_quad(flat(255), (1, -1, 3), (-2, 0, 0))
    assert render(create_camera(), create_quad(flat(255))).light.max() > 0.9
    assert render(create_camera(), from_behind).light.max() == 0


def test_floor_under_the_camera_is_cut_at_the_near_plane() -> None:
    # 1.5 m below, from 5 m behind to 40 m ahead: y is down.
    floor = create_quad(flat(255), (-30, 1.5, 40), (60, 0, 0), (0, 0, -45))
    depth = render(create_camera(), floor).depth
    rows = np.arange(75, 120)
    np.testing.assert_allclose(depth[rows, 80], 1.5 * FOCAL / (rows + 0.5 - 60), rtol=1e-4)
    assert np.isinf(depth[:60]).all()


def test_depth_is_along_the_axis() -> None:
    wall = create_quad(flat(255), (-9, -9, 4), (18, 0, 0), (0, 18, 0))
    np.testing.assert_allclose(render(create_camera(), wall).depth, 4, rtol=1e-5)


def test_fine_patterns_far_away_turn_grey() -> None:
    checkerboard = (np.indices((512, 512)).sum(axis=0) % 2 * 255).astype(np.uint8)[..., None].repeat(3, axis=2)
    textured = create_quad(checkerboard, (-8, -8, 30), (16, 0, 0), (0, 16, 0))
    image = render(create_camera(), textured).light[30:90, 50:110, 0]
    assert image.std() < 0.01
    # Control: without the smaller levels the pattern aliases.
    finest = Texture((checkerboard, checkerboard))
    aliased = render(create_camera(), replace(textured, texture=lambda: finest))
    assert aliased.light[30:90, 50:110, 0].std() > 0.05


def test_levels_are_blended_and_may_lie_far_apart() -> None:
    texture = Texture(
        tuple(np.full((2**size, 2**size, 3), value, np.uint8) for size, value in ((5, 0), (4, 255), (3, 0), (2, 255)))
    )
    camera = np.full(4, 0.5, np.float32)
    found = texture.sample(camera, camera, np.array([0.0, 0.25, 2.5, 2.75], np.float32))[:, 0]
    np.testing.assert_allclose(found, [0, 0.25, 0.5, 0.75], atol=1e-6)


def test_window_shows_part_of_a_texture() -> None:
    halves = np.zeros((64, 64, 3), np.uint8)
    halves[:, 32:] = 255
    assert render(create_camera(), create_quad(halves, window=(0.5, 0.0, 0.5, 1.0))).light[60, 40:120, 0].min() > 0.9
    assert render(create_camera(), create_quad(halves, window=(0.0, 0.0, 0.5, 1.0))).light[60, 60:100, 0].max() < 0.1


def test_foreground_is_where_it_is_solid_and_not_hidden() -> None:
    disc = (np.hypot(*(np.mgrid[:64, :64] - 31.5)) < 30).astype(np.float32)
    wall = create_quad(flat(255))
    person = create_quad(flat(128), (-0.5, -0.5, 2), (1, 0, 0), (0, 1, 0), opacity=disc)
    drawing = render(create_camera(), wall, foreground=(person,))
    y, x = np.mgrid[: SIZE[1], : SIZE[0]] + 0.5
    inside = np.hypot(x - 80, y - 60) < FOCAL / 2 * 0.5 * 30 / 32
    assert (drawing.foreground != inside).mean() < 0.005
    assert drawing.foreground.sum() > 2000
    hidden = create_quad(flat(200), (-0.5, -0.5, 1.5), (0.5, 0, 0), (0, 1, 0))
    drawing = render(create_camera(), wall, hidden, foreground=(person,))
    assert not drawing.foreground[:, :79].any()
    assert (drawing.foreground[:, 82:] == (inside[:, 82:])).mean() > 0.99


def test_sky_is_evaluated_in_the_direction_of_each_pixel() -> None:
    rotation = Rotation.from_euler("y", 30, degrees=True).as_matrix()
    light = draw(create_camera(rotation), (), (), lambda rays: rays).light
    camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_PINHOLE", FOCAL, *SIZE)
    ray = np.append(camera.cam_from_img(np.array([100.5, 30.5])), 1)
    np.testing.assert_allclose(light[30, 100], rotation.T @ ray / np.linalg.norm(ray), atol=1e-4)
