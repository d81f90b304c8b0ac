"""The notebook of the examples: every cell runs, and what a cell ends with shows itself."""

import ast
import json
import socket
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tron.io.images import decode_png

NOTEBOOK = Path(__file__).resolve().parents[2] / "examples" / "notebook.ipynb"


def cells() -> list[ast.Module]:
    found = json.loads(NOTEBOOK.read_text("utf-8"))["cells"]
    return [ast.parse("".join(each["source"])) for each in found if each["cell_type"] == "code"]


def run(cell: ast.Module, names: dict) -> Any:
    """Run a cell; gives the value of its last line, as a notebook shows it."""
    *lines, last = cell.body
    if not isinstance(last, ast.Expr):
        lines, last = cell.body, None
    exec(compile(ast.Module(lines, []), str(NOTEBOOK), "exec"), names)
    return None if last is None else eval(compile(ast.Expression(last.value), str(NOTEBOOK), "eval"), names)


@pytest.mark.long
@pytest.mark.usefixtures("variant")
def test_the_notebook_runs_and_shows_frames_and_the_viewer(tmp_path, monkeypatch):
    pytest.importorskip("viser", reason="pip install 'tron-relight[view]'")
    monkeypatch.chdir(tmp_path)
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    names: dict = {"__name__": "__main__"}
    pictures = []
    for cell in cells():
        for call in (each for each in ast.walk(cell) if isinstance(each, ast.Call)):
            if isinstance(call.func, ast.Name) and call.func.id == "show":  # 8080 may be in use here
                call.keywords.append(ast.keyword("port", ast.Constant(port)))
        shown = run(ast.fix_missing_locations(cell), names)
        if hasattr(shown, "_repr_png_"):
            pictures.append(decode_png(shown._repr_png_()).astype(float))
        if hasattr(shown, "_repr_html_"):
            page = shown._repr_html_()
            assert f'src="http://127.0.0.1:{port}"' in page
            with urllib.request.urlopen(f"http://127.0.0.1:{port}") as answer:
                assert answer.status == 200
    assert len(pictures) == 3
    assert all(picture.shape == (320, 480, 3) for picture in pictures)
    assert min(np.abs(one - pictures[0]).mean() for one in pictures[1:]) > 0.005  # the light, the scene
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=5)
