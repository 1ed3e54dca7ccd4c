"""The page: every printed number is one of metrics.json, every picture shows its array,
and nothing in it can run.
"""

import base64
import json
import math
import re
from dataclasses import replace
from html.parser import HTMLParser

import analytic_run
import cv2
import numpy as np
import pytest
from analytic_run import AnalyticRun, as_phasors, with_colour
from browser import DESKTOP, PHONE, browser
from sequences import sequence_of

from gftorf_warp import Truth
from gftorf_warp.constants import CANONICAL_SHIFTS
from gftorf_warp.data.texts import read_rows
from gftorf_warp.evaluate import controls, figures, page, panels, pictures, provenance, tables
from gftorf_warp.evaluate.compare import compare, comparison_of, summary
from gftorf_warp.evaluate.gallery import colour_views, novel_views
from gftorf_warp.evaluate.metrics import scored_frames
from gftorf_warp.evaluate.report import report, verdict
from gftorf_warp.evaluate.views import Views, gather
from gftorf_warp.recon.settings import Method
from gftorf_warp.scene.initialise import Init
from gftorf_warp.scene.models import KINDS

SLIDER = "document.querySelector('.slider')"
VOID = {"img", "meta", "br", "input"}
HOSTILE = "<script>alert(1)</script>"
PRINTED = {  # how the page prints a value of metrics.json, written a second time
    "error": lambda value: f"{value:.3f}",
    "rms_cm": lambda value: f"{math.sqrt(value / 100) * 100:.1f} cm",
    "length_cm": lambda value: f"{value * 100:.2f} cm",
    "percent": lambda value: f"{value * 100:.1f} %",
    "ratio": lambda value: f"{value:.3g}",
    "decibel": lambda value: f"{value:.2f} dB",
    "count": lambda value: f"{value:,d}",
    "seconds": lambda value: f"{value:.1f} s",
    "text": str,
}


class Page(HTMLParser):
    """What a browser would see: tags, texts, marked numbers,
    embedded images by their alternative text.
    """

    def __init__(self, text):
        super().__init__()
        self.tags, self.attributes, self.numbers, self.ratios, self.images = [], [], [], [], {}
        self.texts = {}  # section title: text outside marked numbers
        self.open, self.section, self.title, self.headline = [], "top", "", ""
        self.feed(text)
        self.close()
        assert not self.open, f"never closed: {self.open}"

    def handle_starttag(self, tag, attrs):
        """Count a tag, and remember where we are."""
        attributes = dict(attrs)
        self.tags.append(tag)
        self.attributes += [(tag, name, value) for name, value in attrs]
        if tag == "img":
            self.images.setdefault(attributes["alt"], []).append(attributes["src"])
        if tag == "h2":
            self.section = ""
        if tag not in VOID:
            self.open.append((tag, attributes))

    def handle_endtag(self, tag):
        """Tags must close in order."""
        assert self.open.pop()[0] == tag

    def handle_data(self, data):
        """A text belongs to the innermost tag."""
        if not self.open:
            return
        tag, attributes = self.open[-1]
        if tag == "h2":
            self.section += data
        elif tag == "title":
            self.title += data
        elif tag == "h1":
            self.headline += data
        elif "data-key" in attributes:
            self.numbers.append((attributes["data-key"], attributes["data-form"], data))
        elif "data-above" in attributes:
            self.ratios.append((attributes["data-above"], attributes["data-below"], data))
        elif tag != "style":
            self.texts[self.section] = self.texts.get(self.section, "") + " " + data


def picture(source):
    """RGB of an embedded image."""
    kind, _, data = source.partition(",")
    assert kind == "data:image/webp;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)[
        ..., ::-1
    ]


def look_up(metrics, key):
    """A value by its dotted key."""
    for part in key.split("."):
        metrics = metrics[part]
    return metrics


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """(folder of the run, metrics.json, page, comparison) of the analytic run."""
    run = AnalyticRun(tmp_path_factory.mktemp("compared"), colour=True)
    run.watched(*((100 * i, 9.0 / i, 0.1 / i) for i in range(1, 6)))
    sequence = with_colour(run.sequence())
    run.sequence = lambda: sequence
    compare(run)
    truth = sequence.truth()
    frames = scored_frames(sequence)
    found = replace(
        comparison_of(sequence, gather(run, sequence, frames), truth),
        colour=colour_views(run, sequence, frames),
        novel=novel_views(run, sequence),
    )
    metrics = json.loads((run.path / "metrics.json").read_text())
    return run, metrics, Page((run.path / "report.html").read_text()), found


def test_every_printed_number_is_in_metrics(compared):
    """Each marked number, printed again from metrics.json; the results hold no digit besides."""
    _, metrics, html, _ = compared
    for key, form, text in html.numbers:
        value = look_up(metrics, key)
        assert text == ("not known" if value is None else PRINTED[form](value)), key
    for above, below, text in html.ratios:
        assert text == f"{look_up(metrics, above) / look_up(metrics, below):.1f}"
    printed = {key for key, _, _ in html.numbers}
    wanted = {
        f"{group}{name}_mse_x100"
        for group in ("", "moving.", "static.")
        for name in ("closed_form", "d", "d_tof")
    }
    wanted |= {
        "moving.share",
        "static.share",
        "quad_psnr_db",
        "colour_psnr_db",
        "gaussians",
        "frames",
        "seed",
    }
    wanted |= {f"diagnostics.{name}" for name in metrics["diagnostics"] if name != "rows"}
    assert wanted <= printed
    assert len(html.ratios) == 1
    for section in ("top", "Errors", "Along the run", "Colour"):
        left = (
            html.texts[section].replace("m² \N{MULTIPLICATION SIGN} 100", "").replace("atan2", "")
        )
        left = re.sub(r"\bframe \d+", "", left)  # which picture it is
        assert not re.search(r"\d", left), left


def test_nothing_runs_and_nothing_is_loaded(compared):
    """No script, no handler, no form, no address but embedded data; the policy forbids the rest."""
    run, _, html, _ = compared
    assert not {"script", "iframe", "object", "embed", "link", "form", "base", "svg", "a"} & set(
        html.tags
    )
    for tag, name, value in html.attributes:
        assert not name.startswith("on"), f"{tag} {name}"
        if name in {"src", "href", "srcset", "action", "data"}:
            assert value.startswith("data:image/"), f"{tag} {name}"
    text = (run.path / "report.html").read_text()
    assert not re.search(
        r"https?:|//[a-z]|url\(|@import|javascript:", re.sub(r"base64,[A-Za-z0-9+/=]*", "", text)
    )
    policies = [
        value
        for tag, name, value in html.attributes
        if tag == "meta" and value and "default-src" in value
    ]
    assert policies == ["default-src 'none'; img-src data:; style-src 'unsafe-inline'"]


def test_a_hostile_name_stays_a_name(compared):
    """Text from folders, configuration and data cards is shown, never obeyed."""
    run, metrics, _, found = compared
    config = {
        name: HOSTILE if isinstance(value, str) else value for name, value in run.config.items()
    }
    hostile = {
        name: HOSTILE if isinstance(value, str) else value for name, value in metrics.items()
    }
    log = [
        {"images": i, "loss": 1.0, HOSTILE: 0.5, "gaussians": 3, "quad_psnr_db": None}
        for i in (1, 2)
    ]
    text = report(
        title=HOSTILE, metrics=hostile, config=config, log=log, comparison=found, data_card=HOSTILE
    )
    html = Page(text)
    assert "script" not in html.tags
    assert html.headline == HOSTILE
    assert html.title.startswith(HOSTILE)
    assert html.texts["How it was made"].count(HOSTILE) >= 5


def test_pictures_show_their_arrays(compared):
    """Distances, errors, quads and masks, decoded from the page and compared with the arrays on
    the stated scale.
    """
    _, _, html, found = compared
    s = panels.row_to_show(found)
    metres = found.distance_scale
    assert (metres.low, metres.high) == (2.5, 4.0)
    quads = pictures.signed_scale([found.sequence.quads[n] for n in range(4, 8)])
    errors = pictures.error_scale(
        [np.sqrt(found.judgement.errors["closed_form"][s])[found.judgement.moving[s]]]
    )
    want = {
        "closed form": (found.views.closed_form[s], metres),
        "ours, d": (found.views.d[s], metres),
        "ours, d_ToF": (found.views.d_tof[s], metres),
        "truth": (analytic_run.true_distance(found.views.frames[s]), metres),
        "error of closed form": (
            np.abs(found.views.closed_form[s] - found.judgement.truth[s]),
            errors,
        ),
        "error of ours, d": (np.abs(found.views.d[s] - found.judgement.truth[s]), errors),
        "moving pixels": (
            found.judgement.moving[s].astype(float),
            pictures.Scale(low=0, high=1, colours="gray", unit=""),
        ),
        **{f"raw frame {n}": (found.sequence.quads[n], quads) for n in range(4, 8)},
    }
    assert found.views.frames[s] // 4 == 1
    for title, (image, scale) in want.items():
        np.testing.assert_array_equal(
            picture(html.images[title][0]), pictures.colour_mapped(image, scale), title
        )
        assert len(np.unique(picture(html.images[title][0]).reshape(-1, 3), axis=0)) > 1, (
            f"{title} is one colour"
        )


def test_phase_and_amplitude_are_those_of_the_quartet(compared):
    """The wall, untouched by the box, has one phase and one amplitude: the expected ones."""
    _, _, html, _ = compared
    phase = picture(html.images["measured phase"][0])[0, 0]
    psi = analytic_run.PHASE_SLOPE * analytic_run.WALL
    np.testing.assert_array_equal(
        phase, pictures.colour_mapped(np.array([[psi]]), pictures.phase_scale())[0, 0]
    )
    amplitude = picture(html.images["measured amplitude"][0])
    assert amplitude[0, 0, 0] < amplitude[5, 8, 0], "the box is nearer, so brighter"


def test_distances_that_nobody_knows_have_no_row(compared):
    """A moving camera has no temporal mean, a run without fallback no fit alone."""
    _, metrics, html, _ = compared
    assert "temporal mean" in html.texts["Errors"]
    assert "the fit alone" not in html.texts["Errors"]
    unknown = {f"temporal{kind}_mse_x100": None for kind in ("", "_mean", "_median")}
    assert "temporal" not in tables.errors(metrics | unknown)


def test_the_film_has_a_frame_for_every_quartet_start(compared):
    """Three quartets above each other in every panel; ours shows the box where it is."""
    _, _, html, found = compared
    films = [title for title in html.images if title.startswith("film: ")]
    assert films == [f"film: {t}" for t in ("measured quad", "closed form", "ours, d", "truth")]
    for title, values in (("ours, d", found.views.d), ("truth", found.judgement.truth)):
        shown = picture(html.images[f"film: {title}"][0]).reshape(3, 12, 20, 3)
        for frame, image in zip(shown, values[::4], strict=True):
            want = pictures.colour_mapped(image, found.distance_scale)
            np.testing.assert_array_equal(frame, want, title)
        assert np.abs(shown[0].astype(int) - shown[1]).max() > 50, "nothing moves"


def test_sliders_lay_ours_over_the_closed_form(compared):
    """Distances and errors, pixel by pixel; without truth quads take the place of errors."""
    _, _, html, found = compared
    s = panels.row_to_show(found)
    for title, name in (("closed form", "closed_form"), ("ours, d", "d")):
        distance, error = (
            picture(html.images[f"slider: {prefix}{title}"][0]) for prefix in ("", "error of ")
        )
        image = getattr(found.views, name)[s]
        want = pictures.colour_mapped(image, found.distance_scale)
        np.testing.assert_array_equal(distance, want, title)
        wrong = np.abs(image - found.judgement.truth[s])
        assert error[wrong.argmax() // 20, wrong.argmax() % 20].sum() == error.sum(axis=-1).max()
    blind = Page(f"<p>{panels.sliders(replace(found, judgement=None), s)}</p>")
    want = pictures.signed_scale([found.views.quad_measured[s]])
    for title in ("measured", "rendered"):
        image = getattr(found.views, f"quad_{title}")[s]
        shown = picture(blind.images[f"slider: {title} quad"][0])
        np.testing.assert_array_equal(shown, pictures.colour_mapped(image, want))
    with pytest.raises(ValueError, match="one size"):
        controls.slider(np.zeros((2, 3, 3), np.uint8), np.zeros((3, 2, 3), np.uint8), ("a", "b"))


def test_bars_are_as_long_as_the_errors(compared):
    """Root mean squared errors over the largest of them, at edges and inside."""
    _, metrics, _, _ = compared
    html = tables.bars(tables.series_of(metrics))
    drawn = re.findall(r"--part: ([\d.]+).*?data-key=\"([^\"]*)\"", html)
    roots = {key: math.sqrt(look_up(metrics, key)) for _, key in drawn}
    assert {key.split(".")[1] for key in roots} == {"moving", "static"}
    assert {key.split(".")[3] for key in roots} == {
        f"{name}_mse_x100" for name in ("closed_form", "temporal", "d")
    }
    for part, key in drawn:
        assert float(part) == pytest.approx(roots[key] / max(roots.values()), abs=1e-4), key
    assert tables.bars(tables.series_of(metrics | {"classes": None})) == ""


def test_the_page_can_be_used_without_a_script(compared):
    """In Chromium, at both sizes: nothing is cut off, the slider's edge and the film move."""
    run, _, _, _ = compared
    with browser() as tab:
        for size in (DESKTOP, PHONE):
            tab.resize(size)
            tab.open((run.path / "report.html").absolute().as_uri())
            assert tab.value("document.documentElement.scrollWidth") <= size[0]
            # the edge starts in the middle
            tab.until(f"Math.abs({SLIDER}.scrollLeft / {SLIDER}.clientWidth - 0.5) < 0.02")
        tab.until(f"getComputedStyle({SLIDER}).scrollSnapType === 'none'")
        tab.value(f"{SLIDER}.scrollIntoView()")
        shown = []
        for part in (0, 1):
            tab.value(f"{SLIDER}.scrollLeft = {part} * {SLIDER}.clientWidth")
            tab.value("new Promise(drawn => setTimeout(drawn, 300))")
            shown.append(tab.screenshot()[:200].astype(int))
        assert (np.abs(shown[0] - shown[1]).max(axis=-1) > 60).sum() > 100
        at = "getComputedStyle(document.querySelector('.film .frames')).objectPosition"
        tab.until(f"{at} != '0% 0%'")
        tab.value("document.querySelector('.film label').click()")
        state = "getComputedStyle(document.querySelector('.film .frames')).animationPlayState"
        tab.until(f"{state} === 'paused'")
        # the film stops in the next frame, not at the click
        tab.value("Promise.all(document.getAnimations().map(film => film.ready.then(() => 0)))")
        paused = tab.value(at)
        tab.value("new Promise(drawn => setTimeout(drawn, 600))")
        assert tab.value(at) == paused
        assert not tab.problems


def test_the_same_comparison_gives_the_same_bytes(compared):
    """Two reports of one run, drawings included."""
    run, _, _, _ = compared
    before = (run.path / "report.html").read_bytes()
    compare(run)
    assert (run.path / "report.html").read_bytes() == before


def test_curves_are_drawn_from_the_log(compared):
    """One line per loss term, and none without a log."""
    _, _, html, _ = compared
    assert {"During optimisation", "Error of every raw frame"} <= set(html.images)
    log = [
        {"images": i, "seconds": 1.0, "loss": 1.0 / i, "quads": 0.5 / i, "gaussians": 9}
        for i in (1, 2, 3)
    ]
    both, one = (
        figures.training_curves(log),
        figures.training_curves([{k: s[k] for k in s if k != "quads"} for s in log]),
    )
    assert b"".join(both).count(b"<path") > b"".join(one).count(b"<path")
    assert figures.training_curves([]) == []


def test_along_the_run_is_drawn_from_its_rows(compared):
    """Six drawings with truth, fewer without, and no section where nothing was watched."""
    run, metrics, html, found = compared
    assert "Along the run" in html.images
    assert "Along the run" in html.texts
    rows = read_rows(run.path / "diagnostics.jsonl")
    blind = [
        {name: None if "mse" in name else value for name, value in row.items()} for row in rows
    ]
    titles = [set(drawn_texts(figures.along_run(given))) for given in (rows, blind)]
    assert titles[0] - titles[1] >= {"Error of d", "Error of d_ToF"}
    for both in titles:
        assert {"On static pixels", "Transmittance", "Depth distortion", "Gaussians"} <= both
    assert figures.along_run([]) == []
    bare = Page(report(title="bare", metrics=metrics, config=run.config, log=[], comparison=found))
    assert "Along the run" not in bare.texts
    assert "Along the run" not in bare.images


def drawn_texts(drawings):
    """Texts of drawings."""
    return re.findall(r"<text[^>]*>(.*?)</text>", b"".join(drawings).decode())


def test_views_that_nobody_took_are_shown(compared):
    """Distance on the scale of all others and colour, from three poses;
    colour measured above rendered.
    """
    _, _, html, found = compared
    scale = found.distance_scale
    assert found.novel.poses == [0, 1, 2]
    assert found.novel.time == pytest.approx(6.5 / 120)
    for m in range(3):
        want = pictures.colour_mapped(found.novel.distance[m], scale)
        np.testing.assert_array_equal(picture(html.images["distance / opacity"][m]), want)
    right = analytic_run.true_distance(6)
    wrong = np.where(right == analytic_run.BOX, analytic_run.BOX_ERROR, analytic_run.WALL_ERROR)
    np.testing.assert_allclose(found.novel.distance[1], right + wrong, rtol=1e-5)
    assert len(html.images["colour"]) == 3
    measured, rendered = (
        picture(html.images[f"{kind} colour"][0]).astype(int) for kind in ("measured", "rendered")
    )
    assert measured[0, 0].argmax() == 0, "the wall is reddish"
    assert measured[5, 3].argmax() == 2, "the box is bluish"
    assert 0 < np.abs(measured - rendered).max() < 60


def test_mist_is_no_surface(compared):
    """Grey where most of the light would pass."""
    run, _, _, found = compared
    render = run.render

    def misty(time, camera=None):
        rendering = render(time, camera)
        rendering.opacity[:2] = 0.3
        return rendering

    run.render = misty
    novel = novel_views(run, found.sequence)
    del run.render
    assert np.isnan(novel.distance[:, :2]).all()
    assert np.isfinite(novel.distance[:, 2:]).all()
    assert novel_views(run, replace(found.sequence, novel_from_world=None)) is None


def test_a_page_about_phasors_shows_phasors(compared):
    """Real and imaginary part instead of four quads, and no word about four instants."""
    run, metrics, _, found = compared
    phasors = as_phasors(found.sequence)
    seen = comparison_of(phasors, gather(run, phasors, scored_frames(phasors)), None)
    config = run.config | {"input": "phasor", "motion": "network"}
    html = Page(report(title="phasors", metrics=metrics, config=config, log=[], comparison=seen))
    assert {"real part", "imaginary part", "measured phase"} <= set(html.images)
    assert not [title for title in html.images if title.startswith("raw frame")]
    text = " ".join(html.texts.values())
    assert "each with its own" not in text
    assert "each quartet is scored once" in " ".join(html.texts["How to read it"].split())
    assert "phasor: real and imaginary part" in html.texts["How it was made"]
    assert "an MLP of position and time" in html.texts["How it was made"]
    assert "--input phasor" in html.texts["How it was made"]


@pytest.mark.parametrize(
    ("name", "values"), [("init", Init), ("motion", KINDS), ("method", Method)]
)
def test_every_choice_has_words(name, values):
    """None appears as a bare name."""
    for value in values:
        settings = {"method": str(value)} if name == "method" else {}
        text = provenance.how({name: str(value), "settings": settings}, None, "", compared={})
        assert f"<dd>{value}</dd>" not in text


def test_verdict_says_which_is_better():
    """Ours better, ours worse, and unknown."""
    rows = {"closed_form_mse_x100": 100.0, "d_mse_x100": 4.0, "share": 0.125}
    good = {"moving": rows, "static": rows, "d_mse_x100": 1.0}
    text = re.sub(r"<[^>]*>", "", verdict(good))
    assert (
        "moving pixels (12.5 % of all), the closed form is off by 100.0 cm and ours by 20.0 cm"
        in text
    )
    assert "25.0 times less squared error" in text
    bad = {"moving": {**rows, "closed_form_mse_x100": 2.0}, "static": rows, "d_mse_x100": 1.0}
    assert "2.0 times more squared error" in re.sub(r"<[^>]*>", "", verdict(bad))
    assert "closed form itself" in verdict(good | {"method": "ctof"})
    assert "no ground truth" in verdict({"d_mse_x100": None, "quad_psnr_db": 31.0})


def test_without_truth_the_page_still_shows_pictures(compared):
    """No errors, no truth, no claim; distances and quads remain."""
    run, metrics, _, found = compared
    blind = replace(found, judgement=None)
    unknown = summary(run, blind, protocol="all")
    html = Page(report(title="blind", metrics=unknown, config=run.config, log=[], comparison=blind))
    assert {"closed form", "ours, d", "measured quad", "rendered quad"} <= set(html.images)
    assert not [title for title in html.images if "truth" in title or title.startswith("error")]
    assert "not known" in html.texts["Errors"]
    assert unknown["quad_psnr_db"] == metrics["quad_psnr_db"]


def test_the_frame_shown_is_the_one_that_moves_most(compared):
    """In the middle half of the frames; without truth the change of the quads decides."""
    _, _, _, found = compared
    moving = np.zeros_like(found.judgement.moving)
    moving[7, :3] = moving[4, :1] = moving[11] = True
    assert (
        panels.row_to_show(replace(found, judgement=replace(found.judgement, moving=moving))) == 7
    )
    quads = np.zeros_like(found.sequence.quads)
    quads[9] = 1.0  # against frames 5 and 13; the first of the two in the middle half is shown
    blind = replace(found, judgement=None, sequence=replace(found.sequence, quads=quads))
    assert found.views.frames[panels.row_to_show(blind)] == 5


def test_pages_of_large_noisy_images_stay_below_four_megabytes(compared):
    """Noise is what images compress worst; 60 raw frames of 320x240."""
    generator = np.random.default_rng(0)
    frames, height, width = 60, 240, 320
    noise = generator.uniform(2.0, 6.0, (frames, height, width)).astype(np.float32)
    sequence = sequence_of(
        quads=noise - 4.0,
        measured=np.ones(frames, dtype=bool),
        shifts=np.resize(CANONICAL_SHIFTS, frames),
        times=np.arange(frames) / 120.0,
        f_mod_hz=20e6,
        fx=200.0,
        fy=200.0,
        cx=160.0,
        cy=120.0,
        camera_from_world=np.tile(np.eye(4), (frames, 1, 1)),
    )
    views = Views(
        frames=list(range(frames)),
        d=noise,
        opacity=noise / 6.0,
        d_median=noise,
        d_tof=noise,
        closed_form=noise[::-1],
        quad_rendered=noise - 4.0,
        quad_measured=noise[::-1] - 4.0,
    )
    found = comparison_of(
        sequence, views, Truth(distance=noise[:, ::-1], known=np.ones(frames, dtype=bool))
    )
    text = report(title="noise", metrics=compared[1], config={}, log=[], comparison=found)
    assert 1_000_000 < len(text) < 4_000_000
    assert pictures.thinned(np.zeros((240, 641)), page.PICTURE_SIZE_MAX).shape == (80, 214)
