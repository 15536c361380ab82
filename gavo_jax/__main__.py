"""`python -m gavo_jax`: the command `gavo`."""

import sys

from gavo_jax.cli import main

if __name__ == "__main__":
    sys.exit(main())
