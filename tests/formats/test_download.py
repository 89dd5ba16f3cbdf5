"""Downloads from a server on the loopback interface, with the faults of servers, networks and disks."""

import hashlib
import multiprocessing
import re
import shutil
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from loopback import Served, Server, serve

from bench.core import progress
from bench.core.errors import UserError
from bench.formats.download import download

CONTENT = np.random.default_rng(0).bytes(2_500_000)
SHA256, MD5 = (f"{name}:{hashlib.new(name, CONTENT).hexdigest()}" for name in ("sha256", "md5"))


@pytest.fixture
def server() -> Iterator[Server]:
    with serve() as running:
        yield running


def fetch(server: Server, folder: Path, checksum: str | None = SHA256) -> str:
    return download(f"{server.address}file", folder / "file", checksum)


def find_part(folder: Path) -> Path:
    (part,) = folder.glob("file.*.part")
    return part


@pytest.mark.parametrize("checksum", [None, SHA256, MD5])
def test_file_is_verified(server: Server, tmp_path: Path, checksum: str | None) -> None:
    server.files["file"] = Served(CONTENT)
    assert fetch(server, tmp_path, checksum) == SHA256
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
    assert (tmp_path / "file").read_bytes() == CONTENT
    assert fetch(server, tmp_path, checksum) == SHA256
    assert len(server.requests) == 1


@pytest.mark.parametrize("checksum", [f"sha256:{'0' * 64}", f"md5:{'0' * 32}"])
def test_wrong_checksum_removes_the_file(server: Server, tmp_path: Path, checksum: str) -> None:
    server.files["file"] = Served(CONTENT)
    with pytest.raises(UserError, match=r"its (sha256|md5) is .*, expected 0+; it was removed"):
        fetch(server, tmp_path, checksum)
    assert not list(tmp_path.iterdir())


def test_one_flipped_bit_is_found(server: Server, tmp_path: Path) -> None:
    server.files["file"] = Served(CONTENT[:-1] + bytes([CONTENT[-1] ^ 1]))
    with pytest.raises(UserError, match="it was removed"):
        fetch(server, tmp_path)


def test_truncated_download_is_resumed(server: Server, tmp_path: Path) -> None:
    served = server.files["file"] = Served(CONTENT, end=1_200_000)
    with pytest.raises(ConnectionError, match="ended after 1,200,000 of 2,500,000 bytes") as raised:
        fetch(server, tmp_path)
    assert raised.value.filename == f"{server.address}file"
    assert find_part(tmp_path).read_bytes() == CONTENT[:1_200_000]
    served.end = None
    assert fetch(server, tmp_path) == SHA256
    assert server.requests[-1] == ("file", "bytes=1200000-")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_server_without_ranges_starts_again(server: Server, tmp_path: Path) -> None:
    served = server.files["file"] = Served(CONTENT, ranges=False, end=1_200_000)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path)
    served.end = None
    assert fetch(server, tmp_path) == SHA256
    assert [requested for _, requested in server.requests] == [None, "bytes=1200000-"]


@pytest.mark.parametrize("ranges", [True, False])
def test_parts_of_two_versions_are_never_joined(server: Server, tmp_path: Path, ranges: bool) -> None:
    server.files["file"] = Served(bytes(2_000_000), end=1_200_000)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path, None)
    server.files["file"] = Served(CONTENT, ranges=ranges, version='"2"')
    assert fetch(server, tmp_path, None) == SHA256
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_parts_without_versions_are_joined_and_verified(server: Server, tmp_path: Path) -> None:
    server.files["file"] = Served(bytes(2_000_000), end=1_200_000, version=None)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path)
    server.files["file"] = Served(CONTENT, version=None)
    with pytest.raises(UserError, match="it was removed"):  # the checksum finds what the server does not state
        fetch(server, tmp_path)
    assert fetch(server, tmp_path) == SHA256


@pytest.mark.parametrize(("size", "requests"), [(2_500_000, 1), (2_600_000, 2)])
def test_complete_part_is_not_requested_again(server: Server, tmp_path: Path, size: int, requests: int) -> None:
    served = server.files["file"] = Served(CONTENT, end=1)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path)
    served.end = None
    find_part(tmp_path).write_bytes((CONTENT + bytes(100_000))[:size])  # too long: of a file that was longer
    server.requests.clear()
    assert fetch(server, tmp_path) == SHA256
    assert len(server.requests) == requests


def test_unknown_length(server: Server, tmp_path: Path) -> None:
    server.files["file"] = Served(CONTENT, length=False)
    assert fetch(server, tmp_path) == SHA256


def test_errors_of_the_server_are_named(server: Server, tmp_path: Path) -> None:
    with pytest.raises(ConnectionError, match="the server answers 404 Not Found"):
        fetch(server, tmp_path)
    with pytest.raises(ConnectionError, match="cannot be reached"):
        download("http://127.0.0.1:9/file", tmp_path / "file")
    assert not list(tmp_path.iterdir())


def test_full_disk_while_writing(server: Server, tmp_path: Path) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    served = server.files["file"] = Served(CONTENT, end=1)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path)
    served.end = None
    part = find_part(tmp_path)
    part.unlink()
    part.symlink_to(full)
    with pytest.raises(OSError, match="No space left"):
        fetch(server, tmp_path)
    part.unlink()
    assert fetch(server, tmp_path) == SHA256


def test_full_disk_is_found_before_the_download(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    server.files["file"] = Served(CONTENT)
    usage = shutil.disk_usage(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=2_400_000))
        with pytest.raises(OSError, match="2 MB are needed, 2 MB are free"):
            fetch(server, tmp_path)
    assert not list(tmp_path.iterdir())
    assert fetch(server, tmp_path) == SHA256


@pytest.mark.slow
def test_killed_download_is_resumed(server: Server, tmp_path: Path) -> None:
    served = server.files["file"] = Served(CONTENT, end=1_200_000, stall=True)
    arguments = (f"{server.address}file", tmp_path / "file", SHA256)
    process = multiprocessing.get_context("spawn").Process(target=download, args=arguments)
    process.start()
    while not any(path.stat().st_size for path in tmp_path.glob("file.*.part")):
        time.sleep(0.01)
    process.kill()
    process.join()
    assert not (tmp_path / "file").exists()
    received = find_part(tmp_path).stat().st_size  # a kill can cut a write, so not always a whole chunk
    assert 0 < received <= 1_200_000
    served.end, served.stall = None, False
    assert fetch(server, tmp_path) == SHA256
    assert [requested for _, requested in server.requests] == [None, f"bytes={received}-"]


# ---- progress


def list_steps(printed: str) -> list[tuple[int, int]]:
    """Return the numbers of received and of all megabytes that stderr shows, without repetitions."""
    shown = re.findall(r"(\d+)/(\d+)", printed)
    return list(dict.fromkeys((int(done), int(total)) for done, total in shown))


@pytest.mark.parametrize("terminal", [True, False], ids=["terminal", "log"])
def test_progress_is_shown(
    server: Server, tmp_path: Path, terminal: bool, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """Of a resumed download too: it starts at the megabytes that are there."""
    if terminal:
        monkeypatch.setenv("FORCE_COLOR", "1")  # rich takes stderr for a terminal
    else:
        monkeypatch.delenv("FORCE_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setattr(progress, "INTERVAL", -1.0)  # seconds
    served = server.files["file"] = Served(CONTENT, end=1_200_000)
    with pytest.raises(ConnectionError):
        fetch(server, tmp_path)
    interrupted = capfd.readouterr().err
    assert "file, MB" in interrupted
    assert ("━" in interrupted) == terminal  # a bar, or lines
    assert list_steps(interrupted)[-1] == (2, 3)
    served.end = None
    fetch(server, tmp_path)
    resumed = list_steps(capfd.readouterr().err)
    assert resumed[0] in {(0, 3), (1, 3)}
    assert resumed[-1] == (3, 3)
    fetch(server, tmp_path)
    assert capfd.readouterr().err == ""  # negative control: nothing is received


def test_progress_in_a_log_has_intervals(server: Server, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    server.files["file"] = Served(CONTENT)
    fetch(server, tmp_path)
    assert capfd.readouterr().err == ""  # in less than 20 seconds
