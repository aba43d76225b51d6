"""`python -m pregrasp_jax ...` is `pregrasp-jax ...`."""

import sys

from pregrasp_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main())
