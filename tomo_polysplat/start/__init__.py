"""The volume a fit starts from: FDK or SIRT, bridged at metal."""
