"""docs/import.md is followed word by word; only the number of optimised images is smaller."""

import importlib.util
import re
import shlex
from pathlib import Path

import numpy as np
import pytest

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.data.decode import closed_form_distance
from gftorf_warp.importers.arrays import KEYS

REPOSITORY = Path(__file__).parents[1]
PAGE = (REPOSITORY / "docs" / "import.md").read_text(encoding="utf-8")


def blocks(language):
    """Code blocks of the page in a language, "" for commands."""
    found = re.findall(r"^```(\w*)\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)
    return [text for name, text in found if name == language]


def commands():
    """The lines of the walk-through, without those with words in capitals."""
    lines = [line for block in blocks("") for line in block.splitlines()]
    return [line for line in lines if not re.search(r"\b[A-Z]{3,}\b", line)]


@pytest.fixture(scope="module")
def followed(tmp_path_factory):
    """The folder in which all commands were run, and the recording that the quads are of."""
    folder = tmp_path_factory.mktemp("page")
    (folder / "quads.toml").write_text(blocks("toml")[0])
    patch = pytest.MonkeyPatch()
    patch.chdir(folder)
    recording = None
    for line in commands():
        words = shlex.split(line)
        if words[0] == "python":
            spec = importlib.util.spec_from_file_location("example", REPOSITORY / words[1])
            example = importlib.util.module_from_spec(spec)
            spec.loader.exec_module(example)
            recording = example.main(Path(words[2]))
            continue
        assert words[0] == "gftorf", line
        fewer = ["--images", "8", "--set", "fallback=false"] if line.endswith("--out run") else []
        times = ["--times", "0,0.1"] if words[1] == "render" else []
        assert main([*words[1:], *fewer, *times]) == 0, line
    patch.undo()
    return folder, recording


def test_the_page_leads_to_distance(followed):
    """Its commands run, and the closed form of the capture is that of the simulated quads."""
    folder, recording = followed
    found = Sequence.open(folder / "sequence")
    assert found.frames == recording.frames
    np.testing.assert_allclose(found.times, recording.times, atol=1e-9)
    np.testing.assert_allclose(found.shifts, recording.shifts, atol=1e-9)
    ours, theirs = found.intrinsics, recording.intrinsics
    for name in ("fx", "fy", "cx", "cy"):
        assert getattr(ours, name) == pytest.approx(getattr(theirs, name), abs=0.01)
    for quartet in (0, 5):
        got = closed_form_distance(found, quartet)
        away = np.abs(got - closed_form_distance(recording, quartet))
        assert np.median(away) < 2e-3
    assert len(list((folder / "distance").glob("**/*.exr"))) == 2
    assert (folder / "distance.webm").stat().st_size > 100
    assert "zero" in (folder / "sequence" / "README.md").read_text()


def test_the_page_reads_from_python(followed, monkeypatch, capsys):
    """Its script runs in the same folder."""
    monkeypatch.chdir(followed[0])
    exec(compile(blocks("python")[0], "docs/import.md", "exec"), {})
    assert "(44, 72, 96)" in capsys.readouterr().out


def test_the_page_names_keys_that_exist():
    """Every word that looks like a key is one."""
    tables = {key.name.partition(".")[0] for key in KEYS}
    names = re.findall(rf"`((?:{'|'.join(tables)})\.[a-z_]+)", PAGE)
    assert len(names) > 15
    assert set(names) - {"camera.file"} <= {key.name for key in KEYS}


def test_the_page_shows_the_commands_in_order():
    """The walk-through is complete: quads, import, check, reconstruction, video."""
    text = "\n".join(commands())
    places = [text.index(f" {word} ") for word in ("import", "check", "reconstruct", "render")]
    assert places == sorted(places)
