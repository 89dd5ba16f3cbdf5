"""Effect of each defense's settings against attackers that know them, over seeds to show the random variation."""

from attacks.blank import Blank
from attacks.context import Context
from attacks.database import Database
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.lattice import Lattice
from bench.runner.suite import Suite, grid
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

DIMS = (2, 4, 8, 16)
EPSILONS = (8, 10, 12, 14, 16)
SIZES = (1, 2, 4)  # words released per keypoint

SUITE = Suite(
    summary="dimensions of subspaces, epsilons and subset sizes, over three seeds",
    parts=grid(
        defenses=[
            Undefended(),
            *(Affine(dim=dim) for dim in DIMS),
            *(LDP(epsilon=epsilon, subset_size=size) for epsilon in EPSILONS for size in SIZES),
        ],
        attacks=[DIA(), Context(), Database(), Lattice(), Blank(), Keypoints()],
        seeds=range(3),
    ),
)
