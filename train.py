"""`python train.py ...` is `pregrasp-jax train ...`."""

import sys

from pregrasp_jax.cli.main import main

if __name__ == "__main__":
    sys.exit(main(["train", *sys.argv[1:]]))
