"""Reconstruction and localization of the same queries, with the same images, words, ε and m."""

from attacks.blank import Blank
from attacks.dia import DIA
from attacks.keypoints import Keypoints
from attacks.lattice import Lattice
from attacks.oracle import Oracle
from bench.datasets.gallery import Gallery
from bench.runner.suite import Suite, grid
from bench.settings import Asset
from bench.tasks.localization import Localization
from bench.tasks.reconstruction import Reconstruction
from defenses.affine import Affine
from defenses.ldp import LDP
from defenses.none import Undefended

DIMS = (4, 16)
EPSILONS = (8, 10, 12, 14, 16)
SIZES = (1, 2, 4)  # words released per keypoint, at ε = 10

SUITE = Suite(
    summary="reconstruction and localization of the same queries of a gallery, with the shipped dictionary",
    parts=grid(
        defenses=[
            Undefended(),
            *(Affine(dim=dim) for dim in DIMS),
            *(LDP(epsilon=epsilon, dictionary=Asset("shipped")) for epsilon in EPSILONS),
            *(LDP(epsilon=10, subset_size=size, dictionary=Asset("shipped")) for size in SIZES if size != LDP.subset_size),
        ],
        attacks=[DIA(), Oracle(), Lattice(), Blank(), Keypoints()],
        tasks=[Reconstruction(), Localization()],
        datasets=[Gallery(queries=50, night=0.0)],
    ),
)
