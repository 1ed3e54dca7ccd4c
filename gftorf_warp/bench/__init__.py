"""What things cost: the parts of ``gftorf bench``, one file each. Imports every room; no room imports it."""
