"""The table of known mistakes and the tests that guard against them agree (design/mistakes.md)."""

import ast
import re
from pathlib import Path

REPOSITORY = Path(__file__).resolve().parents[1]
MISTAKES = 23  # of method, section 10


def rows():
    """{number: names of tests} of the table."""
    found = {}
    for line in (REPOSITORY / "design" / "mistakes.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.split("|")]
        if len(cells) == 6 and cells[1].isdigit():
            assert int(cells[1]) not in found, f"two rows for mistake {cells[1]}"
            assert min(len(cells[2]), len(cells[3])) > 10, f"mistake {cells[1]} is not described"
            found[int(cells[1])] = re.findall(r"`(tests/\w+\.py::\w+)`", cells[4])
    return found


def names_of(path):
    """Names of the tests of a file."""
    return {
        node.name for node in ast.parse(path.read_text()).body if isinstance(node, ast.FunctionDef)
    }


def test_every_mistake_has_a_row_and_a_test():
    """One row each, from the first to the last, and no row without a test."""
    assert list(rows()) == list(range(1, MISTAKES + 1))
    assert [number for number, names in rows().items() if not names] == []


def test_every_test_of_the_table_exists():
    """A test that is renamed or deleted leaves a hole here."""
    known = {path.name: names_of(path) for path in (REPOSITORY / "tests").glob("test_*.py")}
    for number, names in rows().items():
        for name in names:
            file, _, test = name.removeprefix("tests/").partition("::")
            assert test in known.get(file, ()), f"mistake {number}: {name} does not exist"


def test_every_test_named_after_a_mistake_stands_in_its_row():
    """And in no other."""
    table = rows()
    for path in sorted((REPOSITORY / "tests").glob("test_mistakes_*.py")):
        for test in sorted(names_of(path)):
            number = re.match(r"test_mistake_(\d\d)_", test)
            if number:
                holders = [n for n, names in table.items() if f"tests/{path.name}::{test}" in names]
                assert holders == [int(number[1])], f"{path.name}::{test} stands in rows {holders}"
            else:
                assert not test.startswith("test_"), (
                    f"{path.name}::{test} is named after no mistake"
                )
