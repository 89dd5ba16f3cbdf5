"""Small seeded forms of the soak test. `soak.DAMAGE_TESTS` are tests of damaged files; those of load lie beside the code."""

from pathlib import Path

import numpy as np
import pytest
import soak

from bench.cache import store
from bench.codebook.examples import write_dictionary


@pytest.fixture(autouse=True)
def _cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))


def test_flipped_bits_are_found(tmp_path: Path, rng: np.random.Generator) -> None:
    whole = Path(write_dictionary(tmp_path)).read_bytes()
    assert soak.flip_bits(whole, tmp_path / "flipped", soak.read_tensors("dictionary"), 50, rng)[1] == 0


def test_a_reader_without_a_checksum_fails_the_soak_test(tmp_path: Path, rng: np.random.Generator) -> None:
    assert soak.flip_bits(b"0.58", tmp_path / "flipped", Path.read_bytes, 10, rng) == (0, 10)


@pytest.mark.exhaustive
def test_a_killed_run_resumes_with_equal_results(tmp_path: Path) -> None:
    _, trials, _, wrong = soak.kill_and_resume(tmp_path, 1, np.random.default_rng(2))
    assert (trials, wrong) == (1, 0)
    whole = soak.read_run(tmp_path / "whole")
    assert len(whole[0]) == 6
    assert len(whole[1]) == 12  # photographs and reconstructions
    next((tmp_path / "whole").glob("reconstructions/**/*.png")).write_bytes(b"")
    assert soak.read_run(tmp_path / "whole") != whole  # control: the comparison sees a picture


def test_use_of_a_process_is_measured() -> None:
    usage = soak.measure(["python3", "-c", "print(len(b'1' * 200_000_000))"])
    assert usage.output == "200000000\n"
    assert usage.peak > 190
    with pytest.raises(RuntimeError, match="exit status 3"):
        soak.measure(["python3", "-c", "raise SystemExit(3)"])
