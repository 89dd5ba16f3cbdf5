"""Suites of attacks: versioned lists of attacks at fixed settings, for `bench run --attack standard-2026.3`.

A suite is the file suites/NAME-VERSION.toml. It fixes all fields of its attacks except files: a network is trained for a
defense, so its file differs. Records are of single attacks, so they do not depend on the suite. Comparing the attacks of
records with those of the suite shows whether a defense has its results.
"""

from __future__ import annotations

import functools
import importlib.resources
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from bench.api import Attack
from bench.core.errors import UserError, unknown_name
from bench.registry import discovery, fields, spec
from bench.runner.suite import PACKAGE

SUFFIX = ".toml"


@dataclass(frozen=True, kw_only=True)
class AttackSuite:
    """The attacks of one version of a suite."""

    name: str  # with the version
    summary: str
    specs: tuple[str, ...]  # one per attack, as on the command line

    @property
    def names(self) -> set[str]:
        """The names of the attacks."""
        return {text.partition(":")[0] for text in self.specs}

    def build_attacks(self) -> list[Attack]:
        """Return the attacks.

        Raises
        ------
        UserError
            if an attack has a field that the suite does not fix: the suite is of another version of this software.
        """
        attacks: list[Attack] = []
        for text in self.specs:
            attack = spec.read(text, discovery.ATTACK)
            loose = spec.to_json(attack).keys() - fields.list_assets(attack).keys() - _fix_settings(text).keys()
            if loose:
                raise UserError(
                    f"{self.name} does not fix {', '.join(sorted(loose))} of {attack.name()}: choose a later version of the suite"
                )
            attacks.append(attack)
        return attacks

    def find_spec(self, attack: Mapping[str, Any]) -> str | None:
        """Return the attack of the suite that has the name and settings of a record's attack, files aside; None if none has."""
        return next((text for text in self.specs if _has_settings(attack, text)), None)


def list_attack_suites() -> list[str]:
    """Return the names of all suites of attacks, in ascending order of the versions."""
    files = importlib.resources.files(PACKAGE).iterdir()
    return sorted((file.name.removesuffix(SUFFIX) for file in files if file.name.endswith(SUFFIX)), key=_split_version)


@functools.cache
def find(name: str) -> AttackSuite:
    """Return a suite of attacks.

    Raises
    ------
    UserError
        if there is no such suite.
    """
    if name not in list_attack_suites():
        raise unknown_name("suite of attacks", name, list_attack_suites())
    content = tomllib.loads((importlib.resources.files(PACKAGE) / f"{name}{SUFFIX}").read_text(encoding="utf-8"))
    return AttackSuite(name=name, summary=content["summary"], specs=tuple(content["attacks"]))


def read_attacks(texts: Sequence[str]) -> list[Attack]:
    """Return the attacks that texts specify, with each suite replaced by its attacks. The name of a suite has a point.

    Raises
    ------
    UserError
        if there is no such attack or suite, or a specification is wrong.
    """
    attacks: list[Attack] = []
    for text in texts:
        attacks += find(text).build_attacks() if is_suite(text) else [spec.read(text, discovery.ATTACK)]
    return attacks


def is_suite(text: str) -> bool:
    """Return whether a text names a suite of attacks and not an attack: its name has a point.

    >>> is_suite("standard-2026.3"), is_suite("density:width=0.5")
    (True, False)
    """
    return "." in text.partition(":")[0]


@functools.cache
def _fix_settings(text: str) -> dict[str, Any]:
    """Return the name and the fields that a specification fixes, as records hold them."""
    plugin, given = spec.parse(text, discovery.ATTACK)
    settings = spec.to_json(spec.build(plugin, given))
    return {name: settings[name] for name in ("name", *given)}


def _has_settings(attack: Mapping[str, Any], text: str) -> bool:
    fixed = _fix_settings(text)
    if attack["name"] != fixed["name"]:
        return False
    files = fields.list_assets(spec.read(text, discovery.ATTACK))
    return {name: value for name, value in attack.items() if name not in files and not _is_digest(name, value)} == fixed


def _is_digest(name: str, value: Any) -> bool:
    """Return whether an entry of a record's attack is no field: the digest of a file, or the network that inverts its result."""
    return name == "inversion" or str(value).startswith("sha256:")


def _split_version(name: str) -> tuple[str, list[int]]:
    stem, _, version = name.rpartition("-")
    return stem, [int(number) for number in version.split(".")]
