"""Sequences on disk, and what they are in memory."""
