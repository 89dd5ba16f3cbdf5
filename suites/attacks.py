"""Every attack against every defense that it applies to: which one is the strongest."""

from bench.registry import discovery, fields
from bench.runner.suite import Suite, grid
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended

SUITE = Suite(
    summary="every attack, those of installed packages too, against every defense that it applies to",
    parts=grid(
        defenses=[Undefended(), Affine(), LDP(), LDP(epsilon=16), NaiveLDP()],
        attacks=[attack() for attack in discovery.load_plugins(discovery.ATTACK) if not fields.list_required(attack)],
    ),
)
