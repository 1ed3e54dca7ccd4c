"""What is optimised, and who looks: Gaussians, motion, camera, sensor."""
