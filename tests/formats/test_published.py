"""Published datasets: small archives in the layouts of the downloads, from a server on the loopback interface to readers."""

import dataclasses
import hashlib
import io
import json
import shutil
import tarfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest
from fakes import draw_texture, write_scene
from filelock import FileLock
from loopback import Served, Server, serve

from bench import cli
from bench.core.errors import UserError
from bench.datasets import aachen
from bench.formats import archives, colmap_model, published, scene_export
from bench.formats.published import DATASETS
from bench.images.photographs import list_photographs


def encode(seed: int, suffix: str) -> bytes:
    content = io.BytesIO()
    draw_texture(seed).save(content, {"jpg": "JPEG", "png": "PNG", "ppm": "PPM"}[suffix.lower()])
    return content.getvalue()


def pack_zip(files: Mapping[str, bytes]) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return content.getvalue()


def pack_tar(files: Mapping[str, bytes], mode: str = "w") -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode=mode) as archive:  # type: ignore[call-overload]
        folders = {parent.as_posix() for name in files for parent in Path(name).parents} - {"."}
        for name in sorted(folders):
            folder = tarfile.TarInfo(name)
            folder.type = tarfile.DIRTYPE
            archive.addfile(folder)
        for name, data in files.items():
            member = tarfile.TarInfo(name)
            member.size = len(data)
            archive.addfile(member, io.BytesIO(data))
    return content.getvalue()


def read_files(folder: Path) -> dict[str, bytes]:
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


# ---- the layouts of the downloads


def build_aachen(scratch: Path) -> dict[str, bytes]:
    scene = write_scene(scratch / "original")
    scene_export.write(scene, "aachen", scratch / "v1")
    scene_export.write(scene, "colmap", scratch / "colmap")
    model = {f"3D-models/aachen_v_1_1/{name}": data for name, data in read_files(scratch / "colmap" / "sparse").items()}
    files = read_files(scratch / "v1")
    day, night = (files[f"queries/{when}_time_queries_with_intrinsics.txt"] for when in ("day", "night"))
    images = {name: data for name, data in files.items() if name.startswith("images_upright/")}
    return {
        "database_and_query_images.zip": pack_zip(images),
        "day_time_queries_with_intrinsics.txt": day,
        "night_time_queries_with_intrinsics.txt": night.splitlines(keepends=True)[0],
        "aachen_v1_1.zip": pack_zip(model | {"queries/night_time_queries_with_intrinsics_v1_1.txt": night}),
    }


def build_hpatches(scratch: Path) -> dict[str, bytes]:
    files = {}
    for number, sequence in enumerate(("i_ajuntament", "v_abstract")):
        folder = f"hpatches-sequences-release/{sequence}"
        files |= {f"{folder}/{index}.ppm": encode(10 * number + index, "ppm") for index in range(1, 7)}
        files |= {f"{folder}/H_1_{index}": b"1 0 0\n0 1 0\n0 0 1\n" for index in range(2, 7)}
    return {"hpatches-sequences-release.zip": pack_zip(files)}


def build_south_building(scratch: Path) -> dict[str, bytes]:
    files = {f"south-building/images/P{index}.JPG": encode(index, "jpg") for index in range(4)}
    return {
        "south-building.zip": pack_zip(files | {"south-building/database.db": b"", "south-building/sparse/points3D.txt": b""})
    }


def build_fountain(scratch: Path) -> dict[str, bytes]:
    files = {f"urd/{index:04d}.png": encode(index, "png") for index in range(11)}
    return {"fountain_dense_images.tar.gz": pack_tar(files, "w:gz")}


def build_places365(scratch: Path) -> dict[str, bytes]:
    lists = {"categories_places365.txt": b"/a/airfield 0\n", "places365_val.txt": b"1.jpg 0\n2.jpg 0\n"}
    return {
        "filelist_places365-standard.tar": pack_tar(lists),
        "val_large.tar": pack_tar({f"val_large/{index}.jpg": encode(index, "jpg") for index in (1, 2)}),
    }


LAYOUTS: dict[str, Callable[[Path], dict[str, bytes]]] = {
    "aachen-v1.1": build_aachen,
    "hpatches": build_hpatches,
    "south-building": build_south_building,
    "fountain-p11": build_fountain,
    "places365-val": build_places365,
}


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Server]:
    """The archives of the layouts. Files with a published checksum have that of the small archive, by the same algorithm."""
    catalogue = {}
    with serve() as running:
        for name, build in LAYOUTS.items():
            contents, files = build(tmp_path / "layouts" / name), []
            for file in DATASETS[name].files:
                running.files[file.name] = Served(content := contents[file.name])
                algorithm = (file.checksum or "").partition(":")[0]
                checksum = f"{algorithm}:{hashlib.new(algorithm, content).hexdigest()}" if algorithm else None
                files.append(dataclasses.replace(file, url=running.address + file.name, checksum=checksum))
            catalogue[name] = dataclasses.replace(DATASETS[name], files=tuple(files))
        monkeypatch.setattr(published, "DATASETS", catalogue)
        yield running


def fetch(name: str, folder: Path, unverified: bool = True, **checksums: str) -> list[str]:
    return list(published.fetch(name, folder, checksums, unverified))


def list_checksums(server: Server, name: str) -> dict[str, str]:
    files = published.DATASETS[name].files
    return {file.name: f"sha256:{hashlib.sha256(server.files[file.name].content).hexdigest()}" for file in files}


# ---- from the server to the readers


@pytest.mark.parametrize("name", LAYOUTS)
def test_fetched_datasets_are_unpacked_and_recorded(name: str, server: Server, tmp_path: Path) -> None:
    folder = tmp_path / "to"
    lines = fetch(name, folder)
    record = json.loads((folder / published.RECORD).read_text())
    for line, file in zip(lines, published.DATASETS[name].files, strict=True):
        assert line.startswith(file.name)
        assert ("NOT VERIFIED" in line) == (file.checksum is None)
        assert record["files"][file.url] == {"digest": list_checksums(server, name)[file.name], "verified": file.checksum}
        assert (folder / file.folder / file.name).exists() == (not archives.is_archive(file.name))
    before = read_files(folder)
    server.requests.clear()
    again = fetch(name, folder)
    assert all("fetched before" in line for line in again)
    assert ["NOT VERIFIED" in line for line in again] == ["NOT VERIFIED" in line for line in lines]
    assert (read_files(folder), server.requests) == (before, [])


def test_aachen_is_read(server: Server, tmp_path: Path) -> None:
    fetch("aachen-v1.1", tmp_path / "to")
    scene, original = aachen.load(tmp_path / "to", "v1.1"), write_scene(tmp_path / "again")
    assert {image.name for image in scene.references} == {image.name for image in original.references}
    assert {image.name for image in scene.queries} == {image.name for image in original.queries}
    assert colmap_model.is_model(tmp_path / "to" / "3D-models" / "aachen_v_1_1")


@pytest.mark.parametrize(("name", "folder", "count"), [("hpatches", ".", 12), ("fountain-p11", ".", 11)])
def test_photographs_are_read(name: str, folder: str, count: int, server: Server, tmp_path: Path) -> None:
    fetch(name, tmp_path / "to")
    assert len(list_photographs(tmp_path / "to" / folder)) == count


def test_south_building_is_read(server: Server, tmp_path: Path) -> None:
    fetch("south-building", tmp_path / "to")
    assert "captured:path=DIR/south-building/images," in published.DATASETS["south-building"].usage
    assert len(list_photographs(tmp_path / "to" / "south-building" / "images")) == 4


@pytest.mark.slow
def test_places365_is_read_through_torchvision(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    datasets = pytest.importorskip("torchvision.datasets", reason="torchvision is not installed")
    monkeypatch.setattr(datasets.Places365, "_check_integrity", lambda self, file, *_: Path(file).is_file())  # of our lists
    fetch("places365-val", tmp_path / "to")
    usage = published.DATASETS["places365-val"].usage.removeprefix("--images ").replace("DIR", str(tmp_path / "to"))
    assert [source.name for source in list_photographs(Path(usage))] == ["val_large/1.jpg", "val_large/2.jpg"]


@pytest.mark.slow
def test_checksums_and_addresses_of_places365_are_those_of_torchvision() -> None:
    datasets = pytest.importorskip("torchvision.datasets", reason="torchvision is not installed")
    theirs = {*datasets.Places365._IMAGES_META.values(), *datasets.Places365._DEVKIT_META.values()}
    files = [file for name in DATASETS if name.startswith("places365") for file in DATASETS[name].files]
    assert len(files) == 5
    for file in files:
        assert (file.name, (file.checksum or "").removeprefix("md5:")) in theirs
        assert file.url == datasets.Places365._BASE_URL + file.name


# ---- what goes wrong


def test_unverified_files_need_a_flag_or_a_checksum(server: Server, tmp_path: Path) -> None:
    folder = tmp_path / "to"
    with pytest.raises(UserError, match=r"no checksum is published for hpatches-sequences-release\.zip; give --checksum"):
        fetch("hpatches", folder, unverified=False)
    assert (folder.exists(), server.requests) == (False, [])
    assert "verified by sha256" in fetch("hpatches", folder, unverified=False, **list_checksums(server, "hpatches"))[0]


def test_published_checksums_need_no_flag(server: Server, tmp_path: Path) -> None:
    assert all("verified by md5" in line for line in fetch("places365-val", tmp_path / "to", unverified=False))


@pytest.mark.parametrize("unverified", [True, False])
def test_wrong_checksum_unpacks_nothing(unverified: bool, server: Server, tmp_path: Path) -> None:
    folder = tmp_path / "to"
    with pytest.raises(UserError, match="it was removed"):
        fetch("hpatches", folder, unverified, **{"hpatches-sequences-release.zip": f"sha256:{'0' * 64}"})
    assert set(read_files(folder)) == {published.RECORD, f".{published.RECORD}.lock"}
    assert fetch("hpatches", folder)


def test_checksum_of_an_earlier_download_is_compared(server: Server, tmp_path: Path) -> None:
    folder, checksums = tmp_path / "to", list_checksums(server, "hpatches")
    fetch("hpatches", folder)
    assert fetch("hpatches", folder, **checksums)
    with pytest.raises(UserError, match=r"holds hpatches-sequences-release\.zip of sha256:.*, not sha256:0+; give a new folder"):
        fetch("hpatches", folder, **dict.fromkeys(checksums, f"sha256:{'0' * 64}"))


@pytest.mark.parametrize(
    ("checksums", "message"),
    [
        ({"hpatches.zip": "md5:0"}, "unknown file of hpatches"),
        ({"hpatches-sequences-release.zip": "sha1:0"}, "expected md5: and"),
    ],
)
def test_invalid_checksums(checksums: dict[str, str], message: str, server: Server, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=message):
        fetch("hpatches", tmp_path / "to", **checksums)


def test_folders_with_something_else_are_refused(server: Server, tmp_path: Path) -> None:
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "1.png").write_bytes(b"")
    with pytest.raises(UserError, match="own: holds something else; give a new folder"):
        fetch("hpatches", tmp_path / "own")
    fetch("hpatches", tmp_path / "to")
    with pytest.raises(UserError, match="to: holds hpatches; give a new folder"):
        fetch("south-building", tmp_path / "to")
    (tmp_path / "to" / published.RECORD).write_text("{")
    with pytest.raises(UserError, match="damaged; give a new folder"):
        fetch("hpatches", tmp_path / "to")


def test_one_process_at_a_time_writes_a_folder(server: Server, tmp_path: Path) -> None:
    fetch("hpatches", tmp_path / "to")
    with FileLock(tmp_path / "to" / f".{published.RECORD}.lock"), pytest.raises(UserError, match="another process writes it"):
        fetch("hpatches", tmp_path / "to")


def pack_link(name: str, target: str, kind: bytes = tarfile.SYMTYPE) -> bytes:
    content = io.BytesIO()
    with tarfile.open(fileobj=content, mode="w") as archive:
        archive.addfile(tarfile.TarInfo("before.txt"))
        member = tarfile.TarInfo(name)
        member.type, member.linkname = kind, target
        archive.addfile(member)
    return content.getvalue()


ESCAPES = {
    "parent.zip": pack_zip({"before.txt": b"", "../outside.txt": b""}),
    "deep.zip": pack_zip({"before.txt": b"", "a/../../outside.txt": b""}),
    "absolute.zip": pack_zip({"before.txt": b"", "/outside.txt": b""}),
    "parent.tar": pack_tar({"before.txt": b"", "../outside.txt": b""}),
    "absolute.tar.gz": pack_tar({"before.txt": b"", "/outside.txt": b""}, "w:gz"),
    "link.tar": pack_link("link", ".."),
    "hard.tar": pack_link("link", "../outside.txt", tarfile.LNKTYPE),
    "device.tar": pack_link("device", "", tarfile.CHRTYPE),
}


@pytest.mark.parametrize("name", ESCAPES)
def test_names_that_leave_the_folder_unpack_nothing(name: str, tmp_path: Path) -> None:
    (tmp_path / name).write_bytes(ESCAPES[name])
    folder = tmp_path / "to"
    folder.mkdir()
    with pytest.raises(UserError, match=r"(without '\.\.'|a link or a device).*; nothing was unpacked"):
        archives.unpack(tmp_path / name, folder)
    assert not list(folder.iterdir())
    assert {path.name for path in tmp_path.iterdir()} == {name, "to"}


def test_ordinary_names_are_unpacked(tmp_path: Path) -> None:
    files = {"before.txt": b"a", "a..b/c.txt": b"b"}
    for name, content in (("x.zip", pack_zip(files)), ("x.tar", pack_tar(files)), ("x.tar.gz", pack_tar(files, "w:gz"))):
        (tmp_path / name).write_bytes(content)
        (folder := tmp_path / f"{name}-files").mkdir()
        assert archives.unpack(tmp_path / name, folder) == 2
        assert read_files(folder) == files


@pytest.mark.parametrize("name", ["hpatches.zip", "hpatches.tar", "hpatches.tar.gz"])
@pytest.mark.parametrize("damage", ["end", "middle", "empty"])
def test_damaged_archives_are_named(name: str, damage: str, tmp_path: Path) -> None:
    files = {f"{index}.png": encode(index, "png") for index in range(4)}
    content = pack_zip(files) if name.endswith("zip") else pack_tar(files, "w:gz" if name.endswith("gz") else "w")
    if damage == "middle" and name.endswith("tar"):
        content = b"\xff" * 512 + content[512:]  # tar has checksums of headers alone
    middle = len(content) // 2
    damaged = {"end": content[:middle], "middle": content[:middle] + bytes(64) + content[middle + 64 :], "empty": b""}[damage]
    (tmp_path / name).write_bytes(damaged)
    (tmp_path / "to").mkdir()
    with pytest.raises(UserError, match="damaged"):
        archives.unpack(tmp_path / name, tmp_path / "to")


# ---- the command


def run(*arguments: object) -> int:
    return cli.main(["dataset", "fetch", *map(str, arguments)])


def test_command_lists_and_describes_without_a_download(server: Server, capsys: pytest.CaptureFixture[str]) -> None:
    assert run() == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in LAYOUTS)
    assert run("aachen-v1.1") == 0
    shown = capsys.readouterr()
    assert "licence: CC BY-NC-SA 4.0" in shown.out
    assert "no published checksum" in shown.out
    assert "nothing was downloaded" in shown.err
    assert server.requests == []


def test_command_shows_the_licence_first(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("places365-val", "--to", tmp_path / "to") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[1].startswith("licence: non-commercial")
    assert f"use: --images torchvision:Places365,root={tmp_path / 'to'},split=val" in lines
    assert lines[-1].startswith("val_large.tar: 2 files, verified by md5")


def test_command_resumes(server: Server, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    served = server.files["south-building.zip"]
    served.end = 1000
    command = ("south-building", "--to", tmp_path / "to", "--unverified")
    assert run(*command) == 1
    message = capsys.readouterr().err.splitlines()[-1]
    assert "the connection ended after 1,000 of" in message
    assert "run the same command again" in message
    served.end = None
    assert run(*command) == 0
    assert server.requests[-1][1] == "bytes=1000-"


@pytest.mark.parametrize("fault", [OSError(28, "No space left on device"), KeyboardInterrupt()])
def test_command_continues_after_a_fault_without_a_download(
    fault: BaseException, server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ("hpatches", "--to", tmp_path / "to", "--unverified")
    with monkeypatch.context() as patch:
        patch.setattr(archives.shutil, "copyfileobj", lambda *_: (_ for _ in ()).throw(fault))
        assert run(*command) == (1 if isinstance(fault, OSError) else 130)
    message = capsys.readouterr().err.splitlines()[-1]
    assert str(fault.args[1] if fault.args else "interrupted") in message
    assert "run the same command again" in message
    server.requests.clear()
    assert run(*command) == 0
    assert not server.requests


def test_full_disk_is_found_before_unpacking(server: Server, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "x.zip").write_bytes(pack_zip({"a": bytes(3_000_000)}))
    (folder := tmp_path / "to").mkdir()
    usage = shutil.disk_usage(tmp_path)
    monkeypatch.setattr(shutil, "disk_usage", lambda _: usage._replace(free=2_000_000))
    with pytest.raises(OSError, match="3 MB are needed, 2 MB are free"):
        archives.unpack(tmp_path / "x.zip", folder)
    assert not list(folder.iterdir())


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("hpatchs",), "did you mean 'hpatches'"),
        (("hpatches", "--to", "to"), "accept unverified files with --unverified"),
        (("hpatches", "--to", "to", "--checksum", "hpatches-sequences-release.zip"), "expected md5: and 32"),
    ],
)
def test_mistakes_are_one_line(
    arguments: tuple[str, ...],
    message: str,
    server: Server,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    assert run(*arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.count("\n") == 1
    assert not (tmp_path / "to").exists()


def test_names_are_for_fetch_alone(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["dataset", "gallery", "hpatches", "--layout", "colmap", "--out", "x"]) == 2
    assert "'hpatches' is an unexpected argument" in capsys.readouterr().err
