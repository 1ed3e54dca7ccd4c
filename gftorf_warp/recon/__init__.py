"""What the camera must have seen: Gaussians and their motion, fitted to raw quads."""
