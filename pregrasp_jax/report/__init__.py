"""The report of a run: one HTML page that needs no network, no script and no other file.

Reads what a run folder holds and what evaluations wrote; pictures of episodes are handed in, because the
policies that play them belong to a later stage.
"""

from pregrasp_jax.report.films import Film, Step
from pregrasp_jax.report.page import build_page, write_films, write_report
from pregrasp_jax.report.record import RunRecord, read_run
from pregrasp_jax.report.results import load_evaluations

__all__ = ["Film", "RunRecord", "Step", "build_page", "load_evaluations", "read_run", "write_films", "write_report"]
