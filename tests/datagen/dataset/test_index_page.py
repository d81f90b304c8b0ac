"""index.html: what it holds, and in a real browser what it shows of a dataset opened from its folder."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from datagen.dataset.pages import index_page, tone_tables
from datagen.dataset.records import ClipRow, read_record
from tron.color import agx, linear_to_srgb
from tron.io.images import read_image
from tron.seeds import generator
from tron.shards.reader import read_clips

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = [
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--enable-logging=stderr", "--host-resolver-rules=MAP * ~NOTFOUND", "--virtual-time-budget=2000000"),
]
# Time in the page runs ahead whenever nothing is to be done, and the page is read when its budget is spent:
# what the probe waits for, it asks for again and again.
PROBE = """<script>
(async () => {
  const until = async test => { while (!test()) await new Promise(done => setTimeout(done, 20)); };
  await until(() => document.readyState === "complete");
  const found = { clips: document.querySelectorAll("#clips li").length, count: element("count").textContent,
    place: element("place").textContent, wide: document.documentElement.scrollWidth > innerWidth + 1,
    first: document.querySelector("#clips span")?.textContent };
  if (state.clip) {
    await until(() => document.body.dataset.shown);
    found.shown = document.body.dataset.shown;
    found.members = [...document.querySelectorAll("#tiles canvas")].map(c => c.dataset.member);
    found.captions = [...document.querySelectorAll("#tiles figcaption")].map(c => c.textContent);
    const canvas = document.querySelector("#tiles canvas");
    found.size = [canvas.width, canvas.height];
    found.rgba = [...canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data];
  } else {
    const images = [...document.images];
    images.forEach(image => { image.loading = "eager"; });
    await until(() => images.every(image => image.complete));
    found.broken = images.filter(image => !image.naturalWidth).length;
  }
  found.asked = performance.getEntriesByType("resource").filter(r => !/^(file|data):/.test(r.name)).length;
  document.body.setAttribute("data-probe", JSON.stringify(found));
})();
</script>"""


@pytest.fixture(scope="module")
def probe(small_dataset: Path, tmp_path_factory: pytest.TempPathFactory):
    """A function that opens the page of a copy of the dataset at a hash and gives what the probe found."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    folder = tmp_path_factory.mktemp("page") / "a folder, 100% ours"
    shutil.copytree(small_dataset, folder)

    def look(state: str = "", page: str | None = None, width: int = 1200) -> dict:
        html = page or (folder / "index.html").read_text()
        (folder / "probe.html").write_text(html.replace("</body>", PROBE + "</body>"))
        url = (folder / "probe.html").as_uri() + (f"#{state}" if state else "")
        browser = [CHROMIUM, *FLAGS, f"--user-data-dir={folder.parent / 'profile'}"]
        dump = subprocess.run(
            [*browser, f"--window-size={width},900", "--dump-dom", url],
            capture_output=True,
            text=True,
            timeout=120,
            check=True,
        )
        assert "CONSOLE" not in dump.stderr, dump.stderr
        probed = re.search(r'data-probe="([^"]*)"', dump.stdout)
        assert probed, "the page did not come to rest"
        found = json.loads(probed[1].replace("&quot;", '"').replace("&amp;", "&"))
        assert found["asked"] == 0, "nothing but the files beside it"
        return found

    return look


def shown_by(rgba: list[int], size: list[int]) -> np.ndarray:
    return np.array(rgba, float).reshape(size[1], size[0], 4)[..., :3]


@pytest.mark.long
@pytest.mark.parametrize("width", [1200, 500])
def test_the_page_lists_filters_and_sorts_clips(probe, width: int):
    found = probe(width=width)
    assert (found["count"], found["clips"], found["broken"], found["wide"]) == ("7 of 7 clips", 7, 0, False)
    assert probe("split=test", width=width)["count"] == "2 of 7 clips"
    assert probe("light_family=sun&scene=train-", width=width)["count"] == "2 of 7 clips"
    assert probe("sort=light_family", width=width)["first"] == "train-000000-l1", "overcast comes first"


@pytest.mark.long
@pytest.mark.parametrize("stops, curve, frame", [(0, "agx", 0), (3, "agx", 2), (-2.5, "srgb", 1)])
def test_a_clips_canvas_shows_its_linear_values_under_exposure(
    probe, small_dataset: Path, stops: float, curve: str, frame: int
):
    clip = next(c for c in read_clips(small_dataset, "test") if c.meta.key.endswith("l1"))
    found = probe(f"clip={clip.meta.key}&stops={stops}&curve={curve}&frame={frame}")
    assert found["shown"] == f"{clip.meta.key} {frame} {stops:g} {curve}"
    assert found["members"][0] == "rgb"
    assert found["captions"][0] == f"rgb, frame {frame + 1}"
    assert set(found["members"]) == set(clip.frames) - {"depth", "depth_ref"}
    linear = clip.exposed("rgb")[frame].astype(np.float64) * 2.0**stops
    expected = agx(linear) if curve == "agx" else np.clip(linear_to_srgb(linear), 0, 1)
    apart = np.abs(shown_by(found["rgba"], found["size"]) - 255 * expected)
    assert apart.max() <= 1.5
    assert expected.std() > 0.03, "there is something to see"


def first_row(dataset: Path) -> ClipRow:
    record = read_record(dataset, "train-000000")
    assert record is not None
    return record.clips[0]


@pytest.mark.long
def test_thousands_of_clips_stay_usable(probe, small_dataset: Path):
    """A page shows a part of them, and its thumbnails load as they come into view."""
    row = first_row(small_dataset)
    many = [
        row.model_copy(update={"key": f"train-{k:06d}-l0", "scene": f"train-{k:06d}"}) for k in range(20_000)
    ]
    page = index_page("many", many, {})
    assert len(page) < 8e6
    found = probe("page=50", page)
    assert (found["clips"], found["place"]) == (120, "page 51 of 167")
    assert found["first"] == "train-006000-l0"


def test_the_page_is_one_file_whose_words_cannot_end_its_script(small_dataset: Path):
    page = (small_dataset / "index.html").read_text()
    assert not re.search(r"https?:|<link|src=\"(?!data:)", page)
    row = first_row(small_dataset)
    hostile = "</script><b>&\"'"
    page = index_page(hostile, [row.model_copy(update={"style": hostile})], {hostile: hostile})
    assert hostile not in page
    data = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert data
    assert ClipRow.model_validate(json.loads(data[1])["clips"][0]).style == hostile


def test_the_tables_of_the_page_are_agx():
    """The page's arithmetic, written again here, against tron.color."""
    tables = tone_tables()
    low, high = tables["agx_range"]
    linear = 2.0 ** generator(3, "linear").uniform(-14, 6, (2000, 3))
    inset = linear @ np.array(tables["agx_inset"]).T
    at = np.clip((np.log2(inset) - low) / (high - low), 0, 1) * (len(tables["agx"]) - 1)
    found = np.interp(at, np.arange(len(tables["agx"])), tables["agx"])
    assert np.abs(found - agx(linear)).max() < 2e-4


@pytest.mark.long
def test_the_page_is_not_blank(small_dataset: Path, tmp_path: Path):
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    shot = tmp_path / "shot.png"
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1000,800"]
    url = (small_dataset / "index.html").as_uri()
    subprocess.run([*command, f"--screenshot={shot}", url], capture_output=True, timeout=120, check=True)
    assert read_image(shot).std() > 0.05
