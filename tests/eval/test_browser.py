"""The report in a real browser: it fits the width, asks the network for nothing and reports no error."""

import shutil
import subprocess
from pathlib import Path

import pytest

from eval.page import write_page
from eval.relighting.benchmark import Relighting
from eval.results import Results
from tron.io.images import read_image

CHROMIUM = next(
    (path for name in ("chromium", "chromium-browser", "google-chrome") if (path := shutil.which(name))), None
)
FLAGS = [
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--enable-logging=stderr",
    "--host-resolver-rules=MAP * ~NOTFOUND",
]
PROBE = """<script>
addEventListener("load", () => {
  const broken = [...document.images].filter(image => !image.naturalWidth).length;
  const wide = document.documentElement.scrollWidth > innerWidth + 1;
  const cut = [...document.querySelectorAll(".scroll")].filter(s => s.scrollWidth > s.clientWidth + 1).length;
  const first = document.querySelector("img").getBoundingClientRect().bottom < 800;
  const asked = performance.getEntriesByType("resource").filter(r => !r.name.startsWith("data:")).length;
  document.body.setAttribute("data-probe",
    `broken=${broken} wide=${wide} asked=${asked} cut=${cut} first=${first}`);
});
</script>"""


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine")
def test_the_report_opens_in_chromium(dataset: Path, weights: Path, tmp_path: Path):
    outcome = Relighting(dataset=dataset, renderer=weights / "tiny.safetensors", pictures=2).run(tmp_path)
    environment = {"cpu": "here"}
    results = Results(
        benchmark="relighting", environment=environment, rows=outcome.rows, pictures=outcome.pictures
    )
    results.save(tmp_path / "results.json")
    html = write_page(tmp_path).read_text().replace("</body>", PROBE + "</body>")
    (tmp_path / "probe.html").write_text(html)

    def opened(width: int, *more: str) -> subprocess.CompletedProcess[str]:
        profile = f"--user-data-dir={tmp_path / f'profile{width}'}"
        command = [str(CHROMIUM), *FLAGS, profile, f"--window-size={width},800", *more]
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)

    for width in (1400, 1280, 500):
        dump = opened(width, "--dump-dom", f"file://{tmp_path / 'probe.html'}")
        assert 'data-probe="broken=0 wide=false asked=0 ' in dump.stdout
        assert width < 1280 or 'cut=0 first=true"' in dump.stdout
        assert "CONSOLE" not in dump.stderr
    shot = tmp_path / "shot.png"
    opened(1400, f"--screenshot={shot}", f"file://{tmp_path / 'report.html'}")
    assert read_image(shot).std() > 0.02  # not a blank page
