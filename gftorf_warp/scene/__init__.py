"""What is optimised, and what observes it: Gaussians, motion, camera, sensor."""
