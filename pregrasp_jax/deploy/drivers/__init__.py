"""Arms and grippers: dry ones that say what they would do, and real ones."""
