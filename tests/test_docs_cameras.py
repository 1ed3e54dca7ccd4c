"""docs/cameras.md: its files of keys are valid, and every camera has a section."""

import re
import tomllib
from pathlib import Path

import pytest

from gftorf_warp.importers.keys import load, template
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


def test_every_camera_has_a_section():
    """All kinds but those of arrays and of our own layouts."""
    assert set(SECTIONS) == KINDS.keys() - {"arrays", "ftorf", "torf"}


@pytest.mark.parametrize("name", SECTIONS)
def test_a_template_that_is_filled_in_is_valid(name, tmp_path):
    """Needed keys take the values that they show as examples."""
    path, text = tmp_path / "keys.toml", template(name, KINDS[name].keys)
    for key in KINDS[name].keys:
        word = key.name.rpartition(".")[2]
        text = text.replace(f"\n# {word} = ", f"\n{word} = ") if key.needed else text
    path.write_text(text)
    load(path, KINDS[name].keys).require()
