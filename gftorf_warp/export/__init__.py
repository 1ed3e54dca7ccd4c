"""A finished run as files for other programs; one file of this package per format."""
