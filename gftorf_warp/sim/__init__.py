"""What the camera would have seen: moving worlds, rendered one raw frame at a time, and read out with noise."""
