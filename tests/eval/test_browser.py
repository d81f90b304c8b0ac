"""The report in a real browser: it fits the width, asks the network for nothing and reports no error."""

import shutil
import subprocess
from pathlib import Path

import pytest

from eval.relighting.benchmark import Relighting
from eval.report.assemble import assemble
from eval.results import Results
from tron.images import read_image
from tron.report.render import write_report

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
  const asked = performance.getEntriesByType("resource").filter(r => !r.name.startsWith("data:")).length;
  document.body.setAttribute("data-probe", `broken=${broken} wide=${wide} asked=${asked}`);
});
</script>"""


@pytest.mark.long
@pytest.mark.parametrize("width", [1400, 500])
def test_the_report_opens_in_chromium(dataset: Path, weights: Path, tmp_path: Path, width: int):
    if CHROMIUM is None:
        pytest.skip("no Chromium on this machine")
    benchmark = Relighting(dataset=dataset, renderer=weights / "tiny.safetensors", pictures=2)
    outcome = benchmark.run(tmp_path)
    results = Results(benchmark="relighting", environment={"cpu": "here"}, rows=list(outcome.rows))
    write_report(assemble(outcome, results, benchmark.bounds()), tmp_path / "report.html")
    html = (tmp_path / "report.html").read_text().replace("</body>", PROBE + "</body>")
    (tmp_path / "probe.html").write_text(html)
    browser = [CHROMIUM, *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", f"--window-size={width},1200"]
    dump = subprocess.run(
        [*browser, "--dump-dom", f"file://{tmp_path / 'probe.html'}"],
        capture_output=True,
        text=True,
        timeout=120,
        check=True,
    )
    assert 'data-probe="broken=0 wide=false asked=0"' in dump.stdout
    assert "CONSOLE" not in dump.stderr
    shot = tmp_path / "shot.png"
    subprocess.run(
        [*browser, f"--screenshot={shot}", f"file://{tmp_path / 'report.html'}"],
        capture_output=True,
        timeout=120,
        check=True,
    )
    assert read_image(shot).std() > 0.02  # not a blank page
