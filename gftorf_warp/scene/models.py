"""All motion models: a new one is a class of :class:`Motion` in its own file, listed here."""

from __future__ import annotations

from typing import Any

from ..errors import InputError
from .motion import Motion, Nodes, Still
from .network import Network
from .rigid_nodes import RigidNodes
from .spline import Spline
from .windows import Windows

MODELS: tuple[type[Motion], ...] = (Still, Nodes, Network, Spline, RigidNodes, Windows)
KINDS = {model.kind: model for model in MODELS}


def motion_from_dict(stored: dict[str, Any]) -> Motion:
    """The model that :meth:`Motion.to_dict` stored.

    Raises:
        InputError: If its kind is unknown.
    """
    kind = stored.get("kind")
    if kind not in KINDS:
        raise InputError(
            f"unknown motion model {kind!r}",
            where="checkpoint",
            why=f"this version has the models {', '.join(KINDS)}",
            fix="use the version of gftorf_warp that wrote the run, or reconstruct again",
        )
    return KINDS[kind].from_dict(stored)
