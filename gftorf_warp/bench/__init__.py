"""The parts of ``gftorf bench``, one file each. May import every package;
only the command line imports it.
"""
