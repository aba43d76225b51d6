"""Objects as convex hulls: the built-in catalogue, folders of meshes, and the bank that holds them."""
