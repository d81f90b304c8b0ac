"""Judges with known answers behind an endpoint on this machine, which check the benchmark itself.

One answers by PSNR against the true picture, one always says A. The benchmark
must find the first one fit and the second one unfit.
"""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Thread

import numpy as np

from eval.judge.answers import Answers
from eval.judge.asking import Found, Picture, ask_all
from eval.judge.endpoint import Endpoint
from eval.judge.schedule import SPOILED, Question, controls, questions, spoiled
from eval.judge.verdicts import Fitness
from eval.results import Row
from eval.video.order import made_clip
from tron.io.images import decode_png, encode_png
from tron.metrics import psnr
from tron.seeds import generator

BY_PSNR, BY_POSITION = "by_psnr", "by_position"
BETTER, WORSE = "better", "worse"
NOISE: Mapping[str, float] = {BETTER: 0.02, WORSE: 0.06}
"""Standard deviation of the noise of two made methods, display values."""
Judge = Callable[[np.ndarray, np.ndarray], str]
"""Pictures A and B -> what it says."""


class Handler(BaseHTTPRequestHandler):
    """Handler of POST /v1/chat/completions with two pictures, as in OpenAI's API."""

    judge: Judge

    def do_POST(self) -> None:
        """Answer one request."""
        request = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
        parts = request["messages"][0]["content"]
        urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
        first, second = (decode_png(base64.b64decode(url.partition(",")[2])) for url in urls)
        message = {"role": "assistant", "content": self.judge(first, second)}
        choice = {"index": 0, "message": message, "finish_reason": "stop"}
        self.reply({"id": "0", "object": "chat.completion", "model": request["model"], "choices": [choice]})

    def reply(self, content: object, code: int = 200) -> None:
        """Send JSON."""
        body = json.dumps(content).encode()
        self.send_response(code)
        self.send_header("Content-Type", "application/json")
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Log no requests."""


@contextmanager
def serving(handler: type[Handler]) -> Iterator[str]:
    """Serve on the loopback address while the block runs; yield the base address."""
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = Thread(target=server.serve_forever, kwargs={"poll_interval": 0.05}, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_port}/v1"
        finally:
            server.shutdown()
            thread.join()


def by_psnr(truths: Sequence[np.ndarray]) -> Judge:
    """Return a judge that chooses the picture nearer to the truth, which it finds among ``truths``."""

    def judge(first: np.ndarray, second: np.ndarray) -> str:
        truth = max(truths, key=lambda each: psnr(first, each) + psnr(second, each))
        return "A" if psnr(first, truth) > psnr(second, truth) else "B"

    return judge


def made_pictures(seed: int) -> tuple[np.ndarray, Picture]:
    """Return the truth (K, H, W, 3) of a drawn scene, and two methods' pictures, one of them noisier."""
    truth = made_clip()[2]

    def picture(question: Question, method: str) -> bytes:
        shown = truth[question.view]
        if method in NOISE:
            noise = generator(seed, "judge", method, question.view).standard_normal(shown.shape)
            shown = np.clip(shown + NOISE[method] * noise, 0, 1)
        return encode_png(spoiled(shown) if method == SPOILED else shown)

    return truth, picture


def check_rows(folder: Path, seed: int) -> Iterator[Row]:
    """Yield rows of both known judges, and whether position bias is found only in the biased one."""
    truth, picture = made_pictures(seed)
    scenes = {"made": (["lamp"], len(truth))}
    asked = controls(scenes, seed) + questions(scenes, BETTER, [WORSE], len(truth), [seed])
    fitness = {}
    judges: dict[str, Judge] = {BY_PSNR: by_psnr(list(truth)), BY_POSITION: lambda *_: "A"}
    for name, judge in judges.items():
        handler = type("Known", (Handler,), {"judge": staticmethod(judge)})
        with serving(handler) as url:
            endpoint = Endpoint(url, name, "", timeout=60.0, retries=1)
            found: Found = ask_all(asked, picture, endpoint, Answers(folder / f"check_{name}.jsonl"), 2)
        fitness[name] = Fitness.of(found)
        yield from fitness[name].rows(f"judge.check.{name}")
    told = fitness[BY_POSITION].by_position and not fitness[BY_PSNR].by_position
    yield Row(metric="judge.position_bias_found", value=float(told), unit="1", n=len(asked))
