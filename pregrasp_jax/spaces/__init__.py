"""What is said about the task without simulating it: grid, actions, workspace."""
