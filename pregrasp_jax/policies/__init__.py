"""Who decides the next push: scripts, exploration, learned policies."""
