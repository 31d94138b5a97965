"""Gaussians sampled on a voxel grid."""
