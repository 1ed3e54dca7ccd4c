"""Foreign recordings as sequences: a reader for each kind of source, and its keys."""
