"""`python evaluate.py ...` is `pregrasp-jax evaluate ...`."""

import sys

from pregrasp_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["evaluate", *sys.argv[1:]]))
