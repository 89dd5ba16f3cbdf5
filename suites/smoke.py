"""A run of a few seconds: one defense per kind of release, and the fastest attacks."""

from attacks.blank import Blank
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.nearest import Nearest
from bench.images import photographs
from bench.runner.suite import Suite, grid
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

SUITE = Suite(
    summary="one photograph, in seconds: a check of the installation",
    parts=grid(
        defenses=[Undefended(), Affine(), LDP()],
        attacks=[Blank(), Keypoints(), DIA(), Nearest()],
        images=[source for source in photographs.list_builtin() if source.name == "rocket"],  # the one with the fewest keypoints
    ),
)
