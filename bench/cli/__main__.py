"""Entry point of `python -m bench.cli`, which is equivalent to `bench`."""

import sys

from bench.cli import main

sys.exit(main())
