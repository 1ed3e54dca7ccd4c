"""Binary PLY files of vertices, from a table with a name and a type per property."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

TYPES = {"<f4": "float", "|u1": "uchar"}


def ply_bytes(vertices: np.ndarray, comments: Iterable[str] = ()) -> bytes:
    """A little-endian PLY file.

    Args:
        vertices: [N] of a structured type whose fields are float32 or uint8, in the order of the
            file; float32 for a place in metres.
        comments: Lines of the header, ASCII.

    Raises:
        ValueError: If a field has another type.
    """
    properties = []
    for name, kind, *_ in vertices.dtype.descr:
        if kind not in TYPES:
            raise ValueError(f"{name} is {kind}, a PLY file here holds {', '.join(TYPES)}")
        properties.append(f"property {TYPES[kind]} {name}")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {line}" for line in comments),
        f"element vertex {len(vertices)}",
        *properties,
        "end_header",
    ]
    return "\n".join(header).encode("ascii") + b"\n" + vertices.tobytes()


def table(columns: dict[str, np.ndarray]) -> np.ndarray:
    """A structured array [N] of columns [N] by name, uint8 as they are and all others float32."""
    kinds = {n: "u1" if column.dtype == np.uint8 else "<f4" for n, column in columns.items()}
    rows = np.empty(len(next(iter(columns.values()))), dtype=list(kinds.items()))
    for name, column in columns.items():
        rows[name] = column
    return rows
