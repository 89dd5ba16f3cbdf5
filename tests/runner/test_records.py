"""Records: reading of written records, and repair of files after a crash."""

import json
import logging
import math
import re
from pathlib import Path
from typing import Any

import pytest
import record_lines

import bench
from bench import cli
from bench.core.errors import UserError
from bench.runner import directory, records
from bench.runner.records import Log, read

SCHEMA_1 = Path(__file__).resolve().parents[1] / "data" / "records-schema-1.jsonl"  # written by version 0.1


def record(sample: str, **more: Any) -> dict[str, Any]:
    return record_lines.record(sample, **{"metrics": {"ssim": 0.1 + 0.2}, **more})


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
    line = path.read_bytes().removesuffix(b"\n")
    for position in range(len(line)):
        for bit in range(8):
            flipped = bytearray(line)
            flipped[position] ^= 1 << bit
            with pytest.raises(UserError, match="line"):  # noqa: PT012
                for part in flipped.split(b"\n"):  # a flip can give two lines
                    records._parse(path, 1, bytes(part))


RECORD = record("a")
PLUGIN = {"name": "ldp"}
MISSHAPEN: list[Any] = [
    {"schema": 1},
    {"schema": True},
    {"schema": 2},
    [],
    [[]],
    None,
    RECORD | {"environment": None},
    RECORD | {"environment": {}},
    RECORD | {"sample": ["a"]},
    RECORD | {"run_hash": {}},
    RECORD | {"experiment_id": 7},
    RECORD | {"defense": "ldp"},
    RECORD | {"defense": {"epsilon": 1}},
    RECORD | {"attack": PLUGIN | {"inversion": {}}},
    RECORD | {"dataset": None},
    RECORD | {"dataset": {"name": "a", "hash": 1, "extractor": PLUGIN}},
    RECORD | {"dataset": {"name": "a", "hash": "", "extractor": PLUGIN, "spec": []}},
    RECORD | {"seed": True},
    RECORD | {"seed": "0"},
    RECORD | {"status": "good"},
    RECORD | {"status": "failed"},
    RECORD | {"reason": []},
    RECORD | {"metrics": None},
    RECORD | {"metrics": {"ssim": "high"}},
    RECORD | {"metrics": {"ssim": True}},
    RECORD | {"metric_settings": {"ssim": None}},
    RECORD | {"privacy": {}},
    RECORD | {"privacy": RECORD["privacy"] | {"epsilon_descriptor": "much"}},
    RECORD | {"privacy": RECORD["privacy"] | {"uncovered": [1]}},
    RECORD | {"notes": None},
    RECORD | {"notes": [{}]},
    RECORD | {"task_settings": []},
    RECORD | {"condition": 1},
    RECORD | {"estimates": {"pose": [1, 2]}},
    {name: value for name, value in RECORD.items() if name != "notes"},
]
UNREADABLE = [
    b"[" * 100_000,
    b'{"a":' * 100_000,
    json.dumps(RECORD).replace('"schema": 2', '"schema": 2, "deep": ' + "[" * 40 + "]" * 40).encode(),
    json.dumps(RECORD | {"seed": 10**400}).encode(),
    b'{"schema": 2, "seed": ' + b"9" * 5000 + b"}",
    json.dumps(RECORD).replace("0.30000000000000004", "1e999").encode(),
    json.dumps(RECORD).replace("0.30000000000000004", "NaN").encode(),
]


@pytest.mark.parametrize(
    "line",
    [*(json.dumps(records.seal(value) if isinstance(value, dict) else value).encode() for value in MISSHAPEN), *UNREADABLE],
    ids=range(len(MISSHAPEN) + len(UNREADABLE)),
)
def test_lines_that_are_json_but_no_record_are_named_by_every_reader(
    tmp_path: Path, line: bytes, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(tmp_path / "records.jsonl", record("b"))
    path.write_bytes(path.read_bytes() + line + b"\n")
    (tmp_path / directory.PLAN).write_text("[]")
    for arguments in (
        ["leaderboard", "--results", path, "--out", tmp_path / "site"],
        ["check", "--baseline", path, "--results", path],
        ["status", "--results", tmp_path],
        ["budget", "--image-epsilon", "1", "--words", "9", "--results", path],
    ):
        assert cli.main(list(map(str, arguments))) == 2, arguments
        assert "records.jsonl, line 2: " in capsys.readouterr().err
    with pytest.raises(UserError, match="line 2"):
        Log(path)
    assert not (tmp_path / "site").exists()
    assert cli.main(["submit-check", str(path), "--sample", "0"]) == 1
    assert re.search("^line 2: ", capsys.readouterr().out, re.MULTILINE)


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
    old = record("a", status="failed", reason="tired", defense={"name": "ldp", "epsilon": "inf"})
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
