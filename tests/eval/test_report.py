"""The page stands alone: nothing is fetched, every picture has words, every text is escaped."""

import re
import sys
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from eval.page import Figures, write_page
from eval.report.figures import verdict
from eval.report.outcome import load_group, save_group, training_curves
from eval.results import Results, Row, Target
from tron.report.charts import line_chart
from tron.report.page import Block, Cell, Picture, Pictures, Table, Tile, format_value
from tron.report.render import data_uri, fitting, render_template

TEMPLATE = """{% extends "page.html.j2" %}
{% set title = "title" %}
{% block lead %}<p>{{ words }}</p>{% endblock %}
{% block body %}
{% call section("here", "Here") %}{{ show(blocks) }}{% endcall %}
{% call section("empty", "Empty") %}words{{ show(None) }}{% endcall %}
{% endblock %}"""
METRICS = """stage,step,seconds,loss,learning_rate,val_psnr,val_psnr_full
synthetic,50,10.0,0.05,0.001,,
synthetic,100,20.0,0.04,0.001,25.0,27.0
synthetic,150,30.0,0.03,0.001,25.0,27.0
adapt,50,10.0,0.02,0.0003,26.0,28.0
"""


class Collector(HTMLParser):
    """Everything in a page that could make a browser ask the network, and what it shows."""

    def __init__(self, html: str):
        super().__init__()
        self.tags: list[str] = []
        self.sources: list[str] = []
        self.images: list[dict[str, str | None]] = []
        self.text = ""
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        values = dict(attrs)
        if tag == "img":
            self.images.append(values)
        for name in ("src", "href", "xlink:href", "srcset", "data", "action", "poster", "background"):
            if values.get(name):
                self.sources.append(str(values[name]))

    def handle_data(self, data: str) -> None:
        self.text += data


def assert_self_contained(html: str) -> None:
    page = Collector(html)
    assert not {"script", "link", "iframe", "object", "embed", "base"} & set(page.tags)
    assert [source for source in page.sources if not source.startswith(("data:image/", "#"))] == []
    assert "@import" not in html
    assert [url for url in re.findall(r"url\(([^)]*)\)", html) if not url.strip("\"'").startswith("#")] == []
    assert all(image.get("alt") for image in page.images)


def grey(size: int = 16) -> np.ndarray:
    return np.full((size, size, 3), 0.5, np.float32)


@pytest.fixture
def render(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    """A page of someone's own: a template in a package beside ours."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "__init__.py").touch()
    (tmp_path / "mine" / "mine.html.j2").write_text(TEMPLATE)
    monkeypatch.syspath_prepend(tmp_path)
    tiles = [Tile("label", "1 dB", "[0, 2]", "reached", "good")]
    yield lambda blocks, words="": render_template(
        "mine", "mine.html.j2", blocks=blocks, words=words, tiles=tiles
    )
    sys.modules.pop("mine", None)


def some_blocks() -> list[Block]:
    table = Table("caption", ["name", "value"], [[Cell("a"), Cell("1.0", "good")]], [("both", 2)], words=[1])
    pictures = Pictures("pictures", [Picture(grey(), "one", "a grey square", "20.0 dB", strong=True)])
    return [table, pictures, line_chart({"a line": [(0.0, 1.0), (2.0, 3.0)]}, "x", "y", "of the chart")]


def test_a_page_of_every_kind_of_block_asks_the_network_for_nothing(render):
    html = render(some_blocks())
    assert_self_contained(html)
    for each in ("<svg", "<table", "<img", 'href="#here"', "reached"):
        assert each in html
    assert "Empty" not in html, "a section of which nothing is shown is left out"


def test_the_check_itself_finds_a_request():
    for html in (
        '<img src="http://x/y.png" alt="a">',
        '<link rel="stylesheet" href="//x">',
        "<script></script>",
        "<style>@import 'x';</style>",
        "<style>p {background: url(x.png)}</style>",
        '<img src="data:image/png;base64,AA">',
    ):
        with pytest.raises(AssertionError):
            assert_self_contained(html)


def test_text_is_escaped(render):
    html = render(some_blocks(), "<script>alert(1)</script> & more")
    assert "<script" not in html
    assert "<script>alert(1)</script> & more" in Collector(html).text


def test_light_and_dark_are_both_defined(render):
    html = render(some_blocks())
    assert "prefers-color-scheme: dark" in html
    assert "currentColor" in html


def test_small_pictures_survive_the_page_exactly():
    import base64

    from tron.io.images import decode_png

    image = np.linspace(0, 1, 24 * 24 * 3).reshape(24, 24, 3).astype(np.float32)
    kind, _, data = data_uri(image).partition(",")
    assert kind == "data:image/png;base64"
    np.testing.assert_allclose(decode_png(base64.b64decode(data)), image, atol=0.5 / 255 + 1e-6)
    assert data_uri(grey(300)).startswith("data:image/jpeg;base64,")


def test_curves_join_the_clocks_of_the_stages_and_drop_repeated_values(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text(METRICS)
    curves = training_curves({"net": tmp_path / "metrics.csv", "absent": tmp_path / "absent.csv"})
    assert set(curves) == {"loss", "psnr"}
    assert [x for x, _ in curves["loss"]["net, loss"]] == [10, 20, 30, 40]
    assert curves["psnr"]["net, val_psnr"] == [(20, 25), (40, 26)]


@pytest.mark.parametrize("text", ["", "stage,step\nsynthetic,1\n", "a,b\n1,2\n", "seconds,loss\nx,y\n"])
def test_a_log_without_curves_gives_no_chart(tmp_path: Path, text: str):
    (tmp_path / "metrics.csv").write_text(text)
    assert training_curves({"neural": tmp_path / "metrics.csv"}) == {}


def test_figures_are_written_with_their_units():
    assert format_value(0.0123, "fraction") == "1.23%"
    assert format_value(-3.456, "dB", signed=True) == "\N{MINUS SIGN}3.46 dB"
    assert format_value(-0.0001, "dB", signed=True) == "0.00 dB"
    assert format_value(754.4, "s") == "12 min 34 s"
    assert format_value(4.2, "deg") == "4.20°"


def test_verdicts_say_by_how_much():
    gain = Target(metric="neural.gain", bound="at least", value=3.0)
    assert verdict(gain, 3.7, "dB") == ("reached, 0.70 dB to spare", "good")
    assert verdict(gain, 2.5, "dB") == ("missed by 0.50 dB", "bad")
    assert verdict(gain, None, "dB") == ("not measured", "plain")
    leak = Target(metric="guidance.leak", bound="at most", value=0.02)
    assert verdict(leak, 0.03, "fraction") == ("missed by 1.00%", "bad")


def test_a_page_of_rows_names_targets_missed_and_unmeasured(tmp_path: Path):
    targets = [
        Target(metric="neural.psnr", bound="at least", value=31.0),
        Target(metric="demo.seconds", bound="at most", value=900.0),
        Target(metric="surfels.normal_mae_deg", bound="at most", value=5.0),
    ]
    rows = [
        Row(metric="neural.psnr", value=30.0, unit="dB", n=3),
        Row(metric="demo.seconds", value=600.0, unit="s", n=1),
    ]
    environment = {"cpu": "a processor", "commit": "abc123", "dirty": True, "inputs": {"clips": {"test": 9}}}
    results = Results(benchmark="demo", environment=environment, rows=rows).held_to(targets)
    results.reproduce.append("make demo")
    results.save(tmp_path / "results.json")
    html = write_page(tmp_path).read_text()
    text = " ".join(Collector(html).text.split())
    assert "1 of 2 targets are reached; 1 not measured." in text
    assert "missed by 1.00 dB" in text
    assert "not measured" in text
    assert "abc123 with uncommitted changes" in text
    assert "make demo" in text
    assert '<th scope="row" class="plain words">neural.psnr' in html, (
        "long names break; the verdict stays in sight"
    )
    assert_self_contained(html)


def wide_table(columns: int, groups: bool = False) -> Table:
    headings = ["Method", *(f"kind{k}" for k in range(columns)), "What it is"]
    row = ["filtered affine blend", *(f"3{k % 10}.25 [31.00, 38.50]" for k in range(columns)), "words " * 30]
    over = [("", 1), ("foreground", columns // 2), ("frame", columns - columns // 2), ("", 1)]
    return Table(
        "Every kind.", headings, [row, ["none", *[""] * (columns + 1)]], over if groups else (), [columns + 1]
    )


@pytest.mark.parametrize("columns", [1, 3, 5, 12, 20, 41])
@pytest.mark.parametrize("groups", [False, True])
def test_a_table_wider_than_the_page_becomes_tables_that_hold_every_column_once(columns: int, groups: bool):
    table = wide_table(columns, groups)
    parts = fitting(table)
    assert [heading for part in parts for heading in part.headings[1:]] == table.headings[1:]
    assert all(part.headings[0] == "Method" for part in parts)
    assert [cell.text for part in parts for cell in part.cells[0][1:]] == table.rows[0][1:]  # type: ignore[index]
    assert {part.cells[0][0].text for part in parts} == {"filtered affine blend"}
    for part in parts:
        assert sum(span for _, span in part.groups) == (len(part.headings) if groups else 0)
    assert [part.words for part in parts][-1] == [len(parts[-1].headings) - 1]
    assert len(parts) == (1 if columns <= 5 else len(parts))
    assert len(parts) > 1 or columns < 12


def test_an_interval_stands_below_its_figure_and_text_stays_escaped(render):
    html = render([Table("c", ["x", "y"], [["n", "1.0 [0.5, <2>]"]])])
    assert "<span>1.0</span> <span>[0.5, &lt;2&gt;]</span>" in html


def test_the_first_picture_comes_before_words_and_figures_and_pictures_come_back_from_files(tmp_path: Path):
    wide = np.linspace(0, 1, 4 * 8 * 3).reshape(4, 8, 3).astype(np.float32)
    group = Pictures(
        "both", [Picture(grey(6), "a", "a grey"), Picture(wide, "b", "a ramp", "3 dB")], columns=1
    )
    saved = save_group(tmp_path, "pictures", "both", group)
    found = load_group(tmp_path, saved)
    assert isinstance(found, Pictures)
    for ours, theirs in zip(found.pictures, group.pictures, strict=True):
        np.testing.assert_allclose(ours.image, theirs.image, atol=0.5 / 255 + 1e-6)
        assert (ours.title, ours.alt, ours.figure) == (theirs.title, theirs.alt, theirs.figure)
    rows = [Row(metric="lit.psnr", value=30.0, unit="dB", n=3)]
    Results(benchmark="relighting", environment={}, rows=rows, pictures=[saved]).save(
        tmp_path / "results.json"
    )
    html = write_page(tmp_path).read_text()
    assert html.count("<img") == 2, "on the first screen and not again"
    assert html.index("<img") < html.index('class="lead"') < html.index('class="tiles"')
    (tmp_path / "pictures" / "both.png").unlink()
    assert "<img" not in write_page(tmp_path).read_text(), "git holds rows alone"


def test_tables_are_patterns_of_metrics():
    rows = [
        Row(metric=f"speed.{name}.{size}", value=value, unit="s", n=1)
        for name, size, value in (("ours", "1k", 1.0), ("ours", "20k", 2.0), ("theirs", "1k", 3.0))
    ]
    figures = Figures(Results(benchmark="b", environment={}, rows=rows), Path())
    assert figures.names("speed.ours.*") == ["1k", "20k"]
    table = figures.table(
        "c", {"a": "speed.ours.*", "b": "speed.theirs.*", "none": "speed.no.*"}, first="Size"
    )
    assert table is not None
    assert table.headings == ["Size", "a", "b"]
    assert [[cell.text for cell in row] for row in table.cells] == [
        ["1k", "1.00 s", "3.00 s"],
        ["20k", "2.00 s", ""],
    ]
    assert figures.table("c", {"a": "speed.no.*"}) is None
    chart = figures.growth("c", "n", "s", {"ours": "speed.ours.*", "theirs": "speed.theirs.*"})
    assert chart is not None
    assert chart.alt.endswith("ours from 1 to 2.")


def test_growth_is_drawn_at_the_size_that_has_most_points():
    cases = ("1k_64", "2k_64", "4k_64", "1k_128", "room_1k_64", "8k_32")
    rows = [Row(metric=f"rays.{case}", value=k + 1.0, unit="Mrays/s", n=1) for k, case in enumerate(cases)]
    figures = Figures(Results(benchmark="b", environment={}, rows=rows), Path())
    chart = figures.growth("at {}", "surfels", "y", {"ours": "rays.*_{}"})
    assert chart is not None
    assert (chart.caption, chart.alt) == ("at 64", "Line chart, y over surfels: ours from 1 to 3.")
