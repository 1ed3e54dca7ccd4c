"""Stated results that are done again: the file of results, bounds, and a planted wrong number."""

import json
import re
from pathlib import Path

import pytest

from gftorf_warp.cli import main
from gftorf_warp.errors import UsageError
from gftorf_warp.recon.presets import PRESETS
from gftorf_warp.sim.scenes import SCENES
from gftorf_warp.sweep import reproduce

ROOT = Path(__file__).parents[1]
ROWS = reproduce.stated_results()
TINY = """
[tiny]
about = "a tiny one"
page = "nowhere"
scene = "demo"
preset = "temporal"
device = "cpu"
seeds = [0]
commit = "none"
machine = "this one"
simulate = {{ size = [16, 12], frames = 8 }}
[tiny.values]
closed_form_mse_x100 = [{closed_form}]
d_mse_x100 = [{d}]
"""


@pytest.mark.parametrize("row", ROWS.values(), ids=list(ROWS))
def test_a_stated_result_can_be_done_again(row):
    """Its names are known, and its spread follows from its seeds or is stated."""
    assert row.preset in PRESETS
    assert row.scene in SCENES or row.scene.startswith("random-")
    assert row.device in ("cpu", "cuda")
    assert row.plan.fits
    assert set(row.values) <= set(reproduce.TITLES)
    for values in row.values.values():
        assert len(values) == len(row.seeds) if row.spread is None else len(values) == 1


@pytest.mark.parametrize("row", ROWS.values(), ids=list(ROWS))
def test_a_stated_result_is_that_of_its_page(row):
    """Every mean is on the page, with four digits or, as in tables of benchmarks, with three."""
    text = (ROOT / row.page).read_text()
    written = {float(number) for number in re.findall(r"\d+(?:\.\d+)?", text)}
    means = {key: row.bounds(key)[1] for key in row.values}
    rounded = {key: {float(f"{mean:.{n}g}") for n in (3, 4)} for key, mean in means.items()}
    assert not {key: means[key] for key, numbers in rounded.items() if not numbers & written}


def stated(**values):
    """A row with one kind of error."""
    about = dict.fromkeys(("name", "about", "page", "scene", "preset", "commit", "machine"), "x")
    row = {"seeds": (0, 1, 2), "device": "cpu", "values": {"d_mse_x100": (1.0, 1.1, 0.9)}}
    return reproduce.Stated(**(about | row | values))


def test_the_spread_is_that_of_the_seeds():
    """Twice the largest deviation, at least 2 %, or as stated."""
    assert stated().bounds("d_mse_x100") == pytest.approx((0.8, 1.0, 1.2))
    alike = {"d_mse_x100": (1.0, 1.0, 1.0)}
    assert stated(values=alike).bounds("d_mse_x100") == pytest.approx((0.98, 1.0, 1.02))
    alone = {"d_mse_x100": (2.0,)}
    assert stated(values=alone, spread=0.1).bounds("d_mse_x100") == pytest.approx((1.8, 2.0, 2.2))


def test_what_is_no_number_is_outside():
    """As the error of a sequence without truth."""
    bounds = {"key": "d_mse_x100", "stated": 1.0, "least": 0.8, "largest": 1.2}
    assert reproduce.Reproduced(by_seed=(1.2, 1.1), **bounds).within
    assert not reproduce.Reproduced(by_seed=(1.2, 1.3), **bounds).within
    assert not reproduce.Reproduced(by_seed=(1.0, float("nan")), **bounds).within


def test_a_wrong_number_is_found_and_a_right_one_is_not(tmp_path, monkeypatch, capsys):
    """The exit code is 1 for the first, and 0 once the file states what was measured."""
    file = tmp_path / "results.toml"
    monkeypatch.setattr(reproduce, "FILE", file)
    monkeypatch.chdir(tmp_path)
    file.write_text(TINY.format(closed_form=123.0, d=0.001))
    assert main(["reproduce", "tiny", "-q", "--json"]) == 1
    found = json.loads(capsys.readouterr().out)
    assert not found["within"]
    measured = {key: number["measured"] for key, number in found["numbers"].items()}
    assert not any(number["within"] for number in found["numbers"].values())
    file.write_text(
        TINY.format(closed_form=measured["closed_form_mse_x100"], d=measured["d_mse_x100"])
    )
    with pytest.raises(UsageError, match="not empty"):
        reproduce.reproduce(reproduce.stated_result("tiny"))
    assert main(["reproduce", "tiny", "-q", "--out", "again"]) == 0
    assert "all within" in capsys.readouterr().out


def test_the_table_names_what_is_outside():
    """Each number has its verdict, and the last line all that failed."""
    bounds = {"stated": 1.0, "least": 0.8, "largest": 1.2}
    found = [
        reproduce.Reproduced(key="closed_form_mse_x100", by_seed=(1.1,), **bounds),
        reproduce.Reproduced(key="d_mse_x100", by_seed=(1.3, 1.3), **bounds),
    ]
    text = reproduce.table(stated(), found)
    assert re.search(r"closed form, all .* within\n", text)
    assert re.search(r"d, all .* outside\noutside the stated spread: d, all$", text)


def test_the_list_and_an_unknown_name(capsys):
    """Every row has a line; a similar name is suggested."""
    assert main(["reproduce", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(ROWS)
    name = next(iter(ROWS))
    with pytest.raises(UsageError, match=f"did you mean {name}"):
        reproduce.stated_result(name + "x")
