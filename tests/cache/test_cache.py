"""What is kept: found again by what made it and by nothing else, checked, and made again when it is damaged."""

import dataclasses
import os
import resource
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_plugins.guess import Guess
from fake_plugins.painter import Painter
from fakes import FAKES, install_plugins, prepare_plan, write_album

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
from bench.inversion.plan import Plan, Training
from bench.runner import execute
from bench.runner.records import Record
from bench.settings import Asset
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

PAINT = Reconstruction(inverter="painter")


@pytest.fixture(autouse=True)
def kept_in(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    install_plugins(tmp_path / "installed", monkeypatch, FAKES)
    monkeypatch.setenv(store.VARIABLE, str(tmp_path / "cache"))
    monkeypatch.setattr(attack_cache, "WORTH", 0.0)
    return tmp_path / "cache"


@pytest.fixture
def images(tmp_path: Path) -> Path:
    return write_album(tmp_path / "album")


@pytest.fixture
def small(tmp_path: Path) -> Asset:
    return write_dictionary(tmp_path)


@pytest.fixture
def guessed(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Grows whenever the attack `guess` is at work; what it says is random."""
    calls: list[int] = []
    recover = Guess.recover

    def counted(self: Guess, view: Any, rng: np.random.Generator) -> Any:
        calls.append(len(view.release))
        view.notes.append(f"drew {rng.integers(1000)}")
        return recover(self, view, rng)

    monkeypatch.setattr(Guess, "recover", counted)
    return calls


def numbers() -> store.Content:
    return {"numbers": np.arange(1000)}, {"of": "numbers"}


def run(defense: Any, attack: Any, images: Any, task: Reconstruction = PAINT, **more: Any) -> list[Record]:
    return execute.run([defense], [attack], images, task=task, **more)


def judged(records: list[Record]) -> list[Any]:
    return [{key: value for key, value in record.items() if key != "seconds"} for record in records]


def bench(capfd: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, str, str]:
    status = cli.main([str(argument) for argument in arguments])
    out, err = capfd.readouterr()
    return status, out, err


@contextmanager
def small_disk(size: int) -> Iterator[None]:
    """No file may grow larger than that, as on a disk that is full."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


# ---- recovered descriptors


def test_recovered_descriptors_are_found_again_by_another_inverter(images: Path, small: Asset, guessed: list[int]) -> None:
    defense = LDP(epsilon=8, dictionary=small)
    first = run(defense, Guess(), images)
    assert len(guessed) == 2
    assert judged(run(defense, Guess(), images)) == judged(first)
    darker = run(defense, Guess(), images, Reconstruction(inverter="painter:brightness=0.5"))
    assert len(guessed) == 2
    assert [record["notes"] for record in darker] == [record["notes"] for record in first]
    assert darker[0]["metrics"]["angle"] == first[0]["metrics"]["angle"]
    assert darker[0]["metrics"]["mae"] != first[0]["metrics"]["mae"]


def test_what_is_found_again_is_what_would_have_been_made(
    images: Path, small: Asset, guessed: list[int], kept_in: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The inverter draws on from where the attack left off."""
    defense = Affine(lifting="random")
    kept_once = [run(defense, attack, images) for attack in (Guess(), Sparsity(pivots=2)) for _ in range(2)]
    with monkeypatch.context() as without:
        without.setattr(attack_cache, "WORTH", np.inf)
        without.setenv(store.VARIABLE, str(kept_in / "none"))
        made = [run(defense, attack, images) for attack in (Guess(), Sparsity(pivots=2)) for _ in range(2)]
    assert list(map(judged, kept_once)) == list(map(judged, made))
    assert not list((kept_in / "none").glob("recovered/*"))


def test_whatever_an_attack_sees_makes_another_key(images: Path, tmp_path: Path, guessed: list[int]) -> None:
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
    assert calls(defense, Guess(), [images / "0.png"]) == 1  # other releases would be of other photographs
    assert calls(defense, Guess(), [images / "1.png", images / "0.png"]) == 2  # and would come in another order


def test_seconds_are_those_of_the_attack_though_it_was_spared(
    images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch
) -> None:
    recover = Guess.recover

    def slow(self: Guess, view: Any, rng: Any) -> Any:
        time.sleep(0.5)
        return recover(self, view, rng)

    monkeypatch.setattr(Guess, "recover", slow)
    for _ in range(2):
        assert run(LDP(dictionary=small), Guess(), [images / "0.png"])[0]["seconds"] > 0.5


def test_what_was_quick_is_not_kept(images: Path, small: Asset, kept_in: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(attack_cache, "WORTH", np.inf)
    run(LDP(dictionary=small), Guess(), images)
    assert {entry.kind for entry in store.list_entries()} == {"words"}


def test_what_is_kept_is_what_is_used(images: Path, small: Asset) -> None:
    """A control: were something else kept, records would show it."""
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


def test_words_are_searched_once_for_all_settings(images: Path, small: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []
    nearest = WordIndex.find_nearest

    def counted(self: WordIndex, rows: Any) -> Any:
        searched.append(len(rows))
        return nearest(self, rows)

    monkeypatch.setattr(WordIndex, "find_nearest", counted)
    first = [run(LDP(epsilon=epsilon, dictionary=small), Painter(), images) for epsilon in (4, 8)]
    assert len(searched) == 3  # two photographs, and the keypoint of the rehearsal
    with store.use_folder(store.cache_folder() / "elsewhere"):
        again = [run(LDP(epsilon=epsilon, dictionary=small), Painter(), images) for epsilon in (4, 8)]
    assert len(searched) == 6
    assert list(map(judged, first)) == list(map(judged, again))


def test_protecting_for_real_leaves_no_trace(images: Path, small: Asset) -> None:
    from bench.images import photographs
    from bench.mechanisms.protection import protect

    features = Sift().extract(photographs.read(images / "0.png").pixels)
    protect(features, LDP(dictionary=small))
    assert not list(store.list_entries())


def test_network_is_found_again_by_what_made_it(images: Path, tmp_path: Path) -> None:
    plan = Plan(
        defense=Undefended(),
        supported_settings={},
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
    assert networks.fetch(key, out) is None  # what is there is not overwritten
    others: dict[str, Any] = {"training": Training(steps=2), "widths": (8, 9), "photographs": list_photographs(images)[1:]}
    for field, value in {**others, "defense": Affine()}.items():
        assert networks.build_key(dataclasses.replace(plan, **{field: value})) != key


# ---- source


def package(place: Path, helper: str) -> None:
    place.mkdir(exist_ok=True)
    (place / "__init__.py").write_text("")
    (place / "attack.py").write_text(
        "from typing import TYPE_CHECKING\nfrom .helper import f\nif TYPE_CHECKING:\n    import strange.types\n"
    )
    (place / "helper.py").write_text(helper)
    (place / "types.py").write_text("X = 1\n")
    (place / "metric.py").write_text("X = 1\n")


def test_source_is_that_of_all_that_is_imported_and_no_more(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(tmp_path)
    package(tmp_path / "strange", "def f():\n    from strange import deep\n")

    def digest() -> str:
        provenance.hash_modules.cache_clear()
        provenance._text.cache_clear()
        return provenance.hash_modules("strange.attack")

    first = digest()
    for file in ("metric.py", "types.py"):  # not imported, or for types alone
        (tmp_path / "strange" / file).write_text("X = 2\n")
        assert digest() == first
    (tmp_path / "strange" / "deep.py").write_text("Y = 1\n")  # imported late, by what is imported
    deep = digest()
    assert deep != first
    (tmp_path / "strange" / "helper.py").write_text("def f():\n    return 1\n")
    assert digest() not in (first, deep)


def test_source_of_an_attack_has_its_kernels_and_no_metric_or_command() -> None:
    found: list[str] = []
    kept_text = provenance._text

    def listed(module: str) -> str | None:
        found.append(module)
        return kept_text(module)

    provenance.hash_modules.cache_clear()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(provenance, "_text", listed)
        provenance.hash_modules("attacks.clustering")
    assert {"bench.geometry.shared_sub_database", "bench.geometry.subspaces", "bench.types"} <= set(found)
    assert not [name for name in found if name.startswith(("metrics", "bench.cli", "leaderboard", "bench.runner.plan"))]


# ---- files


def test_damaged_entries_are_named_and_made_again(kept_in: Path, caplog: pytest.LogCaptureFixture) -> None:
    first, _ = store.fetch("a", 1, numbers)
    (entry,) = store.list_entries()
    assert entry.find_fault() is None
    entry.path.write_bytes(entry.path.read_bytes()[:-1] + b"\x07")
    assert "checksum" in str(entry.find_fault())
    again, _ = store.fetch("a", 1, numbers)
    np.testing.assert_array_equal(again["numbers"], first["numbers"])
    assert "checksum" in caplog.text
    assert "made again" in caplog.text
    assert entry.find_fault() is None


def test_folders_are_kept_with_checksums(kept_in: Path) -> None:
    made: list[Path] = []

    def fill(place: Path) -> None:
        made.append(place)
        (place / "a.txt").write_text("a")
        (place / "b.txt").write_text("b")

    place = store.fetch_folder("models", "key", fill)
    assert store.fetch_folder("models", "key", fill) == place
    assert len(made) == 1
    told = subprocess.run(["sha256sum", "-c", store.SUMS], cwd=place, capture_output=True, text=True, check=True).stdout
    assert told == "a.txt: OK\nb.txt: OK\n"
    (place / "b.txt").write_text("c")
    (entry,) = store.list_entries()
    assert "checksum of b.txt" in str(entry.find_fault())
    assert (store.fetch_folder("models", "key", fill) / "b.txt").read_text() == "b"
    assert len(made) == 2

    def broken(place: Path) -> None:
        (place / "half").write_text("h")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        store.fetch_folder("models", "other", broken)
    assert [entry.path for entry in store.list_entries()] == [place]


def test_full_disk_keeps_nothing_and_loses_nothing(kept_in: Path, caplog: pytest.LogCaptureFixture) -> None:
    store.fetch("a", "before", numbers)
    with small_disk(100):
        arrays, _ = store.fetch("a", "full", numbers)
    np.testing.assert_array_equal(arrays["numbers"], np.arange(1000))
    assert "it is not kept" in caplog.text
    (entry,) = store.list_entries()  # nothing half-written is left
    assert entry.find_fault() is None


def test_disk_that_fills_up_in_a_run_is_told_and_nothing_else_is_lost(images: Path, tmp_path: Path) -> None:
    plan = prepare_plan([Undefended()], [Painter()], images, task=PAINT)
    with small_disk(2000), pytest.raises(OSError, match="large"):  # a picture is larger
        list(execute.execute([plan], tmp_path / "out"))
    records = list(execute.execute([plan], tmp_path / "out"))
    assert [record["status"] for record in records] == ["ok", "ok"]
    assert len((tmp_path / "out" / "records.jsonl").read_text().splitlines()) == 2


# ---- the command


@pytest.fixture
def three(kept_in: Path) -> dict[str, Path]:
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
    assert bench(capfd, "cache", "verify")[:2] == (0, as_written(three))
    three["new"].write_bytes(b"")
    three["old"].write_bytes(three["old"].read_bytes()[:-1] + b"\x01")
    status, shown, _ = bench(capfd, "cache", "verify")
    assert status == 1
    assert shown.count(str(three["new"])) == shown.count(str(three["old"])) == 1
    assert "3 entries" in shown
    assert "2 damaged; bench cache prune --damaged" in shown
    assert all(path.is_file() for path in three.values())  # nothing is removed without being told
    status, shown, _ = bench(capfd, "cache", "prune", "--damaged")
    assert "removed 2 entries" in shown
    assert [path.is_file() for path in three.values()] == [False, False, True]
    assert bench(capfd, "cache", "verify")[0] == 0


def as_written(three: dict[str, Path]) -> str:
    size = sum(path.stat().st_size for path in three.values())
    return f"3 entries, {size / 1000:.3g} kB: 0 damaged; all as written\n"


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


def test_use_makes_young(three: dict[str, Path], capfd: pytest.CaptureFixture[str]) -> None:
    store.fetch("a", "old", numbers)
    bench(capfd, "cache", "prune", "--older-than", 30)
    assert three["old"].is_file()


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [
        ((), "bench cache list|verify|prune"),
        (("pruen",), "did you mean 'cache prune'"),
        (("prune",), "say what to remove"),
        (("prune", "--kind", "c"), "unknown kind 'c'"),
        (("prune", "--larger-than", "much"), "expected a size such as 20MB, not 'much'"),
    ],
)
def test_mistakes(three: dict[str, Path], arguments: tuple[str, ...], complaint: str, capfd: pytest.CaptureFixture[str]) -> None:
    status, _, told = bench(capfd, "cache", *arguments)
    assert status == 2
    assert complaint in told
    assert all(path.is_file() for path in three.values())


def test_an_empty_cache(capfd: pytest.CaptureFixture[str]) -> None:
    assert "0 entries, 0 B" in bench(capfd, "cache", "list")[1]
    assert bench(capfd, "cache", "verify")[0] == 0


def test_what_a_crash_left_is_found(kept_in: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (kept_in / "a").mkdir(parents=True)
    (kept_in / "a" / "x.safetensors.123.unfinished").write_bytes(b"half")
    status, shown, _ = bench(capfd, "cache", "verify")
    assert status == 1
    assert "never finished" in shown
    assert "freed 4 B" in bench(capfd, "cache", "prune", "--damaged")[1]
