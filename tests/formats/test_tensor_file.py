"""Files of arrays: damaged ones and those of other programs are refused in one line, whatever is wrong with them."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from effort import EFFORT
from hypothesis import example, given, settings
from hypothesis import strategies as st
from safetensors import safe_open
from safetensors.torch import save_file

from bench.cli import main
from bench.codebook import dictionary
from bench.codebook.public import ASSETS
from bench.context import weights as context_weights
from bench.core.errors import UserError
from bench.formats import tensor_file
from bench.inversion import weights

ARRAYS = {"words": np.arange(1, 65, dtype=np.uint8).reshape(4, 16), "more": np.linspace(0, 1, 5, dtype=np.float32)}
META = {"photographs": ["sha256:0"], "mean_cosine": 0.5}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    tensor_file.save(folder / "whole", "dictionary", ARRAYS, META)
    return folder


def read(path: Path, content: bytes) -> None:
    """Read a file with this content; any error other than UserError is raised, and a UserError has one line."""
    path.write_bytes(content)
    for function in (lambda: tensor_file.verify(path), lambda: tensor_file.load(path, "dictionary")):
        try:
            function()
        except UserError as error:
            message = str(error)
        else:
            message = ""
        assert "\n" not in message


def write_raw(path: Path, header: Any, data: bytes = b"") -> Path:
    """Write a file in the format of safetensors, with any header."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    path.write_bytes(struct.pack("<Q", len(text)) + text + data)
    return path


def test_arrays_and_metadata_return(folder: Path) -> None:
    arrays, meta, digest = tensor_file.load(folder / "whole", "dictionary")
    assert arrays.keys() == ARRAYS.keys()
    assert all(np.array_equal(arrays[name], ARRAYS[name]) and arrays[name].dtype == ARRAYS[name].dtype for name in ARRAYS)
    assert meta == META
    with safe_open(folder / "whole", framework="np") as opened:
        assert opened.metadata()["digest"] == digest


@pytest.mark.exhaustive
def test_every_flipped_bit_of_a_file_is_found(folder: Path) -> None:
    whole, path = (folder / "whole").read_bytes(), folder / "flipped"
    same = 0
    for position in range(len(whole)):
        for bit in range(8):
            flipped = bytearray(whole)
            flipped[position] ^= 1 << bit
            path.write_bytes(flipped)
            try:
                arrays, meta, _ = tensor_file.load(path, "dictionary")
            except UserError:
                continue
            same += 1  # a space of the header became another white space, or the other way round
            assert meta == META
            assert all(np.array_equal(arrays[name], ARRAYS[name]) for name in ARRAYS)
    assert same < 100


@settings(max_examples=300 * EFFORT, deadline=None, derandomize=EFFORT == 1)
@given(cut=st.integers(0, 700), added=st.binary(max_size=16), at=st.integers(0, 700))
def test_any_truncation_and_insertion_is_refused(folder: Path, cut: int, added: bytes, at: int) -> None:
    whole = (folder / "whole").read_bytes()
    read(folder / "changed", (whole[:at] + added + whole[at:])[: len(whole) - cut])


NAMES = st.sampled_from(["words", "__metadata__", "kind", "digest", "meta", "dtype", "shape", "data_offsets", ""])
TYPES = st.sampled_from(["U8", "F32", "BF16", "F8_E4M3", "F8_E5M2", "F4", "C64", "I64", "bool", ""])
HEADERS = st.recursive(
    TYPES | st.none() | st.integers(-2, 2**70) | st.text(max_size=4),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(NAMES, inner, max_size=4),
)
TENSORS = st.fixed_dictionaries({"dtype": TYPES, "shape": st.lists(st.integers(0, 4), max_size=3)}).map(
    lambda entry: (
        entry
        | {"data_offsets": [0, int(np.prod(entry["shape"])) * {"U8": 1, "bool": 1, "I64": 8, "C64": 8}.get(entry["dtype"], 2)]}
    )
)
METADATA = st.dictionaries(
    st.sampled_from(["kind", "digest", "meta"]), st.sampled_from(["dictionary", "{}", "[]", "{oops", "1e999"])
)


@settings(max_examples=300 * EFFORT, deadline=None, derandomize=EFFORT == 1)
@given(
    header=HEADERS | st.fixed_dictionaries({"__metadata__": METADATA, "words": TENSORS}) | st.binary(max_size=30),
    size=st.integers(0, 64),
)
@example(header={"__metadata__": {"kind": "dictionary", "digest": "", "meta": "[" * 100_000}}, size=0)
@example(header=b'{"a":' * 100_000, size=0)
def test_any_header_is_refused_in_one_line(folder: Path, header: Any, size: int) -> None:
    path = write_raw(folder / "raw", header, bytes(size))
    read(path, path.read_bytes())


@pytest.mark.parametrize(
    ("header", "complaint"),
    [
        ({"kind": "dictionary", "digest": "x"}, "has no checksum, so this program did not write it"),
        ({"kind": "dictionary", "digest": "x", "meta": "{oops"}, "its metadata are damaged: not valid JSON"),
        ({"kind": "dictionary", "digest": "x", "meta": "[]"}, "its metadata are not a JSON object"),
        ({"kind": "dictionary", "digest": "x", "meta": "{}"}, "its checksum is sha256:.*, but x was written"),
        ({"kind": "song", "digest": "x", "meta": "{}"}, "holds song, not dictionary"),
        ({}, "holds something else, not dictionary"),
    ],
)
def test_whole_files_of_other_programs_are_refused(tmp_path: Path, header: dict[str, str], complaint: str) -> None:
    words = {"dtype": "U8", "shape": [2, 128], "data_offsets": [0, 256]}
    path = write_raw(tmp_path / "w.safetensors", {"__metadata__": header, "words": words}, bytes(range(256)))
    with pytest.raises(UserError, match=complaint):
        dictionary.load(path)


@pytest.mark.parametrize("dtype", [torch.bfloat16, torch.float8_e4m3fn, torch.float8_e5m2])
def test_types_that_numpy_does_not_know_are_named(tmp_path: Path, dtype: torch.dtype, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "b.safetensors"
    save_file({"words": torch.ones(64, 128).to(dtype)}, path, {"kind": "dictionary", "digest": "x", "meta": "{}"})
    with pytest.raises(UserError, match=r"tensor words has the type (BF16|F8_E4M3|F8_E5M2), which NumPy does not know"):
        dictionary.load(path)
    arguments = ["run", "--defense", f"ldp:dictionary={path}", "--attack", "keypoints", "--out", str(tmp_path / "out")]
    assert main(arguments) == 2
    assert "which NumPy does not know" in capfd.readouterr().err


WORDS = np.arange(1, 257, dtype=np.uint8).reshape(2, 128)


@pytest.mark.parametrize(
    ("words", "meta", "complaint"),
    [
        (WORDS, {}, "its metadata lack the photographs"),
        (WORDS, {"photographs": "all"}, "its metadata lack the photographs"),
        (WORDS, {"photographs": [1]}, "its metadata lack the photographs"),
        (WORDS * np.uint8([[1], [0]]), {"photographs": []}, "word 1 is zero"),
    ],
)
def test_dictionaries_with_a_right_digest_and_wrong_content(
    tmp_path: Path, words: np.ndarray, meta: dict[str, Any], complaint: str
) -> None:
    path = tmp_path / "d.safetensors"
    tensor_file.save(path, dictionary.KIND, {"words": words}, meta)
    with pytest.raises(UserError, match=complaint):
        dictionary.load(path)


SETTINGS = weights.REQUIRED_METADATA[3]  # the name of the supported settings in files


def change(**more: Any) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda meta: {**meta, **more}


@pytest.mark.parametrize(
    "spoil",
    [
        lambda meta: {},
        change(defense="ldp"),
        change(defense={}),
        change(extractor=None),
        change(encoding="secret"),
        change(encoding=[]),
        change(**{SETTINGS: []}),
        change(**{SETTINGS: {"epsilon": 5}}),
        change(**{SETTINGS: {"epsilon": {"between": [1]}}}),
        change(**{SETTINGS: {"epsilon": {"one_of": None}}}),
        change(slots="two"),
        change(shape={}),
        change(shape={"widths": 5}),
        change(shape={"inputs": "many", "widths": [1, 2, 3, 4]}),
        change(shape={"inputs": -5, "widths": []}),
        change(shape=[]),
    ],
)
def test_networks_with_a_right_digest_and_wrong_metadata(tmp_path: Path, spoil: Any) -> None:
    shipped = next(iter(sorted(ASSETS.glob("positions.safetensors"))))
    arrays, meta, _ = tensor_file.load(shipped, weights.KIND)
    path = tmp_path / "w.safetensors"
    tensor_file.save(path, weights.KIND, arrays, spoil(meta))
    with pytest.raises(UserError, match="metadata"):
        weights.load(path).verify()


@pytest.mark.parametrize(
    "meta", [{}, {"shape": []}, {"shape": {"length": "x"}}, {"shape": {"more": 1}}, {"shape": {"width": -1}}]
)
def test_context_networks_with_a_right_digest_and_wrong_metadata(tmp_path: Path, meta: dict[str, Any]) -> None:
    path = tmp_path / "w.safetensors"
    tensor_file.save(path, context_weights.KIND, {"weight": np.zeros(1, np.float32)}, meta)
    with pytest.raises(UserError, match="metadata"):
        context_weights.load(path).verify()
