"""Compiled and reference implementations of projecting and voxelising Gaussians."""
