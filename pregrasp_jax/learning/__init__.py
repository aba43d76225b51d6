"""Networks, replay and the learner."""
