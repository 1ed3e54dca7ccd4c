"""The viewer: ``gftorf view``."""
