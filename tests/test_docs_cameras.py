"""docs/cameras.md: its files of keys are valid, and every camera has a section."""

import re
import tomllib
from pathlib import Path

import pytest

from gftorf_warp.importers.keys import load
from gftorf_warp.importers.kinds import KINDS

PAGE = (Path(__file__).parents[1] / "docs" / "cameras.md").read_text(encoding="utf-8")
SECTIONS = {
    section.partition("`")[2].partition("`")[0]: section for section in PAGE.split("\n## ")[1:]
}


@pytest.mark.parametrize("name", SECTIONS)
def test_keys_of_a_section_are_those_of_its_kind(name, tmp_path):
    """All that are needed are there, and none is unknown."""
    kind = KINDS[name]
    assert f"gftorf import {name} " in SECTIONS[name]
    for text in re.findall(r"```toml\n(.*?)```", SECTIONS[name], re.DOTALL):
        path = tmp_path / "keys.toml"
        path.write_text(text)
        assert tomllib.loads(text)
        load(path, kind.keys).require()
