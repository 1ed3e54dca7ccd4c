"""Text files that others may have written: JSON, TOML and lines of JSON, read within limits."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..errors import InputError
from .untrusted import TEXT_MAX, read_text

TOML_MAX = 1 << 20  # a table of keys has a few hundred


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
    """Rows of a .jsonl file, objects of numbers and nulls; none without the file.

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
        if not isinstance(row, dict) or not all(map(_is_number, row.values())):
            why = f"expected a JSON object of numbers in line {number}, found {line[:80].strip()!r}"
            raise InputError("not a row", where=path, why=why, fix="remove that line")
        rows.append(row)
    return rows


def _parsed(path: Path, parse: Callable[[str], Any], what: str, most: int = TEXT_MAX) -> Any:
    text = read_text(path, most)
    try:
        return parse(text)
    except (ValueError, RecursionError) as error:
        why = str(error)[:200]
        raise InputError(what, where=path, why=why, fix="correct the file") from error


def _loads(line: str) -> Any:
    try:
        return json.loads(line)
    except (ValueError, RecursionError):
        return None


def _is_number(value: object) -> bool:
    return value is None or isinstance(value, (int, float))
