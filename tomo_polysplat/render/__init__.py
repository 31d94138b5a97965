"""Gaussians to rays and to voxels, through whichever kernel fits the device."""
