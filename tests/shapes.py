"""The checker of `--jaxtyping-packages=...,shapes.checked`: beartype, to which an int is a float,
as in PEP 484.
"""

from beartype import BeartypeConf, beartype

checked = beartype(conf=BeartypeConf(is_pep484_tower=True))
