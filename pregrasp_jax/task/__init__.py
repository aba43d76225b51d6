"""The task: pushes, rules and the environment that puts them together."""
