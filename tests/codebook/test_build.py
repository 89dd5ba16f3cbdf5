"""Construction of dictionaries, and errors of damaged ones."""

import numpy as np
import pytest
from fakes import build_exif, draw_texture
from PIL import ExifTags, Image
from safetensors.numpy import save_file

from bench.cli import main
from bench.codebook import build, dictionary
from bench.core.errors import UserError
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.geometry.nearest_words import unit_rows
from bench.images import photographs


@pytest.fixture(scope="module")
def album(tmp_path_factory):
    """A folder with three of the built-in photographs."""
    folder = tmp_path_factory.mktemp("album")
    for source in photographs.list_builtin()[:3]:
        (folder / source.path.name).write_bytes(source.path.read_bytes())
    return folder


@pytest.fixture(scope="module")
def dictionary_file(album, tmp_path_factory):
    return build.build(album, 500, tmp_path_factory.mktemp("k") / "K.safetensors", Sift(), seed=3)


@pytest.mark.slow
def test_words_are_distinct_and_near_the_descriptors(dictionary_file, album):
    assert dictionary_file.words.shape == (500, 128)
    assert dictionary_file.words.dtype == np.uint8
    assert len(np.unique(dictionary_file.words, axis=0)) == 500
    assert len(dictionary_file.photographs) == 3
    # Words drawn from the descriptors at random are the obvious alternative to clustering.
    seen = np.concatenate([Sift().extract(photographs.read(path).pixels).codes for path in sorted(album.iterdir())])
    drawn = seen[np.random.default_rng(0).choice(len(seen), 500, replace=False)]
    assert build.mean_cosine(seen, dictionary_file.words) > build.mean_cosine(seen[500:], drawn) + 0.005


@pytest.mark.slow
def test_the_same_seed_gives_the_same_file(dictionary_file, album, tmp_path):
    again = build.build(album, 500, tmp_path / "K.safetensors", Sift(), seed=3)
    other = build.build(album, 500, tmp_path / "L.safetensors", Sift(), seed=4)
    assert again.digest == dictionary_file.digest != other.digest


@pytest.mark.slow
def test_words_are_in_random_order(dictionary_file):
    """Adjacent words in the file are as distant as any two words."""
    rows = unit_rows(dictionary_file.words)
    cosines = rows @ rows.T
    assert abs(np.diagonal(cosines, 1).mean() - cosines[np.triu_indices(500, 1)].mean()) < 0.03


def test_signed_descriptors_give_signed_words(tmp_path):
    rng = np.random.default_rng(0)
    centres = unit_rows(rng.normal(size=(20, 64)).astype(np.float32))
    rows = unit_rows(centres[rng.integers(20, size=2000)] + rng.normal(0, 0.02, (2000, 64)).astype(np.float32))
    codes = dictionary.round_rows(rows, np.dtype(np.int8))
    words = build.cluster(codes, 64, np.random.default_rng(1))
    assert words.dtype == np.int8
    assert len(np.unique(words, axis=0)) == 64
    assert build.mean_cosine(codes, words) > 0.98 > build.mean_cosine(codes, words[:4])
    stored = dictionary.save(tmp_path / "K.safetensors", words, {"photographs": []})
    loaded = dictionary.load(tmp_path / "K.safetensors")
    assert np.array_equal(loaded.words, words)
    assert loaded.digest == stored.digest
    # The nearest words by brute force in float64, of descriptors that were not rounded.
    assert np.array_equal(loaded.index.find_nearest(rows), (rows.astype(float) @ unit_rows(words).astype(float).T).argmax(axis=1))
    assert np.abs(rows - unit_rows(codes)).max() < 1 / dictionary.SIGNED_NORM


def test_dot_products_of_signed_words_are_exact(rng):
    """In float32, in any order of summation: the premise of `Neighbours`."""
    rows = unit_rows(rng.normal(size=(200, 64)).astype(np.float32))
    words = dictionary.round_rows(np.concatenate([rows, np.eye(64, dtype=np.float32)]), np.dtype(np.int8))
    exact = words.astype(np.int64) @ words.T.astype(np.int64)
    for order in (np.arange(64), np.arange(64)[::-1], rng.permutation(64)):
        single = words[:, order].astype(np.float32)
        assert np.array_equal(np.cumsum(single[:, None] * single, axis=2, dtype=np.float32)[..., -1].astype(np.int64), exact)
    longer = (words.astype(np.int64) * 129).astype(np.float32)  # negative control
    assert not np.array_equal((longer @ longer.T).astype(np.int64), 129**2 * exact)


def test_sub_databases_partition_the_words(dictionary_file):
    parts = [dictionary_file.sub_database(index, 16) for index in range(16)]
    assert np.array_equal(np.concatenate(parts), dictionary_file.words)
    assert {len(part) for part in parts} <= {31, 32}


@pytest.mark.slow
def test_more_words_than_descriptors(album, tmp_path, capsys):
    out = tmp_path / "K.safetensors"
    assert main(["dictionary", "build", "--images", str(album), "--size", "1000000", "--out", str(out)]) == 2
    assert "fewer words" in capsys.readouterr().err.splitlines()[-1]
    assert not out.exists()


@pytest.mark.slow
def test_from_the_command_line(album, tmp_path, capsys):
    out = tmp_path / "K.safetensors"
    assert main(["dictionary", "build", "--images", str(album), "--size", "64", "--out", str(out)]) == 0
    assert "64 words" in capsys.readouterr().out
    assert len(dictionary.load(out)) == 64
    assert main(["dictionary", "build", "--images", str(album), "--size", "32", "--out", str(out)]) == 2
    assert "exists already" in capsys.readouterr().err.splitlines()[-1]
    assert len(dictionary.load(out)) == 64


def test_odd_numbers_in_exif_leave_no_photograph_out(tmp_path, capsys):
    """The words are those of the upright picture, although the file states a resolution of -1 / 0."""
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6
    words = []
    for name, options in (("whole", {"exif": exif}), ("odd", {"exif": build_exif(6, -1, 0)}), ("turned", {})):
        (tmp_path / name).mkdir()
        draw_texture(0, (80, 64)).save(tmp_path / name / "a.png", **options)
        draw_texture(1, (80, 64)).save(tmp_path / name / "b.png")
        arguments = ["--images", str(tmp_path / name), "--size", "20", "--out", str(tmp_path / f"{name}.safetensors")]
        assert main(["dictionary", "build", *arguments]) == 0
        shown = capsys.readouterr()
        assert "of 2 photographs" in shown.out
        assert "skipped" not in shown.err
        words.append(dictionary.load(tmp_path / f"{name}.safetensors").words)
    assert np.array_equal(words[0], words[1])
    assert not np.array_equal(words[1], words[2])  # the negative control: without the rotation the words are others


def test_flipped_bit_is_detected(dictionary_file, tmp_path):
    path = tmp_path / "K.safetensors"
    dictionary.save(path, dictionary_file.words, dictionary_file.meta)
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(UserError, match="checksum"):
        dictionary.load(path)


def test_changed_metadata_is_detected(dictionary_file, tmp_path):
    path = tmp_path / "K.safetensors"
    save_file(
        {"words": dictionary_file.words},
        path,
        {"kind": "dictionary", "digest": dictionary_file.digest, "meta": '{"photographs": []}'},
    )
    with pytest.raises(UserError, match="checksum"):
        dictionary.load(path)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "not a complete safetensors file"),
        (b"not a dictionary at all", "not a complete safetensors file"),
        (None, "no such file"),
    ],
)
def test_invalid_files(content, message, tmp_path):
    path = tmp_path / "K.safetensors"
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(UserError, match=message):
        dictionary.load(path)


@pytest.mark.parametrize(
    ("words", "kind", "message"),
    [
        (np.ones((4, 128), np.float32), "dictionary", "float32, expected uint8 or int8"),
        (np.ones((4, 64), np.uint8), "dictionary", r"expected \(K, 128\)"),
        (np.ones((4, 64), np.int16), "dictionary", "int16, expected uint8 or int8"),
        (np.ones((4, 0), np.int8), "dictionary", r"expected \(K, D\)"),
        (np.full((4, 1600), -128, np.int8), "dictionary", "a word has norm 5120, expected about 127"),
        (np.ones((4, 128), np.uint8), "inversion-network", "holds inversion-network, not dictionary"),
    ],
)
def test_invalid_content(words, kind, message, tmp_path):
    path = tmp_path / "K.safetensors"
    tensor_file.save(path, kind, {"words": words}, {"photographs": []})
    with pytest.raises(UserError, match=message):
        dictionary.load(path)
