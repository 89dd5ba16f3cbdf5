"""Structure from motion of rendered views must recover their cameras."""

from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from fakes import write_album
from PIL import Image
from scipy.spatial.distance import pdist

from bench.cache import store
from bench.core.errors import UserError
from bench.datasets import captured
from bench.datasets.captured import Captured
from bench.datasets.gallery import Gallery
from bench.images.scene import SceneImage

pytestmark = pytest.mark.slow

WALK = Gallery(views=150, rooms=1, people=0.0, width=400, height=300, detail=0.5)
FIRST, COUNT = 84, 9


@pytest.fixture(scope="module")
def truth() -> list[SceneImage]:
    """Consecutive views of the walk around the courtyard."""
    return list(WALK.scene().references[FIRST : FIRST + COUNT])


@pytest.fixture(scope="module")
def photographs(truth: list[SceneImage], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("walk")
    for number, image in enumerate(truth):
        Image.fromarray(image.pixels.read()).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def dataset(photographs: Path, truth: list[SceneImage], tmp_path_factory: pytest.TempPathFactory) -> Captured:
    """A dataset in metres, since the distance of two cameras is given in metres."""
    length = float(np.linalg.norm(centres(truth)[0] - centres(truth)[-1]))
    return Captured(
        path=photographs,
        held_out=4,
        first="0.png",
        second=f"{COUNT - 1}.png",
        length=length,
    )


def centres(images: list[SceneImage]) -> np.ndarray:
    return np.array([image.cam_from_world.inverse().translation for image in images])


@pytest.mark.slow
def test_structure_from_motion_recovers_the_cameras_of_the_gallery(dataset: Captured, truth: list[SceneImage]) -> None:
    scene = dataset.scene()
    assert scene.excluded_images == ()
    assert [query.name for query in scene.queries] == ["0.png", "4.png", "8.png"]
    assert len(scene.references) == COUNT - 3
    found = sorted(scene.references + scene.queries, key=lambda image: image.name)
    expected, distances = pdist(centres(truth)), pdist(centres(found))
    assert np.abs(distances - expected).max() < 0.03 * expected.max()
    for (a, b), (c, d) in zip(pairwise(truth), pairwise(found), strict=True):
        turn = a.cam_from_world.rotation * b.cam_from_world.rotation.inverse()
        other = c.cam_from_world.rotation * d.cam_from_world.rotation.inverse()
        assert np.degrees(turn.angle_to(other)) < 0.5
    assert found[0].camera.mean_focal_length() == pytest.approx(truth[0].camera.mean_focal_length(), rel=0.03)
    assert found[0].pixels.read().shape == (300, 400, 3)


def test_queries_can_be_consecutive(dataset: Captured) -> None:
    scene = replace(dataset, leading=4).scene()
    assert [query.name for query in scene.queries] == ["0.png", "1.png", "2.png", "3.png"]
    assert len(scene.references) == COUNT - 4
    with pytest.raises(UserError, match="none a reference"):
        replace(dataset, leading=COUNT).scene()


def test_model_is_cached_by_content(
    dataset: Captured, photographs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = dataset.scene()

    class RepeatedError(Exception):
        pass

    def rebuild(*arguments: object) -> None:
        raise RepeatedError

    monkeypatch.setattr(captured, "_run_structure_from_motion", rebuild)
    twice = replace(dataset, length=2 * dataset.length).scene()
    np.testing.assert_allclose(centres(twice.references), 2 * centres(before.references))
    assert twice.unit == f"{2 * dataset.length:g} between the cameras of 0.png and 8.png"
    copied = tmp_path / "copy"
    copied.mkdir()
    for path in photographs.iterdir():
        (copied / path.name).write_bytes(path.read_bytes())
    assert len(replace(dataset, path=copied).scene().references) == len(before.references)  # the same content elsewhere
    Image.open(copied / "3.png").transpose(Image.Transpose.ROTATE_180).save(copied / "3.png")
    with pytest.raises(RepeatedError):
        replace(dataset, path=copied).scene()


def test_unit_must_be_fixed_by_two_photographs_with_poses(dataset: Captured) -> None:
    with pytest.raises(UserError, match=r"99\.png, which defines the unit of length, has no pose; give another"):
        replace(dataset, second="99.png").scene()
    with pytest.raises(UserError, match=r"0\.png and 0\.png have the same position"):
        replace(dataset, second="0.png").scene()
    assert replace(dataset, first=None, second=None).scene().unit.endswith("between the cameras of 0.png and 4.png")


def test_photographs_without_overlap_are_refused(tmp_path: Path) -> None:
    before = [entry for entry in store.list_entries() if entry.kind == "models"]
    with pytest.raises(UserError, match="structure from motion found no model; do the photographs overlap"):
        Captured(path=write_album(tmp_path / "noise", 3)).scene()
    assert [entry for entry in store.list_entries() if entry.kind == "models"] == before


@pytest.mark.parametrize("fields", [{"held_out": 1}, {"leading": -1}, {"length": 0.0}, {"length": float("nan")}])
def test_impossible_fields_are_refused(fields: dict) -> None:
    with pytest.raises(UserError, match="captured: "):
        Captured(path=Path("x"), **fields)
