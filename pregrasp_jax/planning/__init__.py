"""A search that decides, in a scene rebuilt from what the camera sees."""
