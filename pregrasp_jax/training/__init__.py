"""Training: actors collect, the learner learns, the run folder remembers; `session.train` puts them together."""
