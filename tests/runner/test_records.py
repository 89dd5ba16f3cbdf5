"""Records: reading of written records, and repair of files after a crash."""

import json
import logging
import math
from pathlib import Path
from typing import Any

import pytest

import bench
from bench.core.errors import UserError
from bench.runner import records
from bench.runner.records import Log, read

SCHEMA_1 = Path(__file__).resolve().parents[1] / "data" / "records-schema-1.jsonl"  # written by version 0.1


def record(sample: str, **more: Any) -> dict[str, Any]:
    metrics = {"ssim": 0.1 + 0.2}
    entries = {"schema": 2, "run_hash": "r", "experiment_id": "c", "sample": sample, "status": "ok", "metrics": metrics, **more}
    return records.seal(entries)


def write(path: Path, *found: dict[str, Any]) -> Path:
    with Log(path) as log:
        for one in found:
            log.append(one)
    return path


def test_records_are_read_in_full_precision(tmp_path: Path) -> None:
    path = write(tmp_path / "deep" / "records.jsonl", record("a"), record("b"))
    assert read(path).records == [record("a"), record("b")]
    assert read(path).records[0]["metrics"]["ssim"] == 0.1 + 0.2
    assert read(path).notice is None


def test_records_are_written_as_soon_as_they_are_appended(tmp_path: Path) -> None:
    with Log(tmp_path / "r") as log:
        log.append(record("a"))
        assert len(read(tmp_path / "r").records) == 1


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_no_record_holds_nan_or_infinity(tmp_path: Path, value: float) -> None:
    with Log(tmp_path / "r") as log, pytest.raises(ValueError, match="JSON compliant"):
        log.append(record("a") | {"seconds": value})
    assert (tmp_path / "r").read_bytes() == b""


@pytest.mark.parametrize("cut", [1, 5, 40])
def test_line_cut_off_by_a_crash_is_removed(tmp_path: Path, cut: int) -> None:
    path = write(tmp_path / "r", record("a"), record("b"))
    path.write_bytes(path.read_bytes()[:-cut])
    assert [one["sample"] for one in read(path).records] == ["a"]
    assert "cut off" in (read(path).notice or "")
    write(path, record("c"))
    assert [one["sample"] for one in read(path).records] == ["a", "c"]
    assert read(path).notice is None


@pytest.mark.parametrize("line", [b"{nonsense", b"[]", b'{"schema": 99}', b"\xff\xfe"])
def test_other_corrupt_lines_are_named(tmp_path: Path, line: bytes) -> None:
    path = write(tmp_path / "r", record("a"))
    path.write_bytes(path.read_bytes() + line + b"\n" + json.dumps(record("b")).encode() + b"\n")
    with pytest.raises(UserError, match="r, line 2: "):
        read(path)
    before = path.read_bytes()
    with pytest.raises(UserError, match="line 2"):
        Log(path)
    assert path.read_bytes() == before


@pytest.mark.slow
def test_every_flipped_bit_is_found(tmp_path: Path) -> None:
    path = write(tmp_path / "r", record("a", metrics={"ssim": 0.58, "psnr": None}))
    whole = path.read_bytes()
    for position in range(len(whole) - 1):  # the last byte ends the line
        for bit in range(8):
            flipped = bytearray(whole)
            flipped[position] ^= 1 << bit
            path.write_bytes(flipped)
            if flipped[position] == ord("\n"):
                continue  # two lines, and neither is JSON
            with pytest.raises(UserError, match="line"):
                read(path)


def test_records_of_schema_1_are_read_under_their_new_names() -> None:
    old = [json.loads(line) for line in SCHEMA_1.read_text().splitlines()]
    new = read(SCHEMA_1).records
    assert [one["unit"] for one in old] == [one["sample"] for one in new]
    assert [one["metrics"] for one in old] == [one["metrics"] for one in new]
    assert all(one["schema"] == records.SCHEMA and "unit" not in one for one in new)
    assert [one["cell_id"] for one in old] == [one["cell_id"] for one in new]
    assert all(records.explain_invalid(one) is None for one in new)
    assert len({one["experiment_id"] for one in new}) == len({one["cell_id"] for one in old})


@pytest.mark.parametrize(
    ("old", "new"), [('"epsilon": 16.0', '"epsilon": 6.0'), ('"seed": 0', '"seed": 3'), ('"numpy": "2', '"numpy": "1')]
)
def test_a_changed_configuration_of_schema_1_is_found(tmp_path: Path, old: str, new: str) -> None:
    lines = SCHEMA_1.read_text().splitlines(keepends=True)
    number, line = next((number, line) for number, line in enumerate(lines) if old in line)
    lines[number] = line.replace(old, new, 1)
    (tmp_path / "r").write_text("".join(lines))
    with pytest.raises(UserError, match=rf"line {number + 1}: (cell_id|run_hash)"):
        read(tmp_path / "r")


def test_a_file_of_schema_1_is_resumed(tmp_path: Path) -> None:
    path = tmp_path / "records.jsonl"
    path.write_bytes(SCHEMA_1.read_bytes())
    before = len(read(path).records)
    write(path, record("new"))
    assert [one["sample"] for one in read(path).records[before:]] == ["new"]


def test_file_that_cannot_be_written_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(UserError, match="cannot write"):
        Log(tmp_path / "file" / "records.jsonl")


def test_full_disk_loses_no_written_record() -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("this system has no /dev/full")
    log = Log.__new__(Log)
    log._file = full.open("ab", buffering=0)
    with pytest.raises(OSError, match="No space left"):
        log.append(record("a"))


def test_dataframe_has_flat_columns_and_the_latest_records(tmp_path: Path) -> None:
    old = record("a", status="failed", defense={"name": "ldp", "epsilon": "inf"})
    new = record("a", defense={"name": "ldp", "epsilon": "inf"})
    write(tmp_path / "records.jsonl", old, record("b", metrics={"psnr": None}), new)
    frame = bench.load_records(tmp_path)
    assert len(frame) == 2
    assert list(frame.set_index("sample")["status"]) == ["ok", "ok"]
    assert frame.set_index("sample").loc["a", "defense.epsilon"] == math.inf
    assert frame.set_index("sample").loc["a", "metrics.ssim"] == 0.1 + 0.2


def test_dataframe_without_records(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no such file"):
        bench.load_records(tmp_path / "absent")
    assert bench.load_records(write(tmp_path / "records.jsonl")).empty


def test_a_lost_line_is_reported(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = write(tmp_path / "records.jsonl", record("a"))
    path.write_bytes(path.read_bytes() + b'{"sch')
    with caplog.at_level(logging.WARNING):
        assert len(bench.load_records(path)) == 1
    assert "cut off" in caplog.text


def test_experiment_id_does_not_depend_on_the_name_of_the_folder_or_the_order_of_keys() -> None:
    def experiment(**dataset: Any) -> str:
        return records.experiment_id("t", {"name": "ldp", "epsilon": 1.0}, None, dataset, 0, {})

    assert experiment(name="a", hash="1") == experiment(hash="1", name="b")
    assert experiment(hash="1") != experiment(hash="2")
    assert records.run_hash("a", {"torch": "1"}) != records.run_hash("a", {"torch": "2"})
