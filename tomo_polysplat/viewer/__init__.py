"""A local page with linked slices of results, served to the browser of this machine alone."""
