"""Every `gftorf simulate` line of README.md, the gallery, the quick start and docs/simulate.md is
run at a tiny size; other commands are parsed.
"""

import re
import shlex
from pathlib import Path

import pytest

from gftorf_warp import Sequence, cli, options
from gftorf_warp.sim.ladder import NAMES

REPOSITORY = Path(__file__).parents[1]
PAGES = "".join(
    (REPOSITORY / name).read_text(encoding="utf-8")
    for name in ("README.md", "docs/gallery.md", "docs/quick-start.md", "docs/simulate.md")
)
LINES = sorted(
    {
        line.partition("#")[0].strip()
        for line in re.findall(r"(?:^|`)(gftorf [^`\n]*)", PAGES, re.MULTILINE)
    }
)
SIMULATE = [
    line
    for line in LINES
    if line.startswith("gftorf simulate ") and "--out" in line and "SCENE" not in line
]


@pytest.mark.parametrize("line", SIMULATE)
def test_a_simulation_of_the_pages_runs(line, tmp_path, monkeypatch):
    """As it is printed, but for size, number of raw frames and folder; with its truth."""
    monkeypatch.chdir(REPOSITORY)
    words = shlex.split(line)[1:]
    words[words.index("--out") + 1] = out = str(tmp_path / "seq")
    assert cli.main([*words, "--size", "16x12", "--frames", "8", "-q"]) == 0
    folder = Path(out) / NAMES[-1] if "--ladder" in words else Path(out)
    sequence = Sequence.open(folder)
    assert sequence.quads.shape == (8, 12, 16)
    assert sequence.truth() is not None
    assert (folder / "contact_sheet.png").is_file()
    if "--truth" in words:
        assert {"phasor.1", "z_depth", "normal", "ambient"} <= set(sequence.truth().layers)
    wanted = {
        "--format capture": (folder / "capture.json").is_file(),
        "--format torf": sequence.from_phasors,
        "--flow": bool(sequence.flow.forward),
    }
    assert all(written for option, written in wanted.items() if option in line)


def test_the_pages_show_everything_that_can_be_simulated():
    """Meshes, gloss, blur, bounces, sensors, levels, captures, phasors, resuming;
    every option of the command.
    """
    for word in (
        ".toml",
        "--engine mesh",
        "gloss",
        "--exposure-samples",
        "--bounces",
        "sensor=",
        "--level",
        "--ladder",
    ):
        assert any(word in line for line in SIMULATE), word
    for word in (
        "--format capture",
        "--format torf",
        "--truth all",
        "ambient",
        "--override emitter",
    ):
        assert any(word in line for line in SIMULATE), word
    for word in ("--list", "seq.partial", "--fresh"):
        assert word in PAGES, word
    from gftorf_warp.sim.sensors import SENSORS

    assert all(f"`{name}`" in PAGES for name in SENSORS)


def test_printed_commands_can_be_parsed():
    """Options that are printed exist."""
    commands = options.command_parsers()
    typed = [
        line
        for line in LINES
        if "COMMAND" not in line and "SCENE" not in line and shlex.split(line)[1] in commands
    ]
    assert len(typed) > 20
    for line in typed:
        words = shlex.split(line)[1:]
        if len(words) > 1 and not any(word.isupper() for word in words):
            assert options.parse(words).command == words[0], line


def test_links_of_the_readme_lead_to_files():
    """Those of all other pages are checked by the build of the site."""
    text = (REPOSITORY / "README.md").read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#]+)#?([^)]*)\)", text)
    assert len(links) > 20
    assert [path for path, _ in links if not (REPOSITORY / path).is_file()] == []
    for path, anchor in links:
        if anchor:
            page = (REPOSITORY / path).read_text(encoding="utf-8").lower().replace(" ", "-")
            assert re.search(rf"^#+-{anchor}$", page, re.MULTILINE), f"{path}#{anchor}"
