"""torchvision's datasets as photographs, in the layouts of the downloads, and the error for each mistake."""

import hashlib
import json
import pickle
import shutil
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import draw_texture, write_album
from PIL import Image

from bench import cli
from bench.core.errors import SampleError, UserError
from bench.images import photographs, torchvision_datasets
from bench.images.photographs import Source, list_photographs, split_validation

datasets = pytest.importorskip(
    "torchvision.datasets", reason="torchvision is not installed (pip install 'feature-privacy-bench[torchvision]')"
)


@pytest.fixture(autouse=True)
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail at any download."""
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: pytest.fail("a download"))


def read(text: str) -> list[Source]:
    return list_photographs(Path(text))


def write_places365(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Write the layout of Places365's validation set, with the checksums of our own lists."""
    write_album(root / "val_large", 3)
    names = sorted(path.name for path in (root / "val_large").iterdir())
    for constant, key, file, lines in (
        ("_CATEGORIES_META", None, "categories_places365.txt", ["/a/airfield 0", "/b/beach 1"]),
        ("_FILE_LIST_META", "val", "places365_val.txt", [f"{name} {number % 2}" for number, name in enumerate(names)]),
    ):
        (root / file).write_text("\n".join(lines))
        meta = (file, hashlib.md5((root / file).read_bytes()).hexdigest())
        monkeypatch.setattr(datasets.Places365, constant, meta if key is None else {key: meta})
    return f"torchvision:Places365,root={root},split=val"


def write_caltech(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    for category in ("BACKGROUND_Google", "anchor", "ant"):
        folder = root / "caltech101" / "101_ObjectCategories" / category
        folder.mkdir(parents=True)
        for number in (1, 2):
            draw_texture(number).save(folder / f"image_{number:04d}.jpg")
    return f"torchvision:Caltech101,root={root}"


def write_flickr(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    write_album(root, 3)
    names = sorted(path.name for path in root.iterdir())
    (root / "captions.tsv").write_text("".join(f"{name}#{k}\ta caption\n" for name in names for k in range(5)))
    return f"torchvision:Flickr30k,root={root},ann_file={root / 'captions.tsv'}"


def write_people(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    folder = root / "lfw-py"
    for person, count in (("Ann_A", 2), ("Bob_B", 1)):
        (folder / "lfw_funneled" / person).mkdir(parents=True)
        for number in range(1, count + 1):
            draw_texture(number).save(folder / "lfw_funneled" / person / f"{person}_{number:04d}.jpg")
    (folder / "lfw-names.txt").write_text("Ann_A\t2\nBob_B\t1\n")
    (folder / "peopleDevTrain.txt").write_text("2\nAnn_A\t2\nBob_B\t1\n")
    monkeypatch.setattr(datasets.LFWPeople, "_check_integrity", lambda self: True)  # of the archive
    return f"torchvision:LFWPeople,root={root},split=train"


def write_folders(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    for name in ("cats", "dogs"):
        write_album(root / name, 2)
    return f"torchvision:ImageFolder,root={root}"


def write_coco(root: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    pytest.importorskip("pycocotools", reason="pycocotools is not installed, which torchvision's CocoDetection needs")
    write_album(root, 3)
    images = [{"id": number, "file_name": f"{number}.png", "width": 80, "height": 64} for number in (2, 0, 1)]
    (root / "instances.json").write_text(json.dumps({"images": images, "annotations": [], "categories": []}))
    return f"torchvision:CocoDetection,root={root},annFile={root / 'instances.json'}"


LAYOUTS = {"Places365": write_places365, "Caltech101": write_caltech, "Flickr30k": write_flickr, "LFWPeople": write_people}
LAYOUTS |= {"ImageFolder": write_folders, "CocoDetection": write_coco}
COUNTS = {"Places365": 3, "Caltech101": 4, "Flickr30k": 3, "LFWPeople": 3, "ImageFolder": 4, "CocoDetection": 3}


@pytest.mark.parametrize("name", LAYOUTS)
def test_files_of_a_dataset_equal_those_of_its_folder(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = LAYOUTS[name](tmp_path, monkeypatch)
    found = read(text)
    assert len(found) == COUNTS[name]
    assert found == sorted(found, key=lambda source: source.name)
    in_folder = {source.name: source for source in list_photographs(tmp_path)}
    assert all(source == in_folder[source.name] for source in found)
    options = dict(part.split("=") for part in text.split(",")[1:])
    dataset = getattr(datasets, name)(**options)
    theirs = sorted(np.asarray(dataset[index][0].convert("RGB")).tobytes() for index in range(len(dataset)))
    assert sorted(np.asarray(photographs.decode(source)[0]).tobytes() for source in found) == theirs


def test_listing_decodes_no_image(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = write_folders(tmp_path, monkeypatch)
    monkeypatch.setattr(Image.Image, "convert", lambda *_: pytest.fail("decoded"))
    original = Image.open
    assert len(read(text)) == 4
    assert Image.open is original


def test_images_without_files_are_read_by_index() -> None:
    found = read("torchvision:FakeData,size=12")
    expected = datasets.FakeData(size=12)
    assert [source.name for source in found] == [f"{index:02d}" for index in range(12)]
    for index in (0, 11):
        assert np.array_equal(np.asarray(photographs.decode(found[index])[0]), np.asarray(expected[index][0]))
    hashes = [source.content_hash() for source in found]
    assert len(set(hashes)) == 12
    assert hashes == [source.content_hash() for source in read("torchvision:FakeData,size=12")]
    assert hashes[0] != read("torchvision:FakeData,size=12,random_offset=1")[0].content_hash()


def test_images_of_cifar_are_read_by_index(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "cifar-10-batches-py"
    folder.mkdir()
    pixels = np.random.default_rng(0).integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    batch = {"data": pixels.transpose(0, 3, 1, 2).reshape(3, -1), "labels": [0, 1, 0]}
    (folder / "test_batch").write_bytes(pickle.dumps(batch))
    (folder / "batches.meta").write_bytes(pickle.dumps({"label_names": ["airplane", "automobile"]}))
    monkeypatch.setattr(datasets.cifar, "check_integrity", lambda *_: True)  # of the archive
    found = read(f"torchvision:CIFAR10,root={tmp_path},train=false")
    assert [source.name for source in found] == ["0", "1", "2"]
    assert np.array_equal([np.asarray(photographs.decode(source)[0]) for source in found], pixels)


def test_each_class_states_its_arguments() -> None:
    classes = [getattr(datasets, name) for name in datasets.__all__ if torchvision_datasets._is_class(getattr(datasets, name))]
    assert len(classes) > 60
    for plugin in classes:
        assert not {"download", "transform", "target_transform", "loader"} & torchvision_datasets._list_arguments(plugin).keys()
    assert torchvision_datasets._list_arguments(datasets.Places365) == {"root": str, "split": str, "small": bool}


def test_validation_can_be_another_split(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    text = write_folders(tmp_path, monkeypatch)
    _, validation = split_validation(list_photographs(write_album(tmp_path / "album")), Path(text))
    assert [source.name for source in validation] == [source.name for source in read(text)]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("torchvision:Places356,root={root}", "unknown dataset of torchvision 'Places356'; did you mean 'Places365'"),
        ("torchvision:Places365,root={root}/absent,split=val", "absent: no such folder"),
        ("torchvision:Places365,split=val", "torchvision:Places365 needs root: write torchvision:Places365,root=..."),
        ("torchvision:Places365,root={root},slit=val", "unknown field of torchvision:Places365 'slit'; did you mean 'split'"),
        ("torchvision:Places365,root={root},split", "'split' is not field=value"),
        ("torchvision:Places365,root={root},root={root}", "root is given twice"),
        ("torchvision:Places365,root={root},split=vall", "vall"),
        ("torchvision:Places365,root={root},small=perhaps", "small must be true or false, not 'perhaps'"),
        ("torchvision:Places365,root={root},split=val,download=true", "download: nothing is downloaded here"),
        ("torchvision:Places365,root={root},loader=x", "unknown field of torchvision:Places365 'loader'"),
        ("torchvision:Places365,root={root},split=val", "categories_places365.txt does not exist or is corrupted."),
        ("torchvision:Flickr30k,root={root},ann_file={root}/none.tsv", "none.tsv"),
        ("torchvision:FakeData,size=0", "the dataset is empty"),
        ("torchvision:", "unknown dataset of torchvision ''"),
    ],
)
def test_mistakes_are_one_line(text: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    text = text.format(root=tmp_path)
    status = cli.main(["run", "--defense", "none", "--attack", "blank", "--images", text, "--out", str(tmp_path / "out")])
    shown = capsys.readouterr().err
    assert (status, shown.count("\n")) == (2, 1)
    assert message in shown
    assert "download=True" not in shown
    assert not (tmp_path / "out").exists()


@pytest.mark.skipif("MovingMNIST" not in datasets.__all__, reason="this torchvision does not list MovingMNIST in __all__")
def test_items_that_are_no_images(tmp_path: Path) -> None:
    folder = tmp_path / "MovingMNIST"
    folder.mkdir()
    np.save(folder / "mnist_test_seq.npy", np.zeros((20, 2, 64, 64), np.uint8))
    with pytest.raises(UserError, match="its items begin with Tensor, not with an image"):
        read(f"torchvision:MovingMNIST,root={tmp_path}")


def test_later_item_that_is_no_image_is_a_failed_sample(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "torchvision:FakeData,size=3"
    found = read(text)
    original = datasets.FakeData.__getitem__
    monkeypatch.setattr(datasets.FakeData, "__getitem__", lambda self, index: (None, 0) if index else original(self, index))
    photographs.decode(found[0])
    with pytest.raises(SampleError, match="image 2 of torchvision:FakeData,size=3: not an image"):
        photographs.decode(found[2])


def test_missing_files_are_left_out_with_a_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    text = write_places365(tmp_path, monkeypatch)
    first = read(text)[0]
    first.path.unlink()
    assert len(read(text)) == 2
    assert "left out: 1 of 3 files do not exist" in caplog.text
    shutil.rmtree(tmp_path / "val_large")
    with pytest.raises(UserError, match=r"none of its 3 files exists, such as .*val_large"):
        read(text)


def test_missing_package_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pycocotools.coco", None)  # its import raises ImportError
    with pytest.raises(UserError, match=r"pycocotools.*; install the package"):
        read(f"torchvision:CocoDetection,root={tmp_path},annFile={tmp_path / 'a.json'}")


def test_missing_torchvision_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torchvision", None)
    with pytest.raises(UserError, match=r"torchvision is not installed; pip install 'feature-privacy-bench\[torchvision\]'"):
        read("torchvision:FakeData,size=4")


@pytest.mark.slow
def test_run_names_the_dataset_and_not_its_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pandas as pd

    text, results = write_places365(tmp_path / "places", monkeypatch), {}
    for name, images in (("dataset", text), ("folder", str(tmp_path / "places"))):
        command = ["run", "--defense", "none", "--attack", "blank", "--images", images, "--out", str(tmp_path / name)]
        assert cli.main(command) == 0
        results[name] = pd.read_json(tmp_path / name / "records.jsonl", lines=True)
    assert {each["name"] for each in results["dataset"]["dataset"]} == {"Places365-val"}
    for column in ("sample", "metrics", "experiment_id"):
        assert results["dataset"][column].tolist() == results["folder"][column].tolist()


@pytest.mark.slow
@pytest.mark.parametrize("options", [(), pytest.param(("--workers", "2"), marks=pytest.mark.exhaustive)])
def test_run_and_export_of_images_without_files(options: tuple[str, ...], tmp_path: Path) -> None:
    images = ("--images", "torchvision:FakeData,size=3")
    run: list[Any] = ["run", "--defense", "none", "--attack", "blank", *images, *options, "--out", tmp_path / "run"]
    assert cli.main([str(word) for word in run]) == 0
    for layout, extra, status in (("hloc", (), 0), ("hloc", ("--full-images",), 2), ("colmap", (), 2)):
        out = str(tmp_path / f"{layout}{len(extra)}")
        assert cli.main(["export", *images, "--layout", layout, *extra, "--out", out]) == status
