"""docs/cameras/: every kind of recording has a page, whose keys, commands and errors are valid."""

import re
import shlex
import tomllib
from pathlib import Path

import pytest

from gftorf_warp import options
from gftorf_warp.importers.keys import load, template
from gftorf_warp.importers.kinds import KINDS

REPOSITORY = Path(__file__).parents[1]
PAGES = {page.stem: page.read_text("utf-8") for page in (REPOSITORY / "docs/cameras").glob("*.md")}


@pytest.mark.parametrize("name", PAGES)
def test_keys_of_a_page_are_those_of_its_kind(name, tmp_path):
    """All that are needed are there, and none is unknown."""
    for text in re.findall(r"```toml\n(.*?)```", PAGES[name], re.DOTALL):
        path = tmp_path / "keys.toml"
        path.write_text(text)
        assert tomllib.loads(text)
        load(path, KINDS[name].keys).require()


def test_every_kind_has_a_page():
    """That of arrays is docs/import.md; the index leads to all."""
    assert set(PAGES) == KINDS.keys() - {"arrays"}
    index = (REPOSITORY / "docs" / "cameras.md").read_text(encoding="utf-8")
    for name in PAGES:
        assert f"| [`{name}`](cameras/{name}.md) |" in index
        assert f"\ncameras/{name}\n" in index


@pytest.mark.parametrize("name", PAGES)
def test_a_page_begins_with_the_whole_way(name):
    """Title, then commands from the import to the viewer, each with options that exist."""
    title, block, _ = PAGES[name].split("```", 2)
    assert title.startswith(f"# `{name}`: ")
    lines = [shlex.split(line) for line in block.splitlines() if line.startswith("gftorf ")]
    expected = ["import", "check", "reconstruct", "compare", "export", "view"]
    assert [words[1] for words in lines] == expected
    assert lines[0][2] == name
    for words in lines:
        options.parse(words[1:])
    assert ("--config" in block) <= ("```toml\n" in PAGES[name])


@pytest.mark.parametrize("name", PAGES)
def test_errors_of_a_page_are_those_of_the_source(name):
    """Word by word, in the readers."""
    readers = (REPOSITORY / "gftorf_warp" / "importers").glob("*.py")
    source = "".join(path.read_text(encoding="utf-8") for path in readers)
    source = source.replace("{form}", name)
    named = re.findall(r"^\| `(.*?)` \|", PAGES[name].partition("| error |")[2], re.MULTILINE)
    assert named
    for what in named:
        assert f'"{what}"' in source, what


@pytest.mark.parametrize("name", PAGES)
def test_a_template_that_is_filled_in_is_valid(name, tmp_path):
    """Needed keys take the values that they show as examples."""
    path, text = tmp_path / "keys.toml", template(name, KINDS[name].keys)
    for key in KINDS[name].keys:
        word = key.name.rpartition(".")[2]
        text = text.replace(f"\n# {word} = ", f"\n{word} = ") if key.needed else text
    path.write_text(text)
    load(path, KINDS[name].keys).require()
