"""Numbers and pictures of a finished run."""
