"""Discovery of plugins, and errors of wrong ones."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FAKES, install_plugins
from PIL import Image

from bench.api import Attack, Defense, Metric, Privacy
from bench.codebook.public import Public
from bench.core.errors import UserError
from bench.registry import discovery
from bench.types import Descriptors, Features, Release


def test_built_in_plugins_are_found_by_file_name() -> None:
    assert {"affine", "ldp", "naive-ldp", "none"} <= set(discovery.discover(discovery.DEFENSE))
    assert {"mae", "psnr", "ssim"} <= set(discovery.discover(discovery.METRIC))
    assert "reconstruction" in discovery.discover(discovery.TASK)


def test_modules_without_plugin_and_subpackages_are_skipped() -> None:
    extractors = discovery.discover(discovery.EXTRACTOR)
    assert {"hloc", "sift"} <= set(extractors)
    assert not {"dictionary", "build"} & set(extractors)
    assert "inversion" not in discovery.discover(discovery.ATTACK)


def test_external_plugins_are_found_by_entry_point(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, FAKES)
    assert discovery.load_plugin(discovery.ATTACK, "sketch").name() == "sketch"
    assert discovery.load_plugin(discovery.DEFENSE, "broken").summary() == "Fails at every photograph."


def test_duplicate_names_are_an_error_with_both_origins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"ldp": "fake_plugins.broken:PLUGIN"}}, name="external")
    with pytest.raises(UserError, match=r"two defense plugins are called 'ldp': defenses\.ldp and fake_plugins.*external"):
        discovery.load_plugin(discovery.DEFENSE, "none")


def test_entry_point_must_have_the_name_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"other": "fake_plugins.broken:PLUGIN"}})
    with pytest.raises(UserError, match=r"'other'.*'broken'"):
        discovery.load_plugin(discovery.DEFENSE, "other")


def test_plugin_that_cannot_be_imported_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"absent": "no_such_module:PLUGIN"}}, name="external")
    assert discovery.load_plugin(discovery.DEFENSE, "none")  # the others are not affected
    with pytest.raises(UserError, match=r"no_such_module.*external.*cannot be imported"):
        discovery.load_plugin(discovery.DEFENSE, "absent")


def test_misspelt_name_gets_a_hint_and_the_list() -> None:
    with pytest.raises(UserError, match=r"unknown defense 'lpd'; did you mean 'ldp'\?.*affine.*none"):
        discovery.load_plugin(discovery.DEFENSE, "lpd")


def build_class(base: type, **body: Any) -> type:
    """Return a frozen keyword-only dataclass with this body."""
    return dataclass(frozen=True, kw_only=True)(type("Wrong", (base,), {"__module__": __name__, **body}))


def protect(self: Any, secret: Features, public: Public, rng: np.random.Generator) -> Release:
    raise NotImplementedError


def privacy(self: Any, public: Public) -> Privacy:
    return Privacy("none")


def protect_with_swapped_arguments(self: Any, secret: Features, rng: np.random.Generator, public: Public) -> Release:
    raise NotImplementedError


GOOD = {"releases": Descriptors, "protect": protect, "privacy": privacy}


def test_valid_plugin_is_accepted() -> None:
    discovery.check(discovery.DEFENSE, build_class(Defense, __annotations__={"strength": float}, strength=1.0, **GOOD))


@pytest.mark.parametrize(
    ("plugin", "complaint"),
    [
        (type("Plain", (Defense,), {"__module__": __name__, **GOOD}), r"@dataclass\(frozen=True, kw_only=True\)"),
        (dataclass(type("Thawed", (Defense,), {"__module__": __name__, **GOOD})), r"@dataclass\(frozen=True, kw_only=True\)"),
        (dataclass(frozen=True)(type("Positional", (Defense,), {"__annotations__": {"a": int}, "a": 1, **GOOD})), "kw_only"),
        (3, "must be a subclass of Defense"),
        (build_class(Metric), "must be a subclass of Defense"),
        (build_class(Defense, releases=Descriptors, protect=protect), r"lacks privacy\(self, public: Public\) -> Privacy"),
        (
            build_class(Defense, strength=1.0, **GOOD),
            r"`strength = 1.0` is a field without a type: write `strength: float = 1.0`",
        ),
        (build_class(Defense, __annotations__={"sizes": list}, **GOOD), "field `sizes` has type"),
        (
            build_class(Defense, releases=Descriptors, protect=protect_with_swapped_arguments, privacy=privacy),
            r"wrong signature; it should be protect\(self, secret: Features, public: Public, rng: np.random.Generator\)",
        ),
        (build_class(Defense, protect=protect, privacy=privacy), r"lacks the class variable `releases: type\[Release\]`"),
    ],
)
def test_error_of_wrong_defense_states_the_rule(plugin: Any, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        discovery.check(discovery.DEFENSE, plugin)


def test_attack_must_subclass_one_of_three_classes() -> None:
    with pytest.raises(UserError, match="DescriptorAttack or SelectiveAttack or ImageAttack"):
        discovery.check(discovery.ATTACK, build_class(Attack, accepts=(Descriptors,)))


def test_attack_must_not_override_applicability() -> None:
    from bench.api import ImageAttack

    def explain_not_applicable(self: Any, defense: Any, extractor: Any, public: Any) -> None: ...
    def reconstruct(self: Any, view: Any, rng: Any) -> None: ...

    wrong = build_class(
        ImageAttack, accepts=(Descriptors,), reconstruct=reconstruct, explain_not_applicable=explain_not_applicable
    )
    with pytest.raises(UserError, match="must not override explain_not_applicable"):
        discovery.check(discovery.ATTACK, wrong)


HEAVY = {"torch", "cv2", "pandas", "matplotlib", "skimage", "h5py", "scipy", "sklearn", "faiss", "pycolmap", "poselib", "dask"}


def list_heavy_imports(code: str) -> set[str]:
    """Return the heavy libraries that a process which executes `code` imports."""
    script = f"import sys\n{code}\nprint(*{HEAVY} & set(sys.modules), *{{'scipy.stats'}} & set(sys.modules), file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", script], check=True, capture_output=True, text=True)
    return set(done.stderr.splitlines()[-1].split())


@pytest.mark.parametrize(
    "code",
    [
        "import bench.registry.discovery",
        "import bench",
        "from bench.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass",
    ],
)
def test_heavy_libraries_are_not_imported_early(code: str) -> None:
    assert list_heavy_imports(code) == set()


@pytest.mark.slow
def test_list_imports_no_heavy_library_but_opencv() -> None:
    assert list_heavy_imports("from bench.cli import main\nmain(['list'])") == {"cv2"}  # of the gallery's module


@pytest.mark.slow
def test_main_job_imports_only_what_it_uses(tmp_path: Path) -> None:
    image = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    (tmp_path / "photos").mkdir()
    Image.fromarray(image).save(tmp_path / "photos" / "one.png")
    job = ["run", "--defense", "ldp", "--attack", "dia", "--images", str(tmp_path / "photos"), "--out", str(tmp_path / "out")]
    used = {"torch", "cv2", "skimage", "scipy"}
    assert list_heavy_imports(f"from bench.cli import main\nassert main({job}) == 0") == used
