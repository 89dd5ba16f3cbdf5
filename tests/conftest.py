"""Fixtures of several test files."""

import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import write_album

from bench.cache import store
from bench.codebook.examples import write_dictionary
from bench.runner import plan
from bench.settings import Asset
from leaderboard import speed

# Results do not depend on what is installed. Set before suites are imported, which choose their metrics then.
os.environ[plan.VARIABLE] = plan.NO_EXTRAS
SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.hookimpl(optionalhook=True)
def pytest_benchmark_update_machine_info(machine_info: dict[str, Any]) -> None:
    """Name the instruction set, whose reference `bench check` compares the ratios with."""
    machine_info[speed.INSTRUCTION_SET] = speed.name_instruction_set()


@pytest.fixture(scope="session", autouse=True)
def _cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Give the tests a cache folder of their own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(store.VARIABLE, str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20231002)


@pytest.fixture
def images(tmp_path: Path) -> Path:
    """Two small photographs."""
    return write_album(tmp_path / "album")


@pytest.fixture
def small(tmp_path: Path) -> Asset:
    """A dictionary of few words."""
    return write_dictionary(tmp_path)


@pytest.fixture
def no_connections(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Fail at each connection and download, also of weights that torch.hub has in its cache."""
    import torch

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError(f"a connection: {arguments}")

    monkeypatch.setattr(socket, "create_connection", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)
    monkeypatch.setattr(torch.hub, "load_state_dict_from_url", refuse)
    monkeypatch.setattr(torch.hub, "download_url_to_file", refuse)
    monkeypatch.setenv("TORCH_HOME", str(tmp_path / "torch"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The photographs that the project is tuned and measured on. They are no part of it, so tests skip without them."""
    if not SHARED.is_dir():
        pytest.skip("needs ../shared/data, which is not here")
    return SHARED
