"""The problem as data, losses, held-out rays, and the optimiser."""
