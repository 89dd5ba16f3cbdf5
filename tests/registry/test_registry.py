"""Finding plugins, and refusing wrong ones."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fakes import FAKES, install_plugins

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
    assert discovery.load_plugin(discovery.ATTACK, "painter").name() == "painter"
    assert discovery.load_plugin(discovery.DEFENSE, "broken").summary() == "Fails at every photograph."


def test_two_plugins_of_one_name_are_refused_with_both_origins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"ldp": "fake_plugins.broken:PLUGIN"}}, name="stranger")
    with pytest.raises(UserError, match=r"two defense plugins are called 'ldp': defenses\.ldp and fake_plugins.*stranger"):
        discovery.load_plugin(discovery.DEFENSE, "none")


def test_entry_point_must_have_the_name_of_the_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"other": "fake_plugins.broken:PLUGIN"}})
    with pytest.raises(UserError, match=r"'other'.*'broken'"):
        discovery.load_plugin(discovery.DEFENSE, "other")


def test_plugin_that_cannot_be_imported_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install_plugins(tmp_path, monkeypatch, {"feature_privacy.defenses": {"absent": "no_such_module:PLUGIN"}}, name="stranger")
    assert discovery.load_plugin(discovery.DEFENSE, "none")  # the others are not affected
    with pytest.raises(UserError, match=r"no_such_module.*stranger.*cannot be imported"):
        discovery.load_plugin(discovery.DEFENSE, "absent")


def test_misspelt_name_gets_a_hint_and_the_list() -> None:
    with pytest.raises(UserError, match=r"unknown defense 'lpd'; did you mean 'ldp'\?.*affine.*none"):
        discovery.load_plugin(discovery.DEFENSE, "lpd")


def frozen(base: type, **body: Any) -> type:
    """A frozen keyword-only dataclass with this body."""
    return dataclass(frozen=True, kw_only=True)(type("Wrong", (base,), {"__module__": __name__, **body}))


def protect(self: Any, secret: Features, public: Public, rng: np.random.Generator) -> Release:
    raise NotImplementedError


def privacy(self: Any, public: Public) -> Privacy:
    return Privacy("none")


def swapped(self: Any, secret: Features, rng: np.random.Generator, public: Public) -> Release:
    raise NotImplementedError


GOOD = {"releases": Descriptors, "protect": protect, "privacy": privacy}


def test_right_plugin_is_accepted() -> None:
    discovery.check(discovery.DEFENSE, frozen(Defense, __annotations__={"strength": float}, strength=1.0, **GOOD))


@pytest.mark.parametrize(
    ("plugin", "complaint"),
    [
        (type("Plain", (Defense,), {"__module__": __name__, **GOOD}), r"@dataclass\(frozen=True, kw_only=True\)"),
        (dataclass(type("Thawed", (Defense,), {"__module__": __name__, **GOOD})), r"@dataclass\(frozen=True, kw_only=True\)"),
        (dataclass(frozen=True)(type("Positional", (Defense,), {"__annotations__": {"a": int}, "a": 1, **GOOD})), "kw_only"),
        (3, "must be a subclass of Defense"),
        (frozen(Metric), "must be a subclass of Defense"),
        (frozen(Defense, releases=Descriptors, protect=protect), r"lacks privacy\(self, public: Public\) -> Privacy"),
        (frozen(Defense, strength=1.0, **GOOD), r"`strength = 1.0` is a field without a type: write `strength: float = 1.0`"),
        (frozen(Defense, __annotations__={"sizes": list}, **GOOD), "field `sizes` has type"),
        (
            frozen(Defense, releases=Descriptors, protect=swapped, privacy=privacy),
            r"wrong signature; it should be protect\(self, secret: Features, public: Public, rng: np.random.Generator\)",
        ),
        (frozen(Defense, protect=protect, privacy=privacy), r"lacks the class variable `releases: type\[Release\]`"),
    ],
)
def test_wrong_defense_is_refused_with_what_is_right(plugin: Any, complaint: str) -> None:
    with pytest.raises(UserError, match=complaint):
        discovery.check(discovery.DEFENSE, plugin)


def test_attack_must_say_what_it_recovers() -> None:
    with pytest.raises(UserError, match="DescriptorAttack or SelectiveAttack or ImageAttack"):
        discovery.check(discovery.ATTACK, frozen(Attack, accepts=(Descriptors,)))


def test_attack_must_not_decide_applicability_itself() -> None:
    from bench.api import ImageAttack

    def inapplicable(self: Any, defense: Any, extractor: Any, public: Any) -> None: ...
    def reconstruct(self: Any, view: Any, rng: Any) -> None: ...

    wrong = frozen(ImageAttack, accepts=(Descriptors,), reconstruct=reconstruct, explain_not_applicable=inapplicable)
    with pytest.raises(UserError, match="must not override inapplicable"):
        discovery.check(discovery.ATTACK, wrong)


@pytest.mark.parametrize(
    "code",
    [
        "import bench.registry.discovery",
        "import bench",
        "from bench.cli import main\ntry: main(['--help'])\nexcept SystemExit: pass",
    ],
)
def test_heavy_libraries_are_not_imported_before_they_are_needed(code: str) -> None:
    heavy = "{'torch', 'cv2', 'pandas', 'matplotlib', 'skimage', 'h5py'}"
    script = f"import sys\n{code}\nfound = {heavy} & set(sys.modules)\nassert not found, found"
    subprocess.run([sys.executable, "-c", script], check=True, capture_output=True)
