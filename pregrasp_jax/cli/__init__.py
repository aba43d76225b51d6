"""What the command lines do: `evaluate.py` and `python -m pregrasp_jax`."""
