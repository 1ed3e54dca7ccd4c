"""The offline page of moving splats: its arrays are the run's, and a browser shows them."""

import base64
import json
import re
import shutil
import subprocess

import cv2
import numpy as np
import pytest
import torch
from export_run import FRAMES, exportable

from gftorf_warp.errors import UsageError
from gftorf_warp.export import scene_page
from gftorf_warp.export.command import export

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser"))), None)


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
    monkeypatch.setattr(scene_page, "BYTES_MAX", 2000)
    with pytest.raises(UsageError, match="--every"):
        export(run, tmp_path / "out", "html")
    assert not (tmp_path / "out" / "scene.html").exists()


def screenshot(page, picture):
    """RGB of the page in a window of 400 x 400."""
    flags = "--headless=new --no-sandbox --use-angle=swiftshader --enable-unsafe-swiftshader"
    flags += " --hide-scrollbars --window-size=400,400 --virtual-time-budget=1000"
    asked = [BROWSER, *flags.split(), f"--screenshot={picture}", page.as_uri()]
    subprocess.run(asked, check=True, capture_output=True, timeout=60)
    return cv2.imread(str(picture))[..., ::-1]


@pytest.mark.skipif(BROWSER is None, reason="no Chromium")
def test_a_browser_shows_splats_that_move(run, tmp_path):
    """Colours where Gaussians are; other pixels after the slider has moved."""
    (page,) = export(run, tmp_path / "out", "html")
    before = screenshot(page, tmp_path / "before.png")
    scene = before[40:240]
    assert np.ptp(scene.reshape(-1, 3), axis=0).min() > 60, "splats have colours"
    moved = "const t = element('time'); t.value = 6; t.dispatchEvent(new Event('input'));"
    page.write_text(page.read_text().replace("</body>", f"<script>{moved}</script></body>"))
    after = screenshot(page, tmp_path / "after.png")
    changed = np.abs(after.astype(int) - before)[40:240].max(axis=2) > 30
    assert 0.02 < changed.mean() < 0.9
