"""``gftorf import``: kinds, keys of TOML files, and folders of the TöRF family as captures."""

import shutil
import subprocess
import sys
import tomllib

import numpy as np
import pytest
from sequences import values_of

from gftorf_warp import Sequence
from gftorf_warp.cli import main
from gftorf_warp.errors import InputError, UsageError
from gftorf_warp.importers.command import import_recording, read_recording, template_of
from gftorf_warp.importers.keys import Key, load, template
from gftorf_warp.importers.kinds import KINDS
from gftorf_warp.sim.simulate import simulate

ABOUT = "what it means [unit]"
KEYS = (
    Key(name="files", kind=str, about=ABOUT, example="*.png", default=("*",), shape=(None,)),
    Key(name="bits", kind=int, about=ABOUT, example=12, least=1),
    Key(name="matrix", kind=float, about=ABOUT, example=((1.0, 0.0), (0.0, 1.0)), shape=(2, 2)),
    Key(name="sensor.f_mod_hz", kind=float, about=ABOUT, example=2e7, needed=True, above=0.0),
    Key(name="sensor.tap", kind=str, about=ABOUT, example="A", choices=("A", "B")),
    Key(
        name="time.rate_hz",
        kind=float,
        about=ABOUT,
        example=9.0,
        needed=True,
        unless=("time.file",),
    ),
    Key(name="time.file", kind=str, about=ABOUT, example="times.txt"),
)


def settings_of(text, tmp_path):
    """Settings of a TOML file of this text."""
    path = tmp_path / "keys.toml"
    path.write_text(text)
    return load(path, KEYS)


def test_values_of_a_file_replace_defaults(tmp_path):
    """Numbers become floats, lists tuples, and a single value may stand for a list."""
    given = settings_of(
        "files = 'a.png'\nmatrix = [[1, 2], [3, 4]]\n[sensor]\nf_mod_hz=7", tmp_path
    )
    assert given["files"] == ("a.png",)
    assert given["matrix"] == ((1.0, 2.0), (3.0, 4.0))
    assert isinstance(given["sensor.f_mod_hz"], float)
    assert given["bits"] is None
    assert given.given("files")
    assert not given.given("bits")
    assert load(None, KEYS)["files"] == ("*",)


def test_all_missing_keys_are_asked_for_at_once(tmp_path):
    """By name and meaning; a key that replaces another is named, and suffices."""
    with pytest.raises(InputError) as error:
        settings_of("bits = 3", tmp_path).require("sensor.tap")
    for word in ("3 keys", "sensor.f_mod_hz: " + ABOUT, "or time.file", "sensor.tap"):
        assert word in str(error.value), word
    with pytest.raises(InputError, match=r"time.rate_hz"):
        settings_of("bits = 3", tmp_path)["sensor.f_mod_hz"]
    with pytest.raises(UsageError, match="--config"):
        load(None, KEYS).require()
    settings_of("[sensor]\nf_mod_hz = 1\n[time]\nfile = 'a'", tmp_path).require()


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("bit = 3", "did you mean bits"),
        ("f_mod_hz = 3", "did you mean sensor.f_mod_hz"),
        ("zzz = 3", "there are files, bits"),
        ("sensors = {}", "unknown key sensors"),
        ("sensor.x = 3", "unknown key sensor.x"),
        ("bits = 0", "at least 1"),
        ("bits = 1.5", "whole number"),
        ("bits = true", "whole number"),
        ("[sensor]\nf_mod_hz = 0", "above 0"),
        ("[sensor]\nf_mod_hz = nan", "a number"),
        ("[sensor]\nf_mod_hz = inf", "a number"),
        (f"[sensor]\nf_mod_hz = 1{'0' * 400}", "a number"),
        ("[sensor]\nf_mod_hz = '20e6'", "a number"),
        ("[sensor]\ntap = 'C'", "one of A, B"),
        ("files = []", "a list"),
        ("files = [1]", "a text"),
        ("matrix = [1, 2, 3, 4]", "2 x 2"),
        ("matrix = [[1, 2], [3]]", "2 x 2"),
        ("bits = = 3", "line 1"),
        ("bits = 3\nbits = 4", "no TOML"),
        ("a = " + "[" * 4000, "no TOML"),
    ],
)
def test_a_wrong_key_is_named(text, word, tmp_path):
    """With the nearest name or an example."""
    with pytest.raises(InputError) as error:
        settings_of(text, tmp_path)
    assert word in str(error.value)
    assert "keys.toml" in str(error.value)


def test_a_file_that_cannot_be_read_is_named(tmp_path):
    """Missing, a folder, no text, or far too large."""
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00")
    (tmp_path / "large").write_bytes(b"#" * (1 << 21))
    for name, word in (
        ("none", "found none"),
        (".", "a folder"),
        ("bytes", "expected text"),
        ("large", "at most"),
    ):
        with pytest.raises(InputError, match=word):
            load(tmp_path / name, KEYS)


def test_a_named_file_is_inside(tmp_path):
    """Of the recording or beside the TOML file; a link or a path out of both is refused."""
    settings = settings_of("[time]\nfile = 'here.txt'", tmp_path)
    with pytest.raises(InputError, match=r"here\.txt"):
        settings.file("time.file", tmp_path)
    (tmp_path / "here.txt").write_text("1")
    assert settings.file("time.file", tmp_path / "keys.toml") == tmp_path / "here.txt"
    inner = tmp_path / "inner"
    inner.mkdir()
    (inner / "link.txt").symlink_to(tmp_path / "here.txt")
    (inner / "keys.toml").write_text("[time]\nfile = 'link.txt'")
    with pytest.raises(InputError, match="folder"):
        load(inner / "keys.toml", KEYS).file("time.file", inner)
    (inner / "keys.toml").write_text("[time]\nfile = '../here.txt'")
    with pytest.raises(InputError, match="folder"):
        load(inner / "keys.toml", KEYS).file("time.file", inner)


@pytest.mark.parametrize("keys", [KEYS, *(kind.keys for kind in KINDS.values())])
def test_a_template_has_every_key(keys, tmp_path):
    """As written it asks for what is needed; with its comments removed, it is valid."""
    text = template("title", keys)
    path = tmp_path / "keys.toml"
    path.write_text(text)
    settings = load(path, keys)
    for key in keys:
        assert settings[key.name] == key.default if not key.needed else not settings.given(key.name)
    filled = [line.removeprefix("# ") if " = " in line else line for line in text.splitlines()]
    filled = [line for line in filled if not line.startswith(("needed", "title", "Remove"))]
    kept = [
        line for line in filled if line.startswith("[") or line.partition(" = ")[0].isidentifier()
    ]
    assert tomllib.loads("\n".join(kept))
    path.write_text("\n".join(kept))
    assert load(path, keys).values.keys() == {key.name for key in keys}


@pytest.fixture(scope="module")
def folders(tmp_path_factory):
    """A simulated scene as F-TöRF and TöRF folders."""
    root = tmp_path_factory.mktemp("family")
    for form in ("ftorf", "torf"):
        simulate("demo", root / form, frames=8, size=(16, 12), format=form)
    return root


@pytest.mark.parametrize("form", ["ftorf", "torf"])
def test_a_folder_of_the_family_becomes_a_capture(form, folders, tmp_path, capsys):
    """Quads, truth and all values are those of the folder, bit by bit."""
    out = tmp_path / "seq"
    assert main(["import", form, str(folders / form), "--out", str(out)]) == 0
    assert "8 raw frames of 16x12" in capsys.readouterr().out.replace("8 of 8", "8")
    before, after = Sequence.open(folders / form), Sequence.open(out)
    assert (out / "capture.json").is_file()
    for name, value in values_of(before).items():
        if isinstance(value, np.ndarray):
            np.testing.assert_allclose(value, values_of(after)[name], atol=1e-12, err_msg=name)
    assert np.array_equal(before.quads, after.quads)
    assert np.array_equal(before.truth().distance, after.truth().distance, equal_nan=True)
    assert "quads: file" in (out / "README.md").read_text()


def test_a_dry_run_writes_nothing(folders, tmp_path, capsys):
    """It says what it would read; the rate of the TOML file replaces the folder's."""
    (tmp_path / "keys.toml").write_text("[time]\nrate_hz = 50\n")
    line = f"import ftorf {folders / 'ftorf'} --dry-run --config {tmp_path / 'keys.toml'}"
    assert main(line.split()) == 0
    assert "times: setting 50 Hz" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["keys.toml"]


def test_the_list_and_the_templates(tmp_path, capsys):
    """Every kind is listed; a template goes to stdout or a new file."""
    assert main(["import", "--list"]) == 0
    listed = capsys.readouterr().out
    assert all(kind in listed for kind in KINDS)
    assert main(["import", "ftorf", "--template"]) == 0
    assert "rate_hz" in capsys.readouterr().out
    out = str(tmp_path / "a.toml")
    assert template_of("ftorf", out) == out
    with pytest.raises(UsageError, match="exists"):
        template_of("ftorf", out)


@pytest.mark.parametrize(
    ("line", "code", "word"),
    [
        ("import", 2, "KIND and SRC and --out SEQ missing"),
        ("import ftorf", 2, "SRC"),
        ("import --template", 2, "KIND missing"),
        ("import xyz {here} --out {out}", 2, "there are arrays, ftorf"),
        ("import ftofr {here} --out {out}", 2, "did you mean ftorf"),
        ("import ftorf {here}/none --out {out}", 3, "no such source"),
        ("import ftorf {here}/torf --out {out}", 3, "gftorf import torf"),
        ("import torf {here}/ftorf --out {out}", 3, "gftorf import ftorf"),
        ("import ftorf {here} --out {out}", 3, "one level off"),
        ("import ftorf {here}/ftorf --out {here}/torf", 2, "not empty"),
        ("import ftorf {here}/ftorf --out {out} --config {here}/none.toml", 3, "none.toml"),
        ("import ftorf {here}/ftorf/tof_permutation.npy --out {out}", 3, "not a folder"),
    ],
)
def test_a_wrong_import_is_three_lines(line, code, word, folders, tmp_path, capsys):
    """What, why and a fix, no traceback, nothing written."""
    out = tmp_path / "out"
    assert main(line.format(here=folders, out=out).split()) == code
    error = capsys.readouterr().err
    assert word in error
    assert "Traceback" not in error
    assert not out.exists()


def test_a_folder_in_use_is_refused_before_anything_is_read(folders, tmp_path, monkeypatch):
    """Reading takes minutes."""
    (tmp_path / "seq").mkdir()
    (tmp_path / "seq" / "file").touch()
    monkeypatch.setitem(KINDS, "ftorf", None)  # reading would fail
    with pytest.raises(UsageError, match="not empty"):
        import_recording("ftorf", folders / "ftorf", tmp_path / "seq")


def test_a_finished_import_may_be_repeated(folders, tmp_path):
    """Of a command that was killed after its last step; what another would write is refused."""
    out, source = tmp_path / "seq", tmp_path / "source"
    shutil.copytree(folders / "ftorf", source)
    lines = import_recording("ftorf", source, out)
    before = {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    (tmp_path / f".seq.tmp-{gone.pid}-0").mkdir()  # of one that was killed while it compared
    assert import_recording("ftorf", source, out) == lines
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*")}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["seq", "source"]
    shutil.copy(source / "synthetic_depth" / "0007.npy", source / "synthetic_depth" / "0001.npy")
    with pytest.raises(UsageError, match="another import"):
        import_recording("ftorf", source, out)
    assert before == {path: path.stat().st_mtime_ns for path in out.rglob("*")}


def test_a_reader_in_memory(folders):
    """Without files: a sequence, its truth, what was understood and what is uncertain."""
    imported = read_recording("ftorf", folders / "ftorf")
    assert imported.truth is not None
    assert any(line.startswith("shifts: file") for line in imported.understood)
    assert not imported.uncertain
