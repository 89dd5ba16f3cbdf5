"""Caches: entries are found by the hash of their inputs only, checked, and computed again if damaged."""

import dataclasses
import hashlib
import json
import os
import resource
import struct
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import platformdirs
import pytest
from fake_plugins.guess import Guess
from fake_plugins.sketch import Sketch
from fakes import FAKES, install_plugins, prepare_plan

from attacks.sparsity import Sparsity
from bench import cli
from bench.cache import attack_cache, provenance, store
from bench.codebook.examples import write_dictionary
from bench.codebook.public import ASSETS
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.geometry.nearest_words import WordIndex
from bench.images.photographs import list_photographs
from bench.inversion import network_cache as networks
from bench.inversion import weights
from bench.inversion.data import Target
from bench.inversion.plan import Plan, Training
from bench.runner import execute
from bench.runner.records import Record
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

RECONSTRUCTION = Reconstruction(inverter="sketch")


@pytest.fixture(autouse=True)
def cache_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(attack_cache, "MIN_SECONDS", 0.0)
    return tmp_path / "cache"


@pytest.fixture
def guessed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows with each call of the attack `guess`, which adds a random note."""
    calls: list[int] = []
    recover = Guess.recover

    def count(self: Guess, view: Any, rng: np.random.Generator) -> Any:
        calls.append(len(view.release))
        view.notes.append(f"drew {rng.integers(1000)}")
        return recover(self, view, rng)

    monkeypatch.setattr(Guess, "recover", count)
    return calls


def numbers() -> store.Content:
    return {"numbers": np.arange(1000)}, {"of": "numbers"}


def run(defense: Any, attack: Any, images: Any, task: Reconstruction = RECONSTRUCTION, **more: Any) -> list[Record]:
    return execute.run([defense], [attack], images, task=task, **more)


def without_seconds(records: list[Record]) -> list[Any]:
    return [{key: value for key, value in record.items() if key not in ("seconds", "digest")} for record in records]


def bench(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    return status, out, err


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """Limit the size of files, to simulate a full disk."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# ---- recovered descriptors


@pytest.mark.slow
def test_another_inverter_uses_the_cached_descriptors(images: Path, small: Asset, guessed: list[int]) -> None:
    defense = LDP(epsilon=8, dictionary=small)
    first = run(defense, Guess(), images)
    assert len(guessed) == 2
    assert without_seconds(run(defense, Guess(), images)) == without_seconds(first)
    darker = run(defense, Guess(), images, Reconstruction(inverter="sketch:brightness=0.5"))
    assert len(guessed) == 2
    assert [record["notes"] for record in darker] == [record["notes"] for record in first]
    assert darker[0]["metrics"]["angle"] == first[0]["metrics"]["angle"]
    assert darker[0]["metrics"]["mae"] != first[0]["metrics"]["mae"]


@pytest.mark.slow
def test_cached_results_equal_computed_results(
    images: Path, small: Asset, guessed: list[int], cache_folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The inverter continues with the random state that the attack left."""
    defense = Affine(lifting="random")
    cached = [run(defense, attack, images) for attack in (Guess(), Sparsity(pivots=2)) for _ in range(2)]
    with monkeypatch.context() as without:
        without.setattr(attack_cache, "MIN_SECONDS", np.inf)
        without.setenv(store.VARIABLE, str(cache_folder / "none"))
        computed = [run(defense, attack, images) for attack in (Guess(), Sparsity(pivots=2)) for _ in range(2)]
    assert list(map(without_seconds, cached)) == list(map(without_seconds, computed))
    assert not list((cache_folder / "none").glob("recovered/*"))


@pytest.mark.slow
def test_key_depends_on_everything_that_an_attack_sees(images: Path, tmp_path: Path, guessed: list[int]) -> None:
    def calls(*arguments: Any, **more: Any) -> int:
        before = len(guessed)
        run(*arguments, **more)
        return len(guessed) - before

    one, other = (write_dictionary(tmp_path, seed=seed) for seed in (1, 2))
    defense = LDP(epsilon=8, dictionary=one)
    assert calls(defense, Guess(), images) == 2
    assert calls(defense, Guess(), images) == 0
    assert calls(defense, Guess(), images, seed=1) == 2
    assert calls(dataclasses.replace(defense, epsilon=9), Guess(), images) == 2
    assert calls(dataclasses.replace(defense, dictionary=other), Guess(), images) == 2
    assert calls(defense, Guess(), images, extractor=Sift(max_keypoints=5)) == 2
    assert calls(defense, Guess(), [images / "0.png"]) == 1  # other releases are of other photographs
    assert calls(defense, Guess(), [images / "1.png", images / "0.png"]) == 2  # and in another order


@pytest.mark.slow
def test_cached_seconds_are_those_of_the_attack(images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    recover = Guess.recover

    def slow(self: Guess, view: Any, rng: Any) -> Any:
        time.sleep(0.5)
        return recover(self, view, rng)

    monkeypatch.setattr(Guess, "recover", slow)
    for _ in range(2):
        assert run(LDP(dictionary=small), Guess(), [images / "0.png"])[0]["seconds"] > 0.5


def test_fast_attacks_are_not_cached(images: Path, small: Asset, cache_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack_cache, "MIN_SECONDS", np.inf)
    run(LDP(dictionary=small), Guess(), images)
    assert {entry.kind for entry in store.list_entries()} - {"faces"} == {"words"}  # faces may be in the memory of this process


def test_cached_content_is_used(images: Path, small: Asset) -> None:
    """Control: another content changes the records."""
    first = run(LDP(dictionary=small), Guess(), images)
    for entry in store.list_entries():
        if entry.kind == "recovered":
            overwrite_with_one_direction(entry.path)
    assert run(LDP(dictionary=small), Guess(), images)[0]["metrics"]["angle"] != first[0]["metrics"]["angle"]


def overwrite_with_one_direction(file: Path) -> None:
    arrays, meta, _ = tensor_file.load(file, "recovered")
    direction = np.zeros_like(arrays["descriptors"])
    direction[:, 0] = 1
    tensor_file.save(file, "recovered", arrays | {"descriptors": direction}, meta)


# ---- words, networks


@pytest.mark.slow
def test_words_are_searched_once_for_all_settings(images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []
    nearest = WordIndex.find_nearest

    def count(self: WordIndex, rows: Any) -> Any:
        searched.append(len(rows))
        return nearest(self, rows)

    monkeypatch.setattr(WordIndex, "find_nearest", count)
    first = [run(LDP(epsilon=epsilon, dictionary=small), Sketch(), images) for epsilon in (4, 8)]
    assert len(searched) == 3  # two photographs, and the keypoint of the dry run
    with store.use_folder(store.cache_folder() / "elsewhere"):
        again = [run(LDP(epsilon=epsilon, dictionary=small), Sketch(), images) for epsilon in (4, 8)]
    assert len(searched) == 6
    assert list(map(without_seconds, first)) == list(map(without_seconds, again))


def test_protect_stores_nothing(images: Path, small: Asset) -> None:
    from bench.images import photographs
    from bench.mechanisms.protection import protect

    features = Sift().extract(photographs.read(images / "0.png").pixels)
    protect(features, LDP(dictionary=small))
    assert not list(store.list_entries())


def test_network_is_found_by_its_training_plan(images: Path, tmp_path: Path) -> None:
    plan = Plan(
        targets=[Target(defense=Undefended(), supported_settings={})],
        photographs=list_photographs(images)[:1],
        validation=list_photographs(images)[1:],
        extractor=Sift(),
        widths=(8, 8),
        training=Training(steps=1),
    )
    key = networks.build_key(plan)
    out = tmp_path / "W.safetensors"
    assert networks.fetch(key, out) is None
    shipped = sorted(ASSETS.glob("inversion-*.safetensors"))
    if not shipped:
        pytest.skip("the networks are not here")
    networks.save(key, shipped[0])
    assert networks.fetch(key, out) == weights.load(shipped[0]).meta
    assert out.read_bytes() == shipped[0].read_bytes()
    assert networks.fetch(key, out) is None  # an existing file is not overwritten
    others: dict[str, Any] = {"training": Training(steps=2), "widths": (8, 9), "photographs": list_photographs(images)[1:]}
    for field, value in {**others, "targets": [Target(defense=Affine(), supported_settings={})]}.items():
        assert networks.build_key(dataclasses.replace(plan, **{field: value})) != key


# ---- source


def write_package(folder: Path, helper: str) -> None:
    folder.mkdir(exist_ok=True)
    (folder / "__init__.py").write_text("")
    (folder / "attack.py").write_text(
        "from typing import TYPE_CHECKING\nfrom .helper import f\nif TYPE_CHECKING:\n    import strange.types\n"
    )
    (folder / "helper.py").write_text(helper)
    (folder / "types.py").write_text("X = 1\n")
    (folder / "metric.py").write_text("X = 1\n")


def test_source_hash_covers_all_imports_and_nothing_else(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    write_package(tmp_path / "strange", "def f():\n    from strange import deep\n")

    def digest() -> str:
        provenance.hash_modules.cache_clear()
        provenance._read_source.cache_clear()
        return provenance.hash_modules("strange.attack")

    first = digest()
    for file in ("metric.py", "types.py"):  # not imported, or only under TYPE_CHECKING
        (tmp_path / "strange" / file).write_text("X = 2\n")
        assert digest() == first
    (tmp_path / "strange" / "deep.py").write_text("Y = 1\n")  # imported in a function of an imported module
    deep = digest()
    assert deep != first
    (tmp_path / "strange" / "helper.py").write_text("def f():\n    return 1\n")
    assert digest() not in (first, deep)


def test_source_of_an_attack_covers_its_kernels_but_no_metric_or_command() -> None:
    modules: list[str] = []
    read_source = provenance._read_source

    def list_module(module: str) -> str | None:
        modules.append(module)
        return read_source(module)

    provenance.hash_modules.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provenance, "_read_source", list_module)
        provenance.hash_modules("attacks.clustering")
    assert {"bench.geometry.shared_sub_database", "bench.geometry.subspaces", "bench.types"} <= set(modules)
    assert not [name for name in modules if name.startswith(("metrics", "bench.cli", "leaderboard", "bench.runner.plan"))]


# ---- files


def test_damaged_entries_are_reported_and_computed_again(cache_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, _ = store.fetch("a", 1, numbers)
    (entry,) = store.list_entries()
    assert entry.find_fault() is None
    entry.path.write_bytes(entry.path.read_bytes()[:-1] + b"\x07")
    assert "checksum" in str(entry.find_fault())
    again, _ = store.fetch("a", 1, numbers)
    np.testing.assert_array_equal(again["numbers"], first["numbers"])
    assert "checksum" in caplog.text
    assert "computed again" in caplog.text
    assert entry.find_fault() is None


def edit_header(change: Callable[[dict[str, Any]], Any]) -> Callable[[bytes], bytes]:
    """Return an edit of a safetensors file's header, which leaves the tensors as they are."""

    def edit(content: bytes) -> bytes:
        (size,) = struct.unpack("<Q", content[:8])
        header = json.loads(content[8 : 8 + size])
        header = json.dumps(change(header)).encode()
        return struct.pack("<Q", len(header)) + header + content[8 + size :]

    return edit


def edit_metadata(**more: str | None) -> Callable[[bytes], bytes]:
    """Return an edit of the metadata in the header; None removes an entry."""

    def change(header: dict[str, Any]) -> dict[str, Any]:
        metadata = header["__metadata__"] | more
        return header | {"__metadata__": {name: value for name, value in metadata.items() if value is not None}}

    return edit_header(change)


DAMAGES = [
    edit_metadata(meta=None),
    edit_metadata(meta="{oops"),
    edit_metadata(meta="[]"),
    edit_metadata(meta='{"a": NaN}'),
    edit_metadata(digest=None),
    edit_metadata(kind=None),
    edit_header(lambda header: {name: value for name, value in header.items() if name != "__metadata__"}),
    edit_header(lambda header: header | {"numbers": header["numbers"] | {"dtype": "F8_E4M3", "shape": [8000]}}),
    edit_header(lambda header: header | {"numbers": header["numbers"] | {"dtype": "BF16", "shape": [4000]}}),
    edit_header(lambda header: []),
    lambda content: b"",
    lambda content: content[:4],
    lambda content: b"\xff" * 8 + content[8:],
    lambda content: content[:8] + b"\xff" + content[9:],
    lambda content: content.replace(b"numbers", b"numb\xffrs"),
]


@pytest.mark.parametrize("damage", DAMAGES, ids=range(len(DAMAGES)))
def test_a_damaged_header_is_detected_computed_again_and_pruned(
    cache_folder: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture, damage: Callable[[bytes], bytes]
) -> None:
    first, _ = store.fetch("a", 1, numbers)
    assert first["numbers"].nbytes == 8000
    (entry,) = store.list_entries()
    whole = entry.path.read_bytes()
    entry.path.write_bytes(damage(whole))
    assert bench(capfd, "cache", "verify")[0] == 1
    again, _ = store.fetch("a", 1, numbers)
    np.testing.assert_array_equal(again["numbers"], first["numbers"])
    assert "computed again" in caplog.text
    assert entry.find_fault() is None
    entry.path.write_bytes(damage(whole))
    assert not store.copy_file("a", 1, cache_folder / "copy")
    assert bench(capfd, "cache", "prune", "--damaged")[1].startswith("removed 1 entries")
    assert not entry.path.exists()


EMPTY = hashlib.sha256(b"").hexdigest().encode()


@pytest.mark.parametrize(
    "sums",
    [b"", b"\xff\xfe\n", b"no-spaces\n", b"0  ../a/b\n", b"0  /etc/hostname\n", b"0  a\0b\n", EMPTY + b"  ../../outside\n"],
)
def test_damaged_checksums_of_a_folder_are_detected_and_pruned(
    cache_folder: Path, capfd: pytest.CaptureFixture[str], sums: bytes
) -> None:
    folder = store.fetch_folder("models", "key", lambda folder: (folder / "a.txt").touch())
    (cache_folder / "outside").touch()  # the last checksum is that of this file
    (folder / store.SUMS).write_bytes(sums)
    assert bench(capfd, "cache", "verify")[0] == 1
    assert store.fetch_folder("models", "key", lambda folder: (folder / "a.txt").touch()) == folder
    assert bench(capfd, "cache", "verify")[0] == 0
    (folder / store.SUMS).write_bytes(sums)
    assert bench(capfd, "cache", "prune", "--damaged")[1].startswith("removed 1 entries")
    assert not folder.exists()


def test_folders_are_stored_with_checksums(cache_folder: Path) -> None:
    filled: list[Path] = []

    def fill(folder: Path) -> None:
        filled.append(folder)
        (folder / "a.txt").write_text("a")
        (folder / "b.txt").write_text("b")

    folder = store.fetch_folder("models", "key", fill)
    assert store.fetch_folder("models", "key", fill) == folder
    assert len(filled) == 1
    output = subprocess.run(["sha256sum", "-c", store.SUMS], cwd=folder, capture_output=True, text=True, check=True).stdout
    assert output == "a.txt: OK\nb.txt: OK\n"
    (folder / "b.txt").write_text("c")
    (entry,) = store.list_entries()
    assert "checksum of b.txt" in str(entry.find_fault())
    assert (store.fetch_folder("models", "key", fill) / "b.txt").read_text() == "b"
    assert len(filled) == 2

    def fail(folder: Path) -> None:
        (folder / "half").write_text("h")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.fetch_folder("models", "other", fail)
    assert [entry.path for entry in store.list_entries()] == [folder]


def test_full_disk_stores_nothing_and_loses_nothing(cache_folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    store.fetch("a", "before", numbers)
    with small_disk(100):
        arrays, _ = store.fetch("a", "full", numbers)
    np.testing.assert_array_equal(arrays["numbers"], np.arange(1000))
    assert "it is not stored" in caplog.text
    (entry,) = store.list_entries()  # no half-written file is left
    assert entry.find_fault() is None


def test_disk_that_fills_up_during_a_run(images: Path, tmp_path: Path) -> None:
    plan = prepare_plan([Undefended()], [Sketch()], images, task=RECONSTRUCTION)
    with small_disk(2000), pytest.raises(OSError, match="large"):  # a picture is larger
        list(execute.execute([plan], tmp_path / "out"))
    records = list(execute.execute([plan], tmp_path / "out"))
    assert [record["status"] for record in records] == ["ok", "ok"]
    assert len((tmp_path / "out" / "records.jsonl").read_text().splitlines()) == 2


# ---- the command


@pytest.fixture
def three(cache_folder: Path) -> dict[str, Path]:
    """Entries of two kinds, one of them old and one large."""
    store.fetch("a", "new", numbers)
    store.fetch("a", "old", numbers)
    store.fetch("b", "large", lambda: ({"numbers": np.arange(10_000)}, {}))
    ago = time.time() - 40 * 24 * 3600
    os.utime(store.entry_path("a", "old"), (ago, ago))
    return {"new": store.entry_path("a", "new"), "old": store.entry_path("a", "old"), "large": store.entry_path("b", "large")}


def test_list_and_verify(three: dict[str, Path], capfd: pytest.CaptureFixture[str]) -> None:
    status, shown, _ = bench(capfd, "cache", "list")
    assert status == 0
    assert "3 entries, 96" in shown
    assert bench(capfd, "cache", "verify")[:2] == (0, format_verified(three))
    three["new"].write_bytes(b"")
    three["old"].write_bytes(three["old"].read_bytes()[:-1] + b"\x01")
    status, shown, _ = bench(capfd, "cache", "verify")
    assert status == 1
    assert shown.count(str(three["new"])) == shown.count(str(three["old"])) == 1
    assert "3 entries" in shown
    assert "2 damaged; remove them with bench cache prune --damaged" in shown
    assert all(path.is_file() for path in three.values())  # verify removes nothing
    status, shown, _ = bench(capfd, "cache", "prune", "--damaged")
    assert "removed 2 entries" in shown
    assert [path.is_file() for path in three.values()] == [False, False, True]
    assert bench(capfd, "cache", "verify")[0] == 0


def format_verified(three: dict[str, Path]) -> str:
    size = sum(path.stat().st_size for path in three.values())
    return f"3 entries, {size / 1000:.3g} kB: 0 damaged; all checksums are right\n"


@pytest.mark.parametrize(
    ("options", "left"),
    [
        (("--older-than", 30), {"new", "large"}),
        (("--larger-than", "20kB"), {"new", "old"}),
        (("--kind", "a"), {"large"}),
        (("--kind", "a", "--older-than", 30), {"new", "large"}),
        (("--kind", "b", "--older-than", 30), {"new", "old", "large"}),
        (("--older-than", 0), set()),
        (("--damaged",), {"new", "old", "large"}),
    ],
)
def test_prune(three: dict[str, Path], options: tuple[Any, ...], left: set[str], capfd: pytest.CaptureFixture[str]) -> None:
    size = sum(path.stat().st_size for name, path in three.items() if name not in left)
    status, shown, _ = bench(capfd, "cache", "prune", *options)
    assert status == 0
    assert {name for name, path in three.items() if path.is_file()} == left
    assert shown.startswith(f"removed {3 - len(left)} entries and freed ")
    assert (f"{size / 1000:.3g} kB" if size else "0 B") in shown


def test_use_updates_the_time_of_an_entry(three: dict[str, Path], capfd: pytest.CaptureFixture[str]) -> None:
    store.fetch("a", "old", numbers)
    bench(capfd, "cache", "prune", "--older-than", 30)
    assert three["old"].is_file()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "bench cache list|verify|prune"),
        (("pruen",), "did you mean 'cache prune'"),
        (("prune",), "select the entries"),
        (("prune", "--kind", "c"), "unknown kind 'c'"),
        (("prune", "--larger-than", "much"), "expected a size such as 20MB, not 'much'"),
    ],
)
def test_invalid_arguments(
    three: dict[str, Path], arguments: tuple[str, ...], complaint: str, capfd: pytest.CaptureFixture[str]
) -> None:
    status, _, err = bench(capfd, "cache", *arguments)
    assert status == 2
    assert complaint in err
    assert all(path.is_file() for path in three.values())


def test_folder_of_the_cache(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "mine"))
    assert store.cache_folder() == tmp_path / "mine"
    for value in (None, ""):
        monkeypatch.delenv(store.VARIABLE) if value is None else monkeypatch.setenv(store.VARIABLE, value)
        assert store.cache_folder() == Path(platformdirs.user_cache_dir("feature-privacy-bench"))
        assert store.cache_folder().is_absolute()


def test_an_empty_cache(capfd: pytest.CaptureFixture[str]) -> None:
    assert "0 entries, 0 B" in " ".join(bench(capfd, "cache", "list")[1].split())
    assert bench(capfd, "cache", "verify")[0] == 0


def test_unfinished_entries_are_found(cache_folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (cache_folder / "a").mkdir(parents=True)
    (cache_folder / "a" / "x.safetensors.123.unfinished").write_bytes(b"half")
    status, shown, _ = bench(capfd, "cache", "verify")
    assert status == 1
    assert "incomplete" in shown
    assert "freed 4 B" in bench(capfd, "cache", "prune", "--damaged")[1]
