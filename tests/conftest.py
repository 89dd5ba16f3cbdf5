"""Fixtures that several tests share."""

from pathlib import Path

import numpy as np
import pytest

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20231002)


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The photographs that the project is tuned and measured on, where they are; they are no part of it."""
    if not SHARED.is_dir():
        pytest.skip("needs ../shared/data, which is not here")
    return SHARED
