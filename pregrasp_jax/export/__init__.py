"""Policies as bundles of files that say what every number means, and that run without JAX."""
