"""The volume a fit starts from: FDK, SIRT and the water pre-correction."""
