"""The program `pregrasp-jax`."""
