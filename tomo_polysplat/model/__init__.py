"""What is unknown: the Gaussians, how they are seeded and, where of no use, moved elsewhere."""
