"""The factor of the number of examples that hypothesis draws: `tools/soak.py` sets it. Examples are the same in each run of 1."""

import os

EFFORT = int(os.environ.get("SOAK_EFFORT", "1"))
