"""What is unknown: the Gaussians, how they are seeded, added and removed."""
