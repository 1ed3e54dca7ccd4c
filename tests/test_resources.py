"""Memory and disk of a command are compared with what is free before anything is allocated."""

import functools
import shutil
import subprocess
import sys
from collections import namedtuple

import foreign
import kinect2_dump
import numpy as np
import pytest
from export_run import FRAMES, HEIGHT, WIDTH, exportable
from moving_box import recording
from recordings import WRITERS
from sequences import changed

from gftorf_warp.cli import main
from gftorf_warp.data import resources
from gftorf_warp.data.folder import empty_quads
from gftorf_warp.data.write import write
from gftorf_warp.errors import ResourceError
from gftorf_warp.export.command import FORMATS, export
from gftorf_warp.recon.train import reconstruct

GB = 1_000_000_000
LIMITED = """
import resource
from gftorf_warp.data.resources import free_memory
resource.setrlimit(resource.RLIMIT_AS, (4 << 30, 4 << 30))
print(free_memory())
"""


@pytest.fixture
def little(monkeypatch):
    """A machine with one gigabyte of free memory, whatever this one has."""
    monkeypatch.setattr(resources, "free_memory", lambda: GB)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The closed form of a short sequence."""
    place = tmp_path_factory.mktemp("made")
    write("ftorf", place / "seq", *recording(frames=12))
    words = ["reconstruct", str(place / "seq"), "--out", str(place / "run"), "--preset", "ctof"]
    assert main([*words, "--device", "cpu", "-q"]) == 0
    return place / "run"


def refused(arguments, capsys, *words):
    """A command ends with exit code 5 and three lines that contain the words."""
    assert main([*arguments, "-q"]) == 5
    err = capsys.readouterr().err
    assert [line[:7] for line in err.splitlines()] == ["error: ", "  why: ", "  fix: "], err
    for word in words:
        assert word in err


@pytest.mark.usefixtures("little")
@pytest.mark.parametrize(
    "options",
    [
        ["--size", "9999x9999"],
        ["--size", "9999x9999", "--engine", "mesh"],
        ["--frames", "1000000000", "--size", "8x6"],
    ],
    ids=" ".join,
)
def test_a_recording_that_does_not_fit_is_refused_at_once(tmp_path, capsys, options):
    """Nothing is made, not even a folder."""
    words = ["simulate", "demo", *options, "--out", str(tmp_path / "seq")]
    refused(words, capsys, "not enough memory", "--size", "--frames", "1.00 GB are free")
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("little")
def test_covers_that_do_not_fit_are_refused(tmp_path, capsys):
    """A wide image of two rows has few pixels and 200 million splats on its body that moves."""
    words = ["simulate", "demo", "--size", "8000x2", "--frames", "4", "--out", str(tmp_path / "s")]
    refused(words, capsys, "not enough memory", "--size", "--engine mesh", "1.00 GB are free")
    assert not any(tmp_path.iterdir())


def test_a_disk_that_is_too_small_is_named(tmp_path, capsys, monkeypatch):
    """Before the first raw frame."""
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(resources.shutil, "disk_usage", lambda _: usage(1e9, 1e9, 1e5))
    words = ["simulate", "demo", "--size", "24x18", "--out", str(tmp_path / "a" / "seq")]
    refused(words, capsys, "not enough disk space", "0.10 MB are free", "--frames")
    assert not any(tmp_path.iterdir())


@pytest.mark.usefixtures("little")
def test_a_long_sequence_is_not_read_into_too_little_memory(tmp_path):
    """By the number and size of its images."""
    with pytest.raises(ResourceError, match="shorter recording"):
        empty_quads(tmp_path, 2000, {"H": 240, "W": 320})


def test_reconstruct_compare_and_render_are_refused(run, tmp_path, capsys, monkeypatch):
    """With what they need at least, and the option that helps; nothing is left behind."""
    monkeypatch.setattr(resources, "free_memory", lambda: 1e6)
    sequence, _ = recording(frames=12)
    with pytest.raises(ResourceError, match="width_max"):
        reconstruct(sequence, tmp_path / "run", "demo", images=4)
    assert not (tmp_path / "run").exists()
    before = {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}
    refused(["compare", str(run), "--device", "cpu"], capsys, "--frames ftorf13")
    monkeypatch.setattr(resources, "free_memory", lambda: 5e5)
    words = ["render", str(run), "--out", str(tmp_path / "out"), "--device", "cpu"]
    refused(words, capsys, "--times")
    assert not (tmp_path / "out").exists()
    assert before == {path: path.read_bytes() for path in run.rglob("*") if path.is_file()}


@pytest.mark.parametrize("name", FORMATS)
def test_an_export_is_refused(run, tmp_path, capsys, monkeypatch, name):
    """Of every format, by what it writes or what it holds meanwhile."""
    usage = namedtuple("usage", "total used free")
    words = ["export", str(run), "--out", str(tmp_path / "out"), "--device", "cpu", "--format"]
    if not FORMATS[name].of_gaussians:  # the closed form has none
        needs = FORMATS[name].needs
        if needs.of_pixel:
            monkeypatch.setattr(resources, "free_memory", lambda: 2e5)
            refused([*words, name], capsys, "not enough memory", "--every")
            monkeypatch.undo()
        if needs.file:
            monkeypatch.setattr(resources.shutil, "disk_usage", lambda _: usage(1e9, 1e9, 20))
            refused([*words, name], capsys, "not enough disk space", "--every")
        assert not (tmp_path / "out").exists()
    assert resources.to_export([FORMATS[name].needs], 10, 10**7, 10**7).memory >= (name != "tum")


def test_an_estimate_is_no_more_than_what_an_export_takes(tmp_path):
    """Nothing is refused that would have worked: of Gaussians and pixels that are all there."""
    run = exportable(tmp_path)
    names = ["ply", "points", "exr", "npz", "colmap", "nerfstudio", "tum"]
    targets = export(run, tmp_path / "out", names)
    present = int((run.field.layer == 0).sum())
    for name, target in zip(names, targets, strict=True):
        files = [target] if target.is_file() else [p for p in target.rglob("*") if p.is_file()]
        found = sum(path.stat().st_size for path in files)
        need = resources.to_export([FORMATS[name].needs], FRAMES, HEIGHT * WIDTH // 2, present)
        assert 0.05 * found < need.disk < found, name


def arrays_of(place, save, name):
    """Twelve raw frames in a file, and their keys."""
    (place / "source").mkdir()
    save(place / "source" / name, foreign.recording()[1])
    (place / "keys.toml").write_text(foreign.keys(values__zero=0))
    return place / "source", place / "keys.toml"


def camera_of(name, place):
    """The recording of a camera, and its keys."""
    WRITERS[name](place)
    return place / "recording", place / "keys.toml"


def kinect2_of(place):
    """A dump, whose tables say all."""
    kinect2_dump.write(place / "source")
    return place / "source", None


def folder_of(form, place):
    """A folder of the TöRF family, which needs no keys."""
    return write(form, place / "source", *recording(frames=8)), None


BY_KIND = {  # kind: writes a recording and returns source and keys
    "arrays": lambda place: arrays_of(place, np.save, "quads.npy"),
    "arrays, packed": lambda place: arrays_of(place, np.savez_compressed, "quads.npz"),
    "kinect2": kinect2_of,
    **{name: functools.partial(camera_of, name) for name in WRITERS},
    **{form: functools.partial(folder_of, form) for form in ("ftorf", "torf")},
}


@pytest.mark.parametrize("name", BY_KIND)
def test_an_import_is_refused(tmp_path, capsys, monkeypatch, name):
    """Of every kind, before the raw frames are in memory, or before they are on the disk."""
    source, keys = BY_KIND[name](tmp_path)
    words = ["import", name.partition(",")[0], str(source), "--out", str(tmp_path / "seq")]
    words += [] if keys is None else ["--config", str(keys)]
    monkeypatch.setattr(resources, "free_memory", lambda: 100.0)
    refused(words, capsys, "not enough memory")
    monkeypatch.undo()
    usage = namedtuple("usage", "total used free")
    monkeypatch.setattr(resources.shutil, "disk_usage", lambda _: usage(1e9, 1e9, 100))
    refused(words, capsys, "not enough disk space", "give fewer files")
    assert not (tmp_path / "seq").exists()


def test_less_is_needed_for_reduced_images(tmp_path, monkeypatch):
    """The message's option does help."""
    sequence, _ = recording(frames=8)
    wide = changed(sequence, quads=np.repeat(sequence.quads, 4, axis=2), fx=4 * 42.0, cx=96.0)
    monkeypatch.setattr(resources, "free_memory", lambda: 8e6)
    with pytest.raises(ResourceError):
        reconstruct(wide, tmp_path / "run", "demo", images=4)
    run = reconstruct(wide, tmp_path / "run", "demo", images=4, changes=["width_max=48"])
    assert run.config["images_optimised"] == 4


def test_what_is_free_respects_a_limit_of_the_process():
    """A limit on address space counts, less what is used already."""
    assert resources.free_memory() > 1e8
    done = subprocess.run([sys.executable, "-c", LIMITED], capture_output=True, check=True)
    assert 2 << 30 < float(done.stdout) < 4 << 30


def test_what_is_free_respects_a_control_group(tmp_path, monkeypatch):
    """Version 2, and version 1 below a folder of its own; files in memory may be dropped."""
    monkeypatch.setattr(resources, "CGROUP", tmp_path)
    for folder, names in (
        (tmp_path, ("memory.max", "memory.current")),
        (tmp_path / "memory", ("memory.limit_in_bytes", "memory.usage_in_bytes")),
    ):
        folder.mkdir(exist_ok=True)
        for name, value in zip(names, (30_000_000, 20_000_000), strict=True):
            (folder / name).write_text(f"{value}\n")
        (folder / "memory.stat").write_text("anon 12\ninactive_file 5000000\n")
        assert resources.free_memory() == 15_000_000
        (folder / names[0]).write_text("max\n")
        assert resources.free_memory() > 1e8


def test_what_is_free_respects_groups_within_groups(tmp_path, monkeypatch):
    """A job of a cluster is in a group of its own, below one of the machine."""
    monkeypatch.setattr(resources, "CGROUP", tmp_path / "groups")
    monkeypatch.setattr(resources, "OWN_GROUPS", tmp_path / "own")
    (tmp_path / "own").write_text("1:cpu:/\n0::/slurm/job_7/step_0\n")
    for name, limit in (("slurm", 50_000_000), ("slurm/job_7", 9_000_000), ("other", 1_000)):
        folder = tmp_path / "groups" / name
        folder.mkdir(parents=True)
        (folder / "memory.max").write_text(f"{limit}\n")
        (folder / "memory.current").write_text("1000000\n")
    assert resources.free_memory() == 8_000_000


def test_free_space_is_that_of_the_disk_that_will_be_written_to(tmp_path):
    """Also where the folder does not exist yet."""
    free = shutil.disk_usage(tmp_path).free
    resources.require(resources.Need(disk=0.5 * free), tmp_path / "a" / "b", "--out")
    with pytest.raises(ResourceError, match="disk space"):
        resources.require(resources.Need(disk=2.0 * free), tmp_path / "a" / "b", "--out")
