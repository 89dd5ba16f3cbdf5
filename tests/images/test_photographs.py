"""Reading of photographs, and the error for each kind of invalid file."""

import logging
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from fakes import build_exif, draw_texture, write_album
from PIL import Image, ImageOps, features

from bench.core.errors import SampleError, UserError
from bench.extractors.sift import Sift
from bench.formats.stored_features import read_upright_size
from bench.images import photographs
from bench.images.photographs import Source


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


def list_names(folder: Path) -> list[str]:
    return [source.name for source in photographs.list_photographs(folder)]


@pytest.mark.parametrize("suffix", [".bmp", ".jfif", ".tif", ".TIFF", ".png", ".webp", ".avif"])
def test_formats_are_listed_and_read(tmp_path: Path, suffix: str) -> None:
    if suffix == ".avif" and not features.check("avif"):
        pytest.skip("this Pillow cannot read AVIF")
    texture = draw_texture(0)
    path = save(tmp_path / f"a{suffix}", texture, **({"format": "JPEG"} if suffix == ".jfif" else {}))
    assert list_names(tmp_path) == [path.name]
    expected = photographs.crop_square(texture, 256).astype(int)
    assert np.abs(photographs.read(path).pixels - expected).mean() < (1 if suffix in (".bmp", ".tif", ".TIFF", ".png") else 20)


def test_linked_folders_and_files_are_read_under_their_own_names(tmp_path: Path) -> None:
    elsewhere, folder = write_album(tmp_path / "elsewhere", 1), tmp_path / "photos"
    write_album(elsewhere / "deeper", 1)
    (folder / "real").mkdir(parents=True)
    (folder / "link").symlink_to(elsewhere, target_is_directory=True)
    (folder / "a.png").symlink_to(elsewhere / "0.png")
    assert list_names(folder) == ["a.png", "link/0.png", "link/deeper/0.png"]


def test_circular_links_end(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_album(tmp_path / "a", 1)
    (tmp_path / "a" / "up").symlink_to(tmp_path, target_is_directory=True)
    (tmp_path / "self").symlink_to("self", target_is_directory=True)
    assert list_names(tmp_path) == ["a/0.png"]
    assert "left out: a/up (a link to a folder that contains it)" in caplog.text


def test_one_line_names_what_is_left_out(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write_album(tmp_path, 1)
    (tmp_path / "._0.png").write_bytes(b"\x00\x05\x16\x07")
    for number in range(5):
        (tmp_path / f"{number}.HEIC").write_bytes(b"x")
    (tmp_path / "absent.png").symlink_to("nowhere.png")
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "line\nbreak.gif").write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("no photograph")
    assert list_names(tmp_path) == list_names(tmp_path) == ["0.png"]
    (record,) = caplog.records
    assert record.levelno == logging.WARNING
    assert record.getMessage() == f"--images {tmp_path}: left out: " + "; ".join(
        [
            "'line\\nbreak.gif' (GIF is not read; convert it to PNG or JPEG)",
            "0.HEIC, 1.HEIC, 2.HEIC, 2 more (HEIC is not read; convert it to PNG or JPEG)",
            "._0.png (a resource fork of macOS)",
            "absent.png, pipe.png (no file, or a broken link)",
        ]
    )


def test_complete_folders_are_listed_silently(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    list_names(write_album(tmp_path, 2))
    assert caplog.records == []


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


@pytest.mark.parametrize("orientation", range(10))
@pytest.mark.parametrize("suffix", [".png", ".jpg", ".tif", ".webp"])
def test_orientations_agree_with_pillow(tmp_path: Path, orientation: int, suffix: str) -> None:
    """`upright=False` is the image as stored: COLMAP, hloc and intrinsics refer to it."""
    exif = Image.Exif()
    exif[0x0112] = orientation
    texture = draw_texture(0, (80, 64))
    options = {"lossless": True} if suffix == ".webp" else {"quality": 95} if suffix == ".jpg" else {}
    path = save(tmp_path / f"a{suffix}", texture, exif=exif, **options)
    upright, _ = photographs.decode(path)
    with Image.open(path) as opened:
        expected = ImageOps.exif_transpose(opened).convert("RGB")
    assert np.array_equal(np.asarray(upright), np.asarray(expected))
    stored, _ = photographs.decode(path, upright=False)
    assert stored.size == (80, 64)
    assert np.abs(np.asarray(stored).astype(int) - np.asarray(texture)).mean() < (5 if suffix == ".jpg" else 0.1)
    if orientation in range(2, 9):
        with pytest.raises(SampleError, match="EXIF rotation"):
            read_upright_size(Source(path.name, path), (80, 64))
    else:
        assert read_upright_size(Source(path.name, path), (80, 64)) == (80, 64)


@pytest.mark.parametrize("rational", [(-1, 0), (0, 0), (1, -1), (-(2**31), -1)])
def test_odd_numbers_in_exif_do_no_harm(tmp_path: Path, rational: tuple[int, int]) -> None:
    pixels = np.zeros((64, 64, 3), np.uint8)
    pixels[:32] = 255  # the top half is white
    for name in ("a.jpg", "a.png", "a.webp"):
        path = save(tmp_path / name, Image.fromarray(pixels), exif=build_exif(6, *rational))
        read = photographs.read(path).pixels
        assert read[:, 200:].min() > 200
        assert read[:, :50].max() < 50


@pytest.mark.parametrize("exif", [b"Exif\0\0", b"Exif\0\0II*\0\xff\xff\xff\xff", b"Exif\0\0garbage", build_exif(6, 1, 1)[:20]])
def test_damaged_exif_does_no_harm(tmp_path: Path, exif: bytes) -> None:
    path = save(tmp_path / "a.png", draw_texture(0), exif=exif)
    assert np.array_equal(photographs.read(path).pixels, photographs.crop_square(draw_texture(0), 256))
    assert read_upright_size(Source("a.png", path)) == (80, 64)


def test_first_page_of_a_tiff_file_is_read_with_a_note(tmp_path: Path) -> None:
    first, second = draw_texture(0), draw_texture(1)
    path = save(tmp_path / "a.tif", first, save_all=True, append_images=[second])
    found = photographs.read(path)
    assert np.array_equal(found.pixels, photographs.crop_square(first, 256))
    assert found.notes == ("a.tif: 2 pages, of which the first is read",)


@pytest.mark.parametrize("values", [np.linspace(0, 1, 4096), np.full(4096, -1.0)])
def test_values_without_a_range_are_refused(tmp_path: Path, values: np.ndarray) -> None:
    """A photograph between 0 and 1 would otherwise be black."""
    floats = Image.fromarray(values.reshape(64, 64).astype(np.float32))
    with pytest.raises(SampleError, match=r"floats\.tif: its pixels are floating-point numbers of no defined range"):
        photographs.read(save(tmp_path / "floats.tif", floats))
    whole = Image.fromarray((values * 100_000).reshape(64, 64).astype(np.int32))
    with pytest.raises(SampleError, match=r"whole\.tif: its pixels are not between 0 and 65535"):
        photographs.read(save(tmp_path / "whole.tif", whole))


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
    names.write_text("1.png\n3.png\n", encoding="utf-8-sig")
    assert [source.name for source in photographs.split_validation(sources, names)[1]] == ["1.png", "3.png"]
    names.write_bytes(b"caf\xe9.png")
    with pytest.raises(UserError, match="not a text file"):
        photographs.split_validation(sources, names)
    names.write_text("absent.png")
    with pytest.raises(UserError, match="names none"):
        photographs.split_validation(sources, names)
    with pytest.raises(UserError, match="no such folder or file"):
        photographs.split_validation(sources, tmp_path / "absent")


# ---- great JPEG files


def test_jpeg_files_above_the_bound_are_decoded_at_half_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The square changes by less than JPEG's own loss. At the bound and in other formats, no pixel changes."""
    picture = draw_texture(0, (1201, 900))
    for name in ("a.jpg", "a.png"):
        picture.save(tmp_path / name)
    before = {name: photographs.read(tmp_path / name) for name in ("a.jpg", "a.png")}
    monkeypatch.setattr(photographs, "MAX_WHOLE", 1201 * 900)
    assert np.array_equal(photographs.read(tmp_path / "a.jpg").pixels, before["a.jpg"].pixels)
    monkeypatch.setattr(photographs, "MAX_WHOLE", 1201 * 900 - 1)
    halved = photographs.read(tmp_path / "a.jpg")
    assert halved.notes == ("a.jpg: 1201 x 900 pixels, decoded at half size",)
    assert photographs.decode(tmp_path / "a.jpg")[0].size == (601, 450)
    change = np.abs(halved.pixels.astype(int) - before["a.jpg"].pixels)
    assert change.any()
    assert change.mean() < np.abs(before["a.png"].pixels.astype(int) - before["a.jpg"].pixels).mean()
    assert photographs.decode(tmp_path / "a.jpg", whole=True)[0].size == (1201, 900)
    assert np.array_equal(photographs.read(tmp_path / "a.png").pixels, before["a.png"].pixels)
    assert photographs.read(tmp_path / "a.png").notes == ()
    exif = Image.Exif()
    exif[0x0112] = 6
    picture.save(tmp_path / "turned.jpg", exif=exif)
    assert photographs.decode(tmp_path / "turned.jpg")[0].size == (450, 601)


MEASURE = """import re, sys
from bench.images import photographs
photographs.MAX_WHOLE *= int(sys.argv[2])
photographs.read(photographs.Path(sys.argv[1]))
print(int(re.search(r"VmHWM:\\s*(\\d+)", open("/proc/self/status").read())[1]) // 1024)  # ru_maxrss includes the parent process
"""


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="the peak of memory is read from /proc")
def test_memory_of_a_great_jpeg_file(tmp_path: Path) -> None:
    Image.new("RGB", (12_000, 9_000), "gray").save(tmp_path / "a.jpg")
    command = [sys.executable, "-W", "ignore", "-c", MEASURE, str(tmp_path / "a.jpg")]
    halved, whole = (int(subprocess.check_output([*command, factor])) for factor in ("1", "2"))
    assert halved < 600 < whole  # megabytes; the second is the negative control
