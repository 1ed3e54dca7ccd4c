"""Text files that others may have written: JSON, TOML and lines of JSON, read within limits."""

from __future__ import annotations

import itertools
import json
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import InputError
from .untrusted import DEPTH_MAX, TEXT_MAX, TOML_MAX, read_text


def read_json(path: Path) -> Any:
    """Content of a JSON file.

    Raises:
        InputError: As :func:`read_text`, or if it is no JSON.
    """
    return _parsed(path, json.loads, "no JSON")


def read_toml(path: Path) -> dict[str, Any]:
    """Content of a TOML file, which is small.

    Raises:
        InputError: As :func:`read_text`, or if it is no TOML.
    """
    return _parsed(path, tomllib.loads, "no TOML file", TOML_MAX)


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of metrics.jsonl or diagnostics.jsonl, numbers and nulls by name; none without the file.

    A last line without an end was cut off by a crash and does not count.

    Raises:
        InputError: As :func:`read_json`; the message has the number of the line.
    """
    if not path.exists():
        return []
    rows = []
    for number, line in enumerate(read_text(path).splitlines(keepends=True), start=1):
        if not line.endswith("\n"):
            break
        row = _loads(line)
        if not _is_row(row):
            text = repr(line[:80].strip())
            why = f"expected an object of images and other numbers in line {number}, found {text}"
            raise InputError("not a row", where=path, why=why, fix="remove that line")
        rows.append(row)
    return rows


def _parsed(path: Path, parse: Callable[[str], Any], what: str, most: int = TEXT_MAX) -> Any:
    text = read_text(path, most)
    try:
        content = parse(text)
        if (depth := _depth(content)) > DEPTH_MAX:
            raise ValueError(f"{depth} nested lists and tables, at most {DEPTH_MAX} are read")
        return content
    except (ValueError, RecursionError) as error:
        why = str(error)[:200]
        raise InputError(what, where=path, why=why, fix="correct the file") from error


def _depth(content: Any) -> int:
    """Number of lists and tables within each other; without recursion, which has a limit."""
    depth, level = 0, [content]
    while level := [part for part in level if isinstance(part, (list, dict))]:
        depth += 1
        parts = (part.values() if isinstance(part, dict) else part for part in level)
        level = [*itertools.chain.from_iterable(parts)]
    return depth


def _loads(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _is_row(row: object) -> bool:
    """Whether it is an object of finite numbers and nulls, with the number of images."""
    if not isinstance(row, dict) or row.get("images") is None:
        return False
    known = [value for value in row.values() if value is not None]
    return all(isinstance(value, (int, float)) and math.isfinite(value) for value in known)
