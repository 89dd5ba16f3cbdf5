"""The shipped distractors are what the tool writes."""

from pathlib import Path

import make_distractors
import numpy as np
import pytest

from bench.formats import tensor_file
from bench.identification.distractors import FILE, KIND, load_distractors


def test_the_draw_is_that_of_the_shipped_file_and_leaves_out_both_lists(shared_data: Path) -> None:
    names = make_distractors.draw_names(shared_data)
    assert tuple(names) == load_distractors().names
    held_out = {name for split in ("tune.txt", "test.txt") for name in (shared_data / split).read_text().split()}
    assert len(held_out) == 200
    assert not held_out & set(names)


def test_the_attribution_is_that_of_the_shipped_file(shared_data: Path, tmp_path: Path) -> None:
    names = make_distractors.draw_names(shared_data)
    make_distractors.write_attribution(shared_data, names, tmp_path / "distractors.csv")
    assert (tmp_path / "distractors.csv").read_bytes() == FILE.with_suffix(".csv").read_bytes()


@pytest.mark.slow
def test_the_photographs_give_the_shipped_arrays(shared_data: Path, tmp_path: Path) -> None:
    """Decoders of JPEG differ by a level at some pixels, so a thumbnail may differ by one."""
    out = tmp_path / FILE.name
    make_distractors.write_distractors(shared_data, make_distractors.draw_names(shared_data), out)
    (built, meta, _), (shipped, shipped_meta, _) = (tensor_file.load(path, KIND) for path in (out, FILE))
    assert meta == shipped_meta
    assert np.abs(built["thumbnails"].astype(int) - shipped["thumbnails"]).max() <= 1
    np.testing.assert_allclose(built["colours"], shipped["colours"], atol=1e-3)


def test_similar_photographs_are_refused(shared_data: Path, tmp_path: Path) -> None:
    """Negative control: one photograph twice."""
    name = make_distractors.draw_names(shared_data)[0]
    with pytest.raises(SystemExit, match="too similar"):
        make_distractors.write_distractors(shared_data, [name, name], tmp_path / FILE.name)


@pytest.mark.parametrize(("text", "expected"), [(r"Adri\303\241n", "Adrián"), ("A &amp; B", "A & B"), (r"a\b", r"a\b")])
def test_escapes(text: str, expected: str) -> None:
    assert make_distractors.decode_escapes(text) == expected
