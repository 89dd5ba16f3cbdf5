"""Provenance lists the shipped files of records and plugins, and is written with pages and pictures."""

import shutil
from pathlib import Path

import pytest
from fakes import write_album
from PIL import Image

from attacks.dia import DIA
from attacks.keypoints import Keypoints
from bench import cli
from bench.codebook.public import ASSETS, Public
from bench.extractors.sift import Sift
from bench.formats import tensor_file
from bench.registry import spec
from bench.settings import Asset
from defenses.affine import Affine
from defenses.none import Undefended
from leaderboard import provenance

DICTIONARY, NETWORK = "dictionary.safetensors", "inversion-affine.safetensors"


def test_files_are_those_that_the_plugins_refer_to() -> None:
    public = Public()

    def list_files(defense: Affine | Undefended, attack: DIA | Keypoints | None = None) -> list[str]:
        configurations = [spec.to_json_with_digests(defense, public)]
        if attack is not None:
            configurations.append(spec.to_json_with_digests(attack, public, attack.assets(defense, Sift(), public)))
        return list(provenance.list_shipped_files(configurations))

    assert list_files(Undefended()) == []
    assert list_files(Affine()) == [DICTIONARY]
    assert list_files(Affine(), DIA()) == [DICTIONARY, NETWORK]
    assert list_files(Undefended(), Keypoints()) == ["positions.safetensors"]
    assert list_files(Affine(database=Asset("shipped-public"))) == ["public-database.safetensors"]


def test_digest_is_that_of_the_content() -> None:
    digests = provenance.read_digests()
    assert digests.keys() == {path.name for path in ASSETS.glob("*.safetensors")}
    _, _, digest = tensor_file.load(ASSETS / "positions.safetensors", "inversion-network")
    assert digests["positions.safetensors"] == digest


def test_results_are_stale_once_a_file_is_replaced(tmp_path: Path) -> None:
    public, name = Public(), "positions.safetensors"
    configuration = spec.to_json_with_digests(Keypoints(), public, Keypoints().assets(Undefended(), Sift(), public))
    page = "# Title\n\n" + provenance.format_provenance("bench run", [configuration])
    shutil.copyfile(ASSETS / name, tmp_path / name)
    assert provenance.list_stale(page, tmp_path) == []
    arrays, meta, _ = tensor_file.load(tmp_path / name, "inversion-network")
    tensor_file.save(tmp_path / name, "inversion-network", arrays, meta | {"another": True})
    (message,) = provenance.list_stale(page, tmp_path)
    assert message.startswith(f"{name}: used {provenance.shorten(provenance.read_digests()[name])}, shipped is ")


def test_a_page_may_use_no_file() -> None:
    page = provenance.format_provenance("bench reproduce table2", [{"name": "none"}])
    assert provenance.NO_FILE in page
    assert provenance.list_stale(page) == []


@pytest.mark.slow
def test_figures_of_a_run_hold_their_provenance(tmp_path: Path) -> None:
    write_album(tmp_path / "photos", 1)
    words = ["run", "--defense", "none", "--attack", "keypoints", "--images", str(tmp_path / "photos")]
    assert cli.main([*words, "--out", str(tmp_path / "out")]) == 0
    (figure,) = (tmp_path / "out" / "figures").iterdir()
    text = Image.open(figure).info[provenance.CHUNK]
    assert f"```\nbench {' '.join(words)}\n```" in text
    assert "| `positions.safetensors` |" in text
    assert provenance.list_stale(text) == []
