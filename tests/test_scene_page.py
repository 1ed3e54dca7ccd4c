"""The offline page of moving splats: its arrays are the run's, and a browser shows them."""

import base64
import json
import re

import numpy as np
import pytest
import torch
from browser import PHONE, browser
from export_run import FRAMES, exportable

from gftorf_warp.errors import UsageError
from gftorf_warp.export import scene_arrays
from gftorf_warp.export.command import export


@pytest.fixture
def run(tmp_path):
    """A finished run with colour."""
    return exportable(tmp_path)


def scene_of(page):
    """What the page holds, its arrays by name, as its module describes them."""
    text = page.read_text()
    (found,) = re.findall(r'<script type="application/json" id="scene">(.*?)</script>', text)
    about = json.loads(found)
    data, count, rows = base64.b64decode(about["arrays"]), about["count"], about["resting"]
    moved = sum(about["moving"])
    layout = [("index", "<u4", (moved,)), ("scale", "<u2", (count, 3))]
    layout += [("still", "<u2", (rows, 3)), ("place", "<u2", (moved, 3))]
    layout += [("colour", "u1", (count, 4)), ("turn", "i1", (rows + moved, 4))]
    arrays, at = {}, 0
    for name, kind, shape in layout:
        array = np.frombuffer(data, kind, int(np.prod(shape)), at).reshape(shape)
        arrays[name], at = array, at + array.nbytes
    assert at == len(data)
    return about, arrays


def test_the_page_holds_every_gaussian_at_every_moment(run, tmp_path):
    """Places to the step of their integers, turns to a degree, opacity and colour in 8 bits."""
    (page,) = export(run, tmp_path / "out", "html")
    about, arrays = scene_of(page)
    assert about["times"] == pytest.approx([n / 120 for n in range(FRAMES)])
    assert about["resting"] == 20
    assert about["moving"] == [20] * FRAMES
    assert about["count"] == 60
    place, rests, first = about["place"], run.field.layer == 0, 0
    for n, count in enumerate(about["moving"]):
        field = run.field.moved(*run.motion.at(run.binding, about["times"][n]))
        own = run.field.layer == 1 + n // 4
        rows = slice(first, first + count)
        resting = np.array(place["low"]) + np.array(place["step"]) * arrays["still"]
        moving = np.array(place["low"]) + np.array(place["step"]) * arrays["place"][rows]
        atol = 0.51 * max(place["step"])
        np.testing.assert_allclose(resting, field.mean[rests].detach(), atol=atol)
        np.testing.assert_allclose(moving, field.mean[own].detach(), atol=atol)
        turns = arrays["turn"][about["resting"] + first : about["resting"] + first + count] / 127
        want = torch.nn.functional.normalize(field.quaternion[own], dim=1)
        np.testing.assert_allclose(turns, want, atol=0.005)
        opacity = arrays["colour"][arrays["index"][rows], 3] / 255
        np.testing.assert_allclose(opacity, field.opacity[own], atol=0.003)
        scale = about["scale"]
        sizes = np.array(scale["low"]) + np.array(scale["step"]) * arrays["scale"]
        widened = sizes[arrays["index"][rows]] - field.log_scale[own].numpy()
        assert (widened > -1e-4).all()
        first += count
    assert max(place["step"]) < 1e-3


def test_the_page_needs_nothing_else(run, tmp_path):
    """No address of any kind, and a policy that forbids to load anything."""
    path = tmp_path / "<i>&"
    path.mkdir()
    object.__setattr__(run, "path", path)
    (page,) = export(run, tmp_path / "out", "html", every=4)
    text = page.read_text()
    assert "http:" not in text
    assert "https:" not in text
    assert "default-src 'none'" in text
    assert "<i>&" not in text
    assert "&lt;i&gt;&amp;" in text


def test_a_page_that_is_too_large_names_what_fits(run, tmp_path, monkeypatch):
    """Before it is made."""
    monkeypatch.setattr(scene_arrays, "BYTES_MAX", 2000)
    with pytest.raises(UsageError, match="--every"):
        export(run, tmp_path / "out", "html")
    assert not (tmp_path / "out" / "scene.html").exists()


def splats_of(tab):
    """RGB of the part of the window that is neither title nor controls."""
    rows = tab.value("[40, document.querySelector('footer').getBoundingClientRect().top - 4]")
    tab.value("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return tab.screenshot()[int(rows[0]) : int(rows[1])].astype(int)


def changed(before, after):
    """Share of pixels that are clearly different."""
    return (np.abs(after - before).max(axis=2) > 30).mean()


@pytest.fixture(scope="module")
def tab():
    """One browser for both sizes."""
    with browser() as one:
        yield one


@pytest.mark.parametrize("size", [(480, 400), PHONE], ids=["desktop", "phone"])
def test_a_browser_shows_splats_that_move(run, tab, tmp_path, size):
    """Colours where Gaussians are; other pixels after the slider moved, and after a turn."""
    (page,) = export(run, tmp_path / "out", "html")
    tab.resize(size)
    tab.open(page.as_uri())
    first = splats_of(tab)
    assert np.ptp(first.reshape(-1, 3), axis=0).min() > 60, "splats have colours"
    assert tab.value("document.body.scrollWidth") <= size[0]
    tab.value("element('time').focus()")
    for _ in range(6):
        tab.press("ArrowRight")
    assert "raw frame 6" in tab.value("element('now').textContent")
    later = splats_of(tab)
    assert 0.02 < changed(first, later) < 0.9
    at = {"x": size[0] // 2, "y": 150, "button": "left", "buttons": 1}
    for kind, x in (("mousePressed", 0), ("mouseMoved", 60), ("mouseReleased", 60)):
        tab.send("Input.dispatchMouseEvent", type=kind, **at | {"x": at["x"] + x})
    assert changed(later, splats_of(tab)) > 0.02
    tab.value("location.hash = '#0'")
    tab.until("moment === 0")
    tab.value("element('reset').click()")
    assert changed(first, splats_of(tab)) < 0.001
    assert not tab.problems
