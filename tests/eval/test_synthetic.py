"""benchmark=tron_synth: from nothing to a comparison at toy size, and the rows that it is for."""

import json
from pathlib import Path

import pytest

from eval.cli import cli
from eval.compare.synthetic import gains
from eval.results import Results, Row

SIZES = [
    "scenes=2", "views=8", "width=32", "height=32", "path_spp=4", "reference_spp=4", "relights=[high]",
    "relight_spp=4", "film_frames=1",
]  # fmt: skip
TOY = [
    *(f"capture.{size}" for size in SIZES), "test.scenes=2", "test.style={object: 1, table: 1}",
    "test.width=32", "test.height=32", "environment_height=32", "mesh_edge=0.2", "workers=1",
]  # fmt: skip
FEW = ["initial.count=500", "steps_scaler=0.005"]


def row(metric: str, value: float, **more: float) -> Row:
    return Row(metric=metric, value=value, unit="dB", n=4, scenes=4, **more)  # type: ignore[arg-type]


def test_the_best_way_without_a_network_is_its_rival_whoever_is_better():
    ways = {"lit": 27, "lit_oidn": 29, "network": 28}
    rows = [row(f"maps_{name}.psnr", value) for name, value in ways.items()]
    rows += [row(f"maps_{name}.faults", 0) for name in ways]
    rows += [row("photos_network.psnr", 22), row("mesh_peer.psnr", 20)]
    rows += [row("maps_lit_oidn.gain_over_maps_network", 1, low=0.5, high=2)]
    rows += [row("photos_network.gain_over_mesh_peer", 2)]
    rows += [row("photos_network.seconds_fit", 30), row("mesh_peer.seconds_fit", 60)]
    found = {each.metric: each for each in gains({each.metric: each for each in rows})}
    lost = found["synth.network_gain_db"]
    assert (lost.value, lost.low, lost.high, lost.reference) == (-1, -2, -0.5, "maps_lit_oidn")
    assert found["synth.gain_over_mesh_db"].value == 2
    assert found["synth.time_over_mesh"].value == 0.5
    faulty = {each.metric: each for each in rows if each.metric != "maps_lit_oidn.psnr"}
    assert "synth.network_gain_db" not in {each.metric for each in gains(faulty)}


@pytest.mark.long
def test_one_command_makes_shows_and_judges(tmp_path: Path):
    pytest.importorskip("pyoidn", reason="pip install 'tron-relight[oidn]'")
    recipe = ["experiment=tron_synth_small", "mode=captures", *TOY]
    export = ["export=tron_synth_small", "export.recipe=" + json.dumps(recipe)]
    few = "method.reconstruct=" + json.dumps(["prior=joint", "initial.source=stereo", "report=null", *FEW])
    ways = "method.ways=[lit,lit_oidn,network]"
    mesh = "method.mesh={voxels: 32, light_height: 8, steps: 5, spp: 2, frame_spp: 4}"
    methods = {
        "true_maps": [ways, "method.count=1000"],
        "photos": [ways, few],
        "mesh_peer": [mesh, "method.surfels={steps_scaler: 0.005, initial: {count: 500}}"],
    }
    given = [
        f"benchmark.export={json.dumps(export)}",
        *(f"benchmark.methods.{k}={json.dumps(v)}" for k, v in methods.items()),
    ]
    with pytest.raises(SystemExit) as end:
        cli(["benchmark=tron_synth", *given, f"output_dir={tmp_path / 'out'}"])
    assert end.value.code == 0
    found = Results.load(tmp_path / "out/results.json")
    for name in ("maps_lit", "maps_network", "photos_network", "mesh_peer"):
        assert found.value(f"{name}.faults") == 0
        assert (found.value(f"{name}.psnr") or 0) > 5
    assert found.value("compare.identical_rows") == 1
    for name in ("network_gain_db", "gain_over_mesh_db", "time_over_mesh", "minutes"):
        assert found.value(f"synth.{name}") is not None
    assert "TRON, lit, from photos" in (tmp_path / "out/report.html").read_text()
