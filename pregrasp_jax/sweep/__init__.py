"""Sweeps: many trainings from one YAML, on one machine, a Ray cluster or SLURM; see docs/sweeps.md.

Every trial is an ordinary run folder, trained by the ordinary command line in a process of its own. What drives them
imports neither JAX nor MuJoCo.
"""
