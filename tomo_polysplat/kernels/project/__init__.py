"""Line integrals of Gaussians over the detector."""
