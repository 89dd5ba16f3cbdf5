"""Every attack against the paper's defenses, to find the strongest attack on each."""

from bench.registry import discovery, fields
from bench.runner.suite import Suite, grid
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.naive_ldp import NaiveLDP
from defenses.none import Undefended

SUITE = Suite(
    summary="every attack, those of installed packages too, against the paper's defenses",
    parts=grid(
        defenses=[Undefended(), Affine(), LDP(), LDP(epsilon=16), NaiveLDP()],
        attacks=[attack() for attack in discovery.load_plugins(discovery.ATTACK) if not fields.list_required(attack)],
    ),
)
