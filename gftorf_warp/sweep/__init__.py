"""``gftorf sweep``: scenes x presets x settings x seeds, on one machine or on a cluster.

plan      what a TOML file lists: scenes, rows and the jobs of both
job       one job: simulate a scene, or reconstruct it and score the result
workers   processes of this machine, each with its device and its CPUs
cluster   the same jobs on a Dask cluster
table     means and spreads over seeds, as Markdown and as a page with pictures
command   all of it, resumable
"""
