"""What a step of the optimiser does between projecting and voxelising, as few CUDA kernels."""
