"""Spectra, materials and the polychromatic transmission of a ray; knows no Gaussians."""
