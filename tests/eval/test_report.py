"""The page stands alone: nothing is fetched, every picture has words, every text is escaped."""

import re
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

from eval.report.assemble import assemble
from eval.report.charts import read_metrics, training_curves
from eval.report.figures import verdict
from eval.report.outcome import Outcome
from eval.results import Results, Row, Target
from tron.report.page import Cell, Page, Picture, Pictures, Section, Table, Text, Tile
from tron.report.render import data_uri, render
from tron.report.values import format_value

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


def a_page(tmp_path: Path, text: str = "words") -> Page:
    (tmp_path / "metrics.csv").write_text(METRICS)
    table = Table("caption", ["name", "value"], [[Cell("a"), Cell("1.0", "good")]], [("both", 2)], words=[1])
    pictures = Pictures("pictures", [Picture(grey(), "one", "a grey square", "20.0 dB", strong=True)])
    curves = training_curves({"neural": tmp_path / "metrics.csv", "absent": tmp_path / "absent.csv"})
    return Page(
        "title",
        "verdict",
        [text],
        [Tile("label", "1 dB", "[0, 2]", "reached", "good")],
        [Section("here", "Here", [Text(text), table, pictures, *curves])],
    )


def test_a_page_of_every_kind_of_block_asks_the_network_for_nothing(tmp_path: Path):
    page = a_page(tmp_path)
    assert {block.kind for block in page.sections[0].blocks} == {"text", "table", "pictures", "chart"}
    html = render(page)
    assert_self_contained(html)
    assert "<svg" in html


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


def test_text_is_escaped(tmp_path: Path):
    html = render(a_page(tmp_path, text="<script>alert(1)</script> & more"))
    assert "<script" not in html
    assert "<script>alert(1)</script> & more" in Collector(html).text


def test_light_and_dark_are_both_defined(tmp_path: Path):
    html = render(a_page(tmp_path))
    assert "prefers-color-scheme: dark" in html
    assert "currentColor" in html


def test_small_pictures_survive_the_page_exactly():
    import base64

    from tron.images import decode_png

    image = np.linspace(0, 1, 24 * 24 * 3).reshape(24, 24, 3).astype(np.float32)
    kind, _, data = data_uri(image).partition(",")
    assert kind == "data:image/png;base64"
    np.testing.assert_allclose(decode_png(base64.b64decode(data)), image, atol=0.5 / 255 + 1e-6)
    assert data_uri(grey(300)).startswith("data:image/jpeg;base64,")


def test_curves_join_the_clocks_of_the_stages_and_drop_repeated_values(tmp_path: Path):
    (tmp_path / "metrics.csv").write_text(METRICS)
    curves = read_metrics(tmp_path / "metrics.csv")
    assert curves.stages == [("synthetic", 0.0), ("adapt", 30.0)]
    np.testing.assert_array_equal(curves.columns["loss"][0], [10, 20, 30, 40])
    np.testing.assert_array_equal(curves.columns["val_psnr"][0], [20, 40])
    np.testing.assert_array_equal(curves.columns["val_psnr"][1], [25, 26])


@pytest.mark.parametrize("text", ["", "stage,step\nsynthetic,1\n", "a,b\n1,2\n", "seconds,loss\nx,y\n"])
def test_a_log_without_curves_gives_no_chart(tmp_path: Path, text: str):
    (tmp_path / "metrics.csv").write_text(text)
    assert training_curves({"neural": tmp_path / "metrics.csv"}) == []


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


def test_the_assembled_page_names_targets_missed_and_unmeasured():
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
    outcome = Outcome(rows, "t", "v.", [], [], {"neural.psnr": "PSNR"}, ["make demo"])
    html = render(assemble(outcome, results, targets))
    text = " ".join(Collector(html).text.split())
    assert "v. 1 of 2 targets are reached; 1 not measured." in text
    assert "missed by 1.00 dB" in text
    assert "not measured" in text
    assert "abc123 with uncommitted changes" in text
    assert "make demo" in text
    assert '<th scope="row" class="plain words">neural.psnr' in html, (
        "long names break; the verdict stays in sight"
    )
    assert_self_contained(html)
