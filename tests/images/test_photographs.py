"""Reading of photographs, and the error for each kind of invalid file."""

from pathlib import Path

import numpy as np
import pytest
from fakes import draw_texture, write_album
from PIL import Image

from bench.core.errors import SampleError, UserError
from bench.extractors.sift import Sift
from bench.images import photographs


def save(path: Path, image: Image.Image, **options: object) -> Path:
    image.save(path, **options)
    return path


def test_built_in_photographs() -> None:
    sources = photographs.list_builtin()
    assert [source.name for source in sources] == [
        "astronaut",
        "chelsea",
        "coffee",
        "rocket",
        "motorcycle_left",
        "china",
        "flower",
    ]
    for source in sources:
        found = photographs.read(source.path)
        assert found.pixels.shape == (256, 256, 3)
        assert found.pixels.dtype == np.uint8
        assert found.notes == ()


def test_folder_is_sorted_and_finds_subfolders(tmp_path: Path) -> None:
    draw_texture(0).save(tmp_path / "b.JPG")
    write_album(tmp_path / "a", 1)
    (tmp_path / "notes.txt").write_text("no photograph")
    assert [source.name for source in photographs.list_photographs(tmp_path)] == ["a/0.png", "b.JPG"]


def test_empty_and_missing_folders(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no photograph in it \(looked for \.avif, \.bmp, \.jfif, \.jpeg, .*\)"):
        photographs.list_photographs(tmp_path)
    with pytest.raises(UserError, match="no such folder"):
        photographs.list_photographs(tmp_path / "absent")


def test_square_is_cropped_from_the_centre(tmp_path: Path) -> None:
    pixels = np.zeros((100, 300, 3), np.uint8)
    pixels[:, 100:200] = 200  # the centred square
    read = photographs.read(save(tmp_path / "wide.png", Image.fromarray(pixels))).pixels
    assert (read[:, 8:-8] == 200).all()


def test_truncated_jpeg(tmp_path: Path) -> None:
    path = save(tmp_path / "cut.jpg", draw_texture(0))
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(SampleError, match=r"cut\.jpg: cannot be read as an image: (?i:.*truncated)"):
        photographs.read(path)


@pytest.mark.parametrize("content", [b"", b"text", b"\x89PNG\r\n\x1a\n", b"RIFF\x00\x00\x00\x00WEBP"])
def test_file_that_is_not_an_image(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "false.png"
    path.write_bytes(content)
    with pytest.raises(SampleError, match=r"false\.png: cannot be read as an image"):
        photographs.read(path)


def test_one_pixel(tmp_path: Path) -> None:
    with pytest.raises(SampleError, match="1 x 1 pixels; at least 32 x 32 are needed"):
        photographs.read(save(tmp_path / "dot.png", Image.new("RGB", (1, 1))))


def test_image_without_a_keypoint(tmp_path: Path) -> None:
    flat = photographs.read(save(tmp_path / "flat.png", Image.new("RGB", (64, 64), "grey")))
    with pytest.raises(SampleError, match="no keypoint"):
        Sift().extract(flat.pixels)


def test_grey_is_read_as_three_equal_channels_with_a_note(tmp_path: Path) -> None:
    found = photographs.read(save(tmp_path / "grey.png", draw_texture(0).convert("L")))
    assert (found.pixels[..., 0] == found.pixels[..., 2]).all()
    assert "grey" in found.notes[0]


def test_sixteen_bits_are_scaled_to_eight_with_a_note(tmp_path: Path) -> None:
    deep = np.full((64, 64), 40_000, np.uint16)
    found = photographs.read(save(tmp_path / "deep.png", Image.fromarray(deep)))
    assert (found.pixels == round(40_000 / 257)).all()
    assert any("16 bits" in note for note in found.notes)


def test_exif_rotation_is_applied(tmp_path: Path) -> None:
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32] = 255  # the top half is white
    exif = Image.Exif()
    exif[0x0112] = 6  # to be turned clockwise by a quarter, which brings the top to the right
    read = photographs.read(save(tmp_path / "turned.png", Image.fromarray(pixels), exif=exif)).pixels
    assert read[:, 200:].min() > 200
    assert read[:, :50].max() < 50


def test_transparency_is_composited_over_white(tmp_path: Path) -> None:
    clear = Image.new("RGBA", (64, 64), (255, 0, 0, 0))
    palette = Image.new("P", (64, 64), 3)
    palette.putpalette([0, 0, 255] * 256)
    for found in (
        photographs.read(save(tmp_path / "clear.png", clear)),
        photographs.read(save(tmp_path / "palette.png", palette, transparency=3)),
    ):
        assert (found.pixels == 255).all()
        assert "transparency" in found.notes[0]


def test_palette_without_transparency(tmp_path: Path) -> None:
    palette = Image.new("P", (64, 64), 3)
    palette.putpalette([10, 20, 30] * 256)
    found = photographs.read(save(tmp_path / "palette.png", palette))
    assert (found.pixels == (10, 20, 30)).all()


def test_validation_set(tmp_path: Path) -> None:
    sources = photographs.list_photographs(write_album(tmp_path / "all", 4))
    names = tmp_path / "names.txt"
    names.write_text("1.png\n3.png\n")
    training, validation = photographs.split_validation(sources, names)
    assert [source.name for source in training] == ["0.png", "2.png"]
    assert [source.name for source in validation] == ["1.png", "3.png"]
    assert [source.name for source in photographs.split_validation(sources, None)[1]] == ["0.png"]
    assert photographs.split_validation(sources, write_album(tmp_path / "others", 1))[0] == sources
    names.write_text("absent.png")
    with pytest.raises(UserError, match="names none"):
        photographs.split_validation(sources, names)
    with pytest.raises(UserError, match="no such folder or file"):
        photographs.split_validation(sources, tmp_path / "absent")
