"""Losses, held-out rays, the plan of what a scene needs, and the optimiser."""
