"""What the documentation site makes from the code and from the pages of the repository.
`.ci/run` builds it, with every warning an error.
"""

import dataclasses
import importlib.util
import re
from pathlib import Path, PurePosixPath

import pytest

import gftorf_warp
from gftorf_warp import options
from gftorf_warp.data import capture_write
from gftorf_warp.recon import state
from gftorf_warp.recon.settings import ReconSettings, Weights
from gftorf_warp.scene.sensor import Sensor

pytest.importorskip("sphinx", reason="the extra `docs` is not installed")
REPOSITORY = Path(__file__).parents[1]


def load(name):
    """A module of docs/, which is no package."""
    spec = importlib.util.spec_from_file_location(name, REPOSITORY / "docs" / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


reference, repository = load("reference"), load("repository")


def test_every_option_is_in_the_reference():
    """Those of one command are in its section, common ones at the top."""
    top, *sections = reference.commands().split("\n## gftorf ")
    assert "`-q, --quiet`" in top
    sections = {text.partition("\n")[0]: text for text in sections}
    for name, parser in options.command_parsers().items():
        for option in re.findall(r"^  (?:-\w, )?(--[\w-]+)", parser.format_help(), re.MULTILINE):
            assert f"{option} " in sections[name].replace("`", " ") or option in top, option


def test_settings_have_default_unit_and_meaning():
    """Every field, parts of parts too; enumerations list their members."""
    text = reference.settings()
    for name in (field.name for field in dataclasses.fields(Weights)):
        assert f"| `weights.{name}` |" in text, name
    for name in (field.name for field in dataclasses.fields(Sensor) if field.name != "pattern"):
        assert re.search(rf"\| `sensor\.{name}` \| \S+ \| [^|]*\| \w", text), name
    exposure = Sensor().exposure_s
    assert f"| `sensor.exposure_s` | `{exposure:g}` | s | Length of one exposure;" in text
    assert f"`{ReconSettings(preset='').flow}`" in text


def test_errors_are_read_from_the_source():
    """What, why and fix, also where they were given names before."""
    text = reference.refusals()
    assert "| h5py is not installed | HDF5 files need the package h5py |" in text
    assert "| unknown command … | there are … |" in text
    assert len(text.splitlines()) > 150


@pytest.mark.parametrize(
    ("page", "link", "expected"),
    [
        ("compare", "../design/accuracy.md", "generated/design/accuracy.md"),
        ("generated/design/accuracy", "../docs/compare.md", "../../compare.md"),
        ("generated/CHANGELOG", "docs/import.md", "../import.md"),
        ("generated/design/README", "tiles.md", "tiles.md"),
        ("generated/CONTRIBUTING", "README.md", "../index.md"),
        ("library", "../LICENSE", "../LICENSE"),
    ],
)
def test_links_lead_to_pages_of_the_site(page, link, expected):
    """From docs/ out, from copied pages back, and to files that are no pages; anchors stay."""
    source = [f"see [it]({link}#there), [more]({link}) and [them](https://example.org/a.md)"]
    repository.resolve_links(None, page, source)
    there = f"see [it]({expected}#there), [more]({expected}) and [them](https://example.org/a.md)"
    assert source == [there]


def test_links_of_pages_that_are_made_stay():
    """They are written for the site."""
    source = ["[Presets](../presets.md)"]
    repository.resolve_links(None, "generated/settings", source)
    assert source == ["[Presets](../presets.md)"]
    assert repository.place_of("docs/view.md") == PurePosixPath("view.md")


def test_stated_versions_are_those_of_the_code():
    """The table of file formats, and the citation."""
    page = (REPOSITORY / "docs" / "versions.md").read_text(encoding="utf-8")
    assert f"| `version` | {capture_write.VERSION} | 1.x |" in page
    assert f"| `format` | {state.FORMAT} | 1 to {state.FORMAT} |" in page
    citation = (REPOSITORY / "CITATION.cff").read_text(encoding="utf-8")
    assert f"\nversion: {gftorf_warp.__version__}\n" in citation
